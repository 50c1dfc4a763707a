"""Calls of all public functions with one malformed argument each: the outcome is a result, or a
refusal that names the argument."""

import functools
import inspect
import re

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from helpers import slow_beyond, zeros_of

import jaxbridge as jb

KEY = jax.random.key(0)
MODEL, LINE = jb.ornstein_uhlenbeck([[1.0, 0.2], [0.0, 1.0]]), jb.ornstein_uhlenbeck([[1.0]])
FREE = jb.Diffusion(lambda x, p: -p * x, params=1.0)
INTERVAL = dict(model=MODEL, start=[0.0, 0.0], end=[1.0, 0.0], duration=1.0)
SHORT = dict(num_steps=4)
SEEN, GUIDED = jb.LinearGaussian(covariance=0.1), jb.Guided()
RECORD = dict(model=LINE, times=[0.0, 1.0, 2.0], observations=[[0.0], [0.5], [0.2]])
NOISY = dict(RECORD, observation=SEEN, num_steps=2)
RATE = dict(where=lambda params: params.B, num_steps=2, prior=jb.NormalPrior(1.0, 1.0))
FEW = dict(num_iterations=2, num_warmup=2)
CAUCHY = jb.Diffusion(lambda x, p: -x, lambda x, p: 1 + x**2)


def interval(call, **options):
    return lambda: (call, dict(INTERVAL, key=KEY, num_steps=4, **options))


@functools.cache
def zeros(call, **options):
    return zeros_of(lambda: call(key=KEY, **INTERVAL, **options))


def of_bridges(call, sampler=jb.sample_bridges, **options):
    """A call with bridges of a sampler."""

    def prepare():
        bridges = zeros(sampler, num_steps=4, num_bridges=30, **options)
        return call, dict(key=KEY, model=MODEL, bridges=bridges)

    return prepare


many = functools.partial(zeros, num_steps=4, num_bridges=30, proposal=GUIDED)
weighted = functools.partial(many, jb.sample_weighted_bridges)
chain = functools.partial(many, jb.sample_exact_bridges)
density = functools.partial(zeros, jb.transition_log_density, num_proposals=30, proposal=GUIDED)
method_of = lambda result, name: lambda: (getattr(result(), name), {})
small = lambda call, **arguments: lambda: (call, arguments)

# What is called, and with what: each of the arguments is replaced in turn.
CALLS = {
    "Diffusion": small(jb.Diffusion, drift=lambda x, p: -x),
    "Diffusion.drift": small(MODEL.drift, x=[0.0, 0.0]),
    "Diffusion.diffusion": small(MODEL.diffusion, x=[0.0, 0.0]),
    "Diffusion.reverse_drift": small(MODEL.reverse_drift, x=[0.0, 0.0]),
    "Diffusion.log_stationary": small(MODEL.log_stationary, x=[0.0, 0.0]),
    "Diffusion.sample_stationary": small(MODEL.sample_stationary, key=KEY),
    "Diffusion.reversibility_residual": small(MODEL.reversibility_residual, points=[[0.0, 0.0]]),
    "ornstein_uhlenbeck": small(jb.ornstein_uhlenbeck, B=[[1.0, 0.2], [0.0, 1.0]]),
    "hyperbolic": small(jb.hyperbolic, alpha=1.0, dim=2),
    "langevin": small(jb.langevin, log_density=lambda x, p: -x @ x),
    "stationary_diffusion": small(jb.stationary_diffusion, log_density=lambda x, p: -x @ x),
    "transform": small(jb.transform, model=FREE, forward=jnp.sinh, inverse=jnp.arcsinh),
    "lamperti": small(jb.lamperti, model=CAUCHY, at=0.0, reach=1.0, num_nodes=4),
    "simulate": small(
        jb.simulate, key=KEY, model=MODEL, x0=[0.0, 0.0], times=[0.0, 1.0], num_steps=2
    ),
    "Jumps": small(jb.Jumps, times=[0.0, 0.5], inputs=[1.0, 2.0]),
    "windings": small(jb.windings, point=[0.0, 1.0], periods=6.0),
    "fitzhugh_nagumo": small(jb.fitzhugh_nagumo),
    "underdamped_langevin": small(jb.underdamped_langevin, potential=lambda q, p: q @ q),
    "integrated": small(jb.integrated, model=LINE),
    "seasonal_ornstein_uhlenbeck": small(jb.seasonal_ornstein_uhlenbeck),
    "Coupling": small(jb.Coupling),
    "SignTest": small(jb.SignTest),
    "Stationary": small(jb.Stationary),
    "GaussianLaw": small(jb.GaussianLaw, mean=[0.0, 0.0], covariance=np.eye(2)),
    "GaussianLaw.log_density": small(
        jb.GaussianLaw([0.0, 0.0], np.eye(2)).log_density, x=[0.0, 0.0]
    ),
    "ModifiedDiffusionBridge": small(jb.ModifiedDiffusionBridge),
    "Guided": small(jb.Guided),
    "ResidualBridge": small(jb.ResidualBridge),
    "LinearGaussian": small(jb.LinearGaussian),
    "PoissonCounts": small(jb.PoissonCounts),
    "NegativeBinomialCounts": small(jb.NegativeBinomialCounts, size=2.0),
    "StudentT": small(jb.StudentT, scale=0.1),
    "LogNormal": small(jb.LogNormal, scale=0.1),
    "Censored": small(jb.Censored, scale=0.1, lower=-1.0),
    "Rounded": small(jb.Rounded, scale=0.1, width=1.0),
    "ObservationDensity": small(jb.ObservationDensity, log_density=lambda y, x, p: 0.0, guess=SEEN),
    "NormalPrior": small(jb.NormalPrior, mean=1.0, variance=1.0),
    "polar_rotation": small(jb.polar_rotation, sigma=jnp.eye(2), driven_sigma=jnp.eye(2)),
    "effective_sample_size": small(jb.effective_sample_size, draws=np.arange(8.0)),
    "potential_scale_reduction": small(jb.potential_scale_reduction, draws=np.ones((2, 8))),
    "pareto_k": small(jb.pareto_k, log_weights=list(range(30))),
    "ou_stationary": small(jb.ou_stationary, model=MODEL),
    "ou_transition": small(jb.ou_transition, model=MODEL, start=[0.0, 0.0], duration=1.0),
    "gaussian_bridge": small(jb.gaussian_bridge, **INTERVAL, times=[0.5]),
    "sample_bridges": interval(jb.sample_bridges),
    "sample_weighted_bridges": interval(jb.sample_weighted_bridges, proposal=GUIDED),
    "sample_exact_bridges": interval(jb.sample_exact_bridges),
    "transition_log_density": interval(jb.transition_log_density, proposal=GUIDED),
    "fit_start_law": interval(jb.fit_start_law),
    "measure_burn_in": small(
        jb.measure_burn_in, key=KEY, model=MODEL, end=[0.0, 0.0], duration=1.0
    ),
    "choose_proposal": interval(jb.choose_proposal),
    "tune_coupling": interval(jb.tune_coupling),
    "work_precision": lambda: (
        jb.work_precision,
        dict(INTERVAL, key=KEY, num_steps=(4,), num_bridges=10),
    ),
    "effects": small(jb.effects, model=MODEL),
    "pseudo_marginal": small(jb.pseudo_marginal, **INTERVAL),
    "renewal": small(jb.renewal, **INTERVAL),
    "crank_nicolson": small(jb.crank_nicolson, **INTERVAL),
    "weigh_bridges": of_bridges(jb.weigh_bridges),
    "hitting_counts": of_bridges(jb.hitting_counts),
    "hitting_variation": of_bridges(jb.hitting_variation, jb.sample_weighted_bridges),
    "expectation": lambda: (
        jb.expectation,
        dict(fn=lambda path: path[2], bridges=weighted(), model=MODEL),
    ),
    "extrapolate": lambda: (
        jb.extrapolate,
        dict(fine=density(num_steps=4), coarse=density(num_steps=2)),
    ),
    "WeightedBridges.mean": method_of(weighted, "mean"),
    "WeightedBridges.standard_error": method_of(weighted, "standard_error"),
    "WeightedBridges.step_error": method_of(weighted, "step_error"),
    "WeightedBridges.resample": lambda: (weighted().resample, dict(key=KEY, num_bridges=3)),
    "Chain.mean": method_of(chain, "mean"),
    "Chain.standard_error": method_of(chain, "standard_error"),
    "path_log_likelihood": small(
        jb.path_log_likelihood, model=MODEL, times=[0.0, 1.0], path=[[0.0, 0.0], [1.0, 0.0]]
    ),
    "sample_exits": small(
        jb.sample_exits,
        key=KEY,
        model=MODEL,
        start=[0.0, 0.0],
        duration=1.0,
        inside=lambda x: 2 - x[0],
        num_paths=4,
        num_runs=2,
        num_steps=3,
    ),
    "sample_events": small(
        jb.sample_events,
        key=KEY,
        model=MODEL,
        start=[0.0, 0.0],
        duration=1.0,
        event=lambda path: path[-1, 0] - 2,
        num_paths=4,
        num_runs=2,
        num_steps=3,
        num_moves=2,
    ),
    "log_survival": small(
        jb.log_survival,
        model=MODEL,
        times=[0.0, 1.0],
        path=[[0.0, 0.0], [1.0, 0.0]],
        inside=lambda x: 2 - x[0],
    ),
    "log_likelihood": small(jb.log_likelihood, key=KEY, **NOISY, num_particles=4),
    "forecast": small(jb.forecast, key=KEY, **NOISY, num_particles=4),
    "simulate_observations": small(jb.simulate_observations, key=KEY, **NOISY),
    "smooth": small(jb.smooth, key=KEY, **NOISY, num_draws=4, num_warmup=2),
    "smoothing_kernel": small(jb.smoothing_kernel, **NOISY),
    "innovations": small(jb.innovations, **NOISY),
    "gibbs": small(jb.gibbs, key=KEY, **RECORD, **RATE, num_iterations=2, proposal=GUIDED),
    "gibbs of a record": small(jb.gibbs, key=KEY, **RECORD, **RATE, **FEW, observation=SEEN),
    "pmmh": small(jb.pmmh, key=KEY, **RECORD, **RATE, **FEW, num_proposals=4, proposal=GUIDED),
    "pmmh of a record": small(jb.pmmh, key=KEY, **RECORD, **RATE, **FEW, observation=SEEN),
    "maximum_likelihood": small(
        jb.maximum_likelihood,
        key=KEY,
        **RECORD,
        where=RATE["where"],
        num_iterations=2,
        num_bridges=4,
        proposal=GUIDED,
    ),
    "maximum_likelihood of a record": small(
        jb.maximum_likelihood, key=KEY, **NOISY, where=RATE["where"], num_iterations=2
    ),
    "simulation_based_calibration": small(
        jb.simulation_based_calibration,
        key=KEY,
        **RECORD,
        sampler=jb.gibbs,
        prior=RATE["prior"],
        where=RATE["where"],
        observation=SEEN,
        num_simulations=2,
    ),
    "score": small(
        jb.score, key=KEY, **RECORD, where=RATE["where"], num_bridges=4, proposal=GUIDED
    ),
}
RAGGED = [[1.0], [1.0, 2.0]]
VALUES = {
    "None": None,
    "True": True,
    "0": 0,
    "-1": -1,
    "2.5": 2.5,
    "nan": np.nan,
    "inf": np.inf,
    "-inf": -np.inf,
    "1e300": 1e300,
    "2**70": 2**70,
    "-2**70": -(2**70),
    "10**400": 10**400,
    "1j": 1j,
    "a word": "word",
    "no word": "",
    "bytes": b"bytes",
    "an empty list": [],
    "an empty tuple": (),
    "ragged": RAGGED,
    "words": ["a", "b"],
    "None in a list": [None, 1.0],
    "an empty array": np.zeros(0),
    "an array without rows": np.zeros((0, 2)),
    "three axes": np.ones((2, 2, 2)),
    "five numbers": np.arange(5.0),
    "a matrix of 5": np.eye(5),
    "NaNs": np.full(2, np.nan),
    "rows of NaN": np.full((3, 2), np.nan),
    "negative numbers": -np.ones(2),
    "a negative matrix": -np.eye(2),
    "truth values": np.array([True, False]),
    "objects": np.array([object(), None]),
    "numbers as objects": np.array([1, 2.0], object),
    "strings": np.array(["1.0", "2.0"]),
    "half precision": np.ones(2, np.float16),
    "integers": np.array([1, 2]),
    "a scalar array": np.array(1.0),
    "a JAX array": jnp.ones(2),
    "complex numbers": np.array([1j, 0.0]),
    "a dict": {},
    "a dict of numbers": {"a": 1.0},
    "a set": {1.0},
    "a range": range(3),
    "a slice": slice(1),
    "an object": object(),
    "a class": jb.Coupling,
    "the module": jb,
    "an exception": ValueError("x"),
    "a key": KEY,
    "a function of none": lambda: 0.0,
    "a function of one": lambda a: a,
    "a function of two": lambda a, b: a,
    "a function of five": lambda a, b, c, d, e: a,
    "a function to None": lambda *args: None,
    "a function to words": lambda *args: "word",
    "a function to a number": lambda *args: 0.0,
    "a function to NaN": lambda *args: np.nan,
    "a function to five": lambda *args: jnp.ones(5),
    "a function beyond": lambda x, *args: x[50],
    "a number's function": np.linalg.norm,
    "a model of five dimensions": jb.ornstein_uhlenbeck(np.eye(5)),
    "a model without noise in x": jb.fitzhugh_nagumo(),
    "a model of time": jb.seasonal_ornstein_uhlenbeck(),
    "a coupling": jb.Coupling(0.0),
    "a proposal": jb.Guided(),
    "a prior": jb.NormalPrior(1.0, 1.0),
    "an observation model": jb.LinearGaussian([[1.0, 0.0, 0.0]], 0.1),
    "a law": jb.GaussianLaw(np.zeros(5), np.eye(5)),
    "an optimiser": optax.adam(0.1),
    "a scheme": jb.Heun(),
}


OF_FUNCTIONS = [name for name in VALUES if name.startswith(("a function", "a model", "a number's"))]
# Choices that look at numbers.
NOT_TRACED = {
    "fit_start_law",
    "choose_proposal",
    "tune_coupling",
    "simulation_based_calibration",
}
# Names that a sentence may blame in the place of the argument.
OF_A_MODEL = {"drift", "diffusion", "log_stationary", "x"}


class Reached(BaseException):
    """Raised in the place of the first compiled program: nothing was refused before it."""


def reached(*_):
    raise Reached


def arguments_of(call):
    """The names of a function's public arguments."""
    return [name for name in inspect.signature(call).parameters if not name.startswith("_")]


def fault_of(call, arguments, name, value):
    """Return the fault of a call with one argument replaced, `None` where there is none."""
    try:
        call(**(arguments | {name: value}))
    except Reached:
        return None
    except (ValueError, TypeError) as error:
        internal = re.search("Tracer|jaxlib|jaxpr|positional argument|HloModule", str(error))
        named = re.findall(r"\w+", " ".join(re.findall("`([^`]*)`", str(error))))
        if internal or not OF_A_MODEL.union(arguments_of(call)).intersection(named):
            return f"{type(error).__name__}: {error}"
    except Exception as error:
        return f"{type(error).__name__}: {error}"
    return None


def faults(call, values_of, monkeypatch, traced=False):
    """Return all faults of a call, given the names of the values for the i-th argument."""
    call, arguments = CALLS[call]()
    if not traced:
        monkeypatch.setattr("jaxbridge.engine.compiled.mind_memory_maps", reached)
    found = []
    for i, name in enumerate(arguments_of(call)):
        for value in values_of(i):
            look = lambda name=name, value=value: found.append(
                (name, value, fault_of(call, arguments, name, VALUES[value]))
            )
            jax.eval_shape(look) if traced else look()
    return [(name, value, fault) for name, value, fault in found if fault is not None]


# NumPy and JAX warn of some values before they refuse them.
pytestmark = [pytest.mark.usefixtures("unchecked"), pytest.mark.filterwarnings("ignore")]


@pytest.mark.parametrize("call", CALLS)
def test_some_malformed_arguments(call, monkeypatch):
    """Of each argument every thirtieth value, each time others."""
    shift = list(CALLS).index(call)
    assert not faults(call, lambda i: list(VALUES)[(7 * shift + i) % 30 :: 30], monkeypatch)


@pytest.mark.slow
@pytest.mark.parametrize("call", CALLS)
def test_malformed_arguments(call, monkeypatch):
    """Of each argument every ninth value, each time others."""
    shift = list(CALLS).index(call)
    assert not faults(call, lambda i: list(VALUES)[(shift + i) % 9 :: 9], monkeypatch)


@pytest.mark.slow
@pytest.mark.parametrize("call", [call for call in CALLS if call not in NOT_TRACED])
def test_malformed_functions_and_models(call, monkeypatch):
    """Which are seen when programs are traced: of each argument every ninth, each time others."""
    shift = list(CALLS).index(call)
    values_of = lambda i: OF_FUNCTIONS[(shift + i) % 9 :: 9]
    with jax.numpy_dtype_promotion("standard"):  # as optax asks for
        assert not faults(call, values_of, monkeypatch, traced=True)


# Calls that return estimates: what is malformed and taken all the same is run.
ESTIMATES = {
    name: CALLS[name]
    for name in [
        "transition_log_density",
        "sample_weighted_bridges",
        "sample_exact_bridges",
        "log_likelihood",
        "smooth",
        "score",
        "gibbs of a record",
        "pmmh",
        "maximum_likelihood",
    ]
}
NUMBERS = [np.nan, np.inf, -1.0, 0.0, 1e-30, 1e19, 1e38, 1e300]


def with_number(arguments, value):
    """The arguments of a call, with this value in the place of one number each time."""
    model = arguments["model"]
    for name in ("B", "mean"):
        number = jnp.full_like(getattr(model.params, name), value)
        yield (
            f"params.{name}",
            {"model": model.with_params(model.params._replace(**{name: number}))},
        )
    if "end" in arguments:
        yield "start", {"start": [value, 0.0]}
        yield "duration", {"duration": value}
    else:
        yield "times", {"times": [0.0, value, 2 * value]}
        yield "observations", {"observations": [[0.0], [value], [0.2]]}
        yield "units", {"observations": value * np.array(RECORD["observations"])}
    if "observation" in arguments:
        yield "covariance", {"observation": lambda: jb.LinearGaussian(covariance=value)}


def main_number(result):
    """The number that was asked for."""
    for name in ("gradient", "theta", "value"):
        if hasattr(result, name):
            return getattr(result, name)
    return result.mean()


@pytest.mark.slow
@pytest.mark.parametrize("call", ESTIMATES)
def test_outcomes_of_malformed_numbers(call):
    """An estimate that is not finite is not trustworthy, and what is refused is named. Each number
    stands in every ninth place, each in others."""
    shift = list(ESTIMATES).index(call)
    call, arguments = ESTIMATES[call]()
    wrong = []
    for i, value in enumerate(NUMBERS):
        for name, changed in list(with_number(arguments, value))[(shift + i) % 9 :: 9]:
            try:
                made = {k: each() if callable(each) else each for k, each in changed.items()}
                with jax.numpy_dtype_promotion("standard"):  # as optax asks for
                    result = call(**(arguments | made))
                finite = np.all(np.isfinite(main_number(result)))
                if not finite and np.all(result.trustworthy):
                    wrong.append((name, value, "not finite, and trusted"))
            except (ValueError, TypeError) as error:
                if "`" not in str(error):
                    wrong.append((name, value, f"{type(error).__name__}: {error}"))
            except Exception as error:
                wrong.append((name, value, f"{type(error).__name__}: {error}"))
    assert not wrong


# Functions that a model, an observation model or a coupling holds, each in a call that evaluates
# it, beside the name that the refusal must have.
def drift(x, p):
    return -p * x


def log_nu(x, p):
    return -p * x @ x


def of_record(function, **changed):
    """A call for a record of this model."""
    given = {"initial": [0.0]} | changed
    return jb.log_likelihood(KEY, **(NOISY | given | {"model": function}), num_particles=4)


def held_by_model(**functions):
    return jb.Diffusion(**({"drift": drift, "params": 1.0} | functions))


def seen_as(function):
    observation = jb.ObservationDensity(lambda y, x, p, t: function(y, x, p), guess=SEEN)
    return of_record(held_by_model(), observation=observation)


def of_points(model, call=jb.sample_bridges, **options):
    return call(KEY, model, [0.0, 0.0], [1.0, 0.0], 1.0, num_steps=4, num_bridges=8, **options)


def coupled(sigma=None, **options):
    model = jb.Diffusion(drift, sigma, log_nu, 1.0)
    return of_points(model, coupling=jb.Coupling(**options))


full_sigma = lambda x, p: jnp.eye(2) + jnp.outer(x, x)
bent_log_nu = lambda x, p: -p * x @ x + jnp.sum(jnp.cos(x))
mapped = lambda forward, inverse: of_points(
    jb.transform(jb.Diffusion(drift, None, log_nu, 1.0), forward, inverse).model
)
HELD = {
    "drift": lambda f: of_record(held_by_model(drift=f)),
    "diffusion": lambda f: of_record(held_by_model(diffusion=f)),
    "domain": lambda f: of_record(held_by_model(domain=f)),
    # What it returns is for the drift to use.
    "prepare": lambda f: of_record(held_by_model(prepare=f)),
    "log_stationary": lambda f: of_record(held_by_model(log_stationary=f), initial=jb.Stationary()),
    "covariance": lambda f: of_record(held_by_model(), observation=jb.LinearGaussian(covariance=f)),
    "log_density": seen_as,
    "reverse_drift": lambda f: of_points(held_by_model(reverse_drift=f, log_stationary=log_nu)),
    "sample_stationary": lambda f: jb.simulate(
        KEY, held_by_model(sample_stationary=f), None, [0.0, 1.0], num_steps=2
    ),
    "gamma": lambda f: coupled(gamma=f),
    "rotation": lambda f: coupled(full_sigma, rotation=f),
    "forward": lambda f: mapped(f, jnp.arcsinh),
    "inverse": lambda f: mapped(jnp.sinh, f),
    "log_density of `langevin`": lambda f: of_points(jb.langevin(f)),
    "temperature": lambda f: of_points(jb.langevin(bent_log_nu, 1.0, temperature=f)),
    "V": lambda f: of_points(jb.stationary_diffusion(log_nu, V=f, params=1.0)),
    "Q": lambda f: of_points(jb.stationary_diffusion(log_nu, Q=f, params=1.0)),
    "potential": lambda f: jb.underdamped_langevin(f).drift([0.0, 1.0]),
    "constraint": lambda f: jb.pmmh(
        KEY, **RECORD, **RATE, **FEW, num_proposals=4, proposal=GUIDED, constraint=f
    ),
}


def raises_of_its_own(*args):
    raise OSError("a file is missing")


RETURNED = {
    "None": lambda *args: None,
    "words": lambda *args: "word",
    "five": lambda *args: jnp.ones(5),
    "a tensor": lambda *args: jnp.ones((2, 2, 2)),
    "beyond": lambda *args: args[0][50, 50, 50],
    "no attribute": lambda *args: args[0].nothing,
    "complex": lambda *args: args[0] * 1j,
    "another error": raises_of_its_own,
    "NumPy's": lambda *args: np.linalg.norm(args[0]),
    "a branch": lambda *args: args[0] if jnp.sum(jnp.asarray(args[0])) > 0 else -args[0],
}
# A dimension that is another one than that of the record, which may be what is wrong.
MORE_NAMES = {
    "prepare": {"drift", "observations"},
    "drift": {"observations"},
    "diffusion": {"observations"},
}
# A point of five dimensions, where none are known.
ACCEPTED = {("sample_stationary", "five")}


@pytest.mark.parametrize("name", slow_beyond(2, list(HELD)))
def test_functions_that_are_held(name):
    """The refusal has the name of the function, whatever is wrong with what it returns."""
    wrong = {}
    for what, function in RETURNED.items():
        try:
            jax.eval_shape(functools.partial(HELD[name], function))
            if (name, what) not in ACCEPTED:
                wrong[what] = "accepted"
        except (ValueError, TypeError) as error:
            names = {name.split()[0]} | MORE_NAMES.get(name, set())
            if not any(f"`{name}`" in str(error) for name in names):
                wrong[what] = f"{type(error).__name__}: {error}"
        except Exception as error:
            wrong[what] = f"{type(error).__name__}: {error}"
    assert not wrong


def test_all_functions_are_called():
    functions = {name for name in jb.__all__ if inspect.isfunction(getattr(jb, name))}
    assert functions <= {*CALLS, "no_rotation", "published_rotation"}  # as `polar_rotation`
