"""Every public symbol is documented, and the examples in its docstring run."""

import inspect
import re

import jax
import matplotlib
import matplotlib.pyplot as plt
import pytest

import jaxbridge as jb
from jaxbridge import plot

SYMBOLS = {name: getattr(jb, name) for name in jb.__all__}
SYMBOLS |= {f"plot.{name}": getattr(plot, name) for name in plot.__all__}

# Results need no example of how to make them, but name the functions that return them.
RESULTS = {
    "Bridges": ["sample_bridges"],
    "Chain": ["sample_exact_bridges"],
    "Choice": ["choose_proposal"],
    "CoupledPairs": ["sample_exact_bridges"],
    "Events": ["sample_events"],
    "Exits": ["sample_exits"],
    "ExtrapolatedBridges": ["extrapolate"],
    "ExtrapolatedLogDensity": ["extrapolate"],
    "Forecast": ["forecast"],
    "GaussianBridge": ["gaussian_bridge"],
    "GibbsPosterior": ["gibbs"],
    "GibbsState": ["gibbs"],
    "HittingCounts": ["hitting_counts"],
    "HittingVariation": ["hitting_variation"],
    "Innovations": ["innovations"],
    "Kernel": ["pseudo_marginal", "renewal", "crank_nicolson", "smoothing_kernel"],
    "LogLikelihood": ["log_likelihood"],
    "MaximumLikelihood": ["maximum_likelihood"],
    "RecordMaximumLikelihood": ["maximum_likelihood"],
    "PMMHPosterior": ["pmmh"],
    "PMMHState": ["pmmh"],
    "Pilot": ["tune_coupling"],
    "PosteriorSummary": ["summary"],
    "RecordPosterior": ["gibbs"],
    "RecordState": ["gibbs"],
    "Calibration": ["simulation_based_calibration"],
    "Score": ["score"],
    "Setting": ["work_precision"],
    "Smoothed": ["smooth"],
    "TransitionLogDensity": ["transition_log_density"],
    "Tuning": ["tune_coupling"],
    "WeightedBridges": ["sample_weighted_bridges", "weigh_bridges"],
    "WorkPrecision": ["work_precision"],
}
# What classes of one's own are given.
GIVEN = {"Frame", "PairStep", "Step", "StepLaw", "DegenerateLaw", "StepsFrom", "LinearStep"}
WITHOUT_EXAMPLE = {
    *RESULTS,
    *GIVEN,
    *(name for name in SYMBOLS if name.startswith("Abstract") and name != "AbstractCoupling"),
    "StartLaw",
}

# Examples of more than about three seconds, most of which is compilation.
SLOW = {
    "Coupling",
    "GaussianTransition",
    "Guided",
    "Milstein",
    "ModifiedDiffusionBridge",
    "PoissonCounts",
    "ResidualBridge",
    "SemiImplicit",
    "Transformed",
    "extrapolate",
    "innovations",
    "log_likelihood",
    "smooth",
    "choose_proposal",
    "crank_nicolson",
    "expectation",
    "fit_start_law",
    "gaussian_bridge",
    "gibbs",
    "hitting_counts",
    "hitting_variation",
    "maximum_likelihood",
    "measure_burn_in",
    "path_log_likelihood",
    "plot.work_precision",
    "pmmh",
    "pseudo_marginal",
    "renewal",
    "smoothing_kernel",
    "sample_exact_bridges",
    "sample_events",
    "sample_exits",
    "sample_weighted_bridges",
    "score",
    "simulate",
    "simulation_based_calibration",
    "transition_log_density",
    "tune_coupling",
    "weigh_bridges",
    "work_precision",
}


def blocks(symbol):
    """The Python blocks of a docstring."""
    return re.findall(r"```python\n(.*?)```", inspect.getdoc(symbol) or "", re.DOTALL)


def explained(symbol):
    """What a docstring says of arguments, with the docstrings that it refers to."""
    text = symbol.__doc__
    for name in re.findall(r"(?:as in|those of) `(\w+)`", text):
        text += jb.__dict__[name].__doc__
    return text


@pytest.fixture(scope="module")
def taken_for_granted():
    """What the docstring of the package, and that of `plot`, say comes before the examples."""
    matplotlib.use("agg")
    namespace = {}
    for block in blocks(jb) + blocks(plot):
        exec(block, namespace)
    return namespace


@pytest.mark.parametrize("name", SYMBOLS)
def test_symbol_is_documented(name):
    symbol = SYMBOLS[name]
    text = symbol.__doc__
    assert re.match(r"\S.{20,}?[.:]\s", text + "\n", re.DOTALL), "no sentence"
    assert blocks(symbol) or name in WITHOUT_EXAMPLE, "no example"
    for function in RESULTS.get(name, ()):
        assert f"`{function}`" in text, f"does not name `{function}`"
    for argument in inspect.signature(symbol).parameters.values():
        if argument.kind not in (argument.VAR_POSITIONAL, argument.VAR_KEYWORD):
            if not argument.name.startswith("_"):
                assert f"`{argument.name}`" in explained(symbol), f"`{argument.name}` is not named"
    if inspect.isclass(symbol):
        for member, value in vars(symbol).items():
            if not member.startswith("_") and (callable(value) or isinstance(value, property)):
                assert inspect.getdoc(getattr(symbol, member)), f"`{member}` has no docstring"


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[pytest.mark.slow] if name in SLOW else [])
        for name in SYMBOLS
        if blocks(SYMBOLS[name])
    ],
)
def test_example_runs(name, taken_for_granted, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # where pictures are saved
    namespace = dict(taken_for_granted)
    # Optax's Adam raises a number to a whole one.
    promotion = "standard" if name == "maximum_likelihood" else "strict"
    with jax.numpy_dtype_promotion(promotion):
        for block in blocks(SYMBOLS[name]):
            exec(block, namespace)
    plt.close("all")
