"""`python -m studies`, run in the folder `notebooks`: measurements, in numbers and pictures."""

from jaxbridge.studies.command import Command

from .accuracy import ACCURACY
from .bayes import BAYES
from .benchmark import BENCHMARK
from .orders import ORDERS
from .rivals import RIVALS

PARTS = {
    "accuracy": (ACCURACY,),
    "bayes": (BAYES,),
    "bench": (BENCHMARK,),
    "orders": (ORDERS,),
    "rivals": (RIVALS,),
}


COMMAND = Command(
    program="python -m studies",
    description="The accuracy that a time buys, Bayesian inference (section 4 of the paper), "
    "speed and memory, and other packages beside this one.",
    parts=PARTS,
    groups={"all": tuple(PARTS)},
    part="all",
    figures="studies.figures",
    keeps_programs=False,
    next_steps="Read next: costs.md, how_to_choose.md and rivals.md, made from such results.",
)

main = COMMAND.run

if __name__ == "__main__":
    main()
