"""`python -m jaxbridge`: the paper's simulation study, in numbers and pictures."""

from .studies.command import Command
from .studies.exact import COST, EXACT, VARIATION
from .studies.paper import APPROXIMATE

COMMAND = Command(
    program="python -m jaxbridge",
    description="Approximate and exact Ornstein-Uhlenbeck bridges: section 3 of Bladt, Finch & "
    "Sorensen, Simulation of multivariate diffusion bridges.",
    parts={
        "approximate": (APPROXIMATE,),
        "exact": (EXACT,),
        "cost": (COST,),
        "variation": (VARIATION,),
    },
    groups={
        "paper": ("approximate", "exact"),
        "all": ("approximate", "exact", "cost", "variation"),
    },
    part="paper",
    figures="jaxbridge.studies.figures",
    keeps_programs=True,
    next_steps="`python -m jaxbridge all` also measures the cost by duration and the variation of "
    "hitting probabilities.\nRead next: README.md, then notebooks/01_quickstart.ipynb and "
    "notebooks/howto.",
)

main = COMMAND.run

if __name__ == "__main__":
    main()
