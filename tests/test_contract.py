"""What every way in keeps, whatever it computes: one compiled program for all numbers, inside `jit`
and `vmap` as outside, the same numbers by the same key, an axis for intervals, the precision of
what is given."""

import inspect
from typing import NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import PAPER_B, count_compilations, paper_model, slow_beyond

import jaxbridge
import jaxbridge as jb

base_model = paper_model
PRIOR, SEEN = jb.NormalPrior(1.0, 1.0), jb.LinearGaussian(covariance=0.1)
SIZES = dict(num_bridges=30, num_steps=4)


class Numbers(NamedTuple):
    """What may change without compiling again."""

    key: jax.Array
    scale: jax.Array  # of the drift
    start: jax.Array
    end: jax.Array
    duration: jax.Array
    gamma: jax.Array

    @property
    def pairs(self):
        """A coupling, with a start law of its own."""
        dtype = self.scale.dtype
        law = jb.GaussianLaw(jnp.zeros(2, dtype), 0.4 * self.scale * jnp.eye(2, dtype=dtype))
        return jb.Coupling(self.gamma, start_law=law)

    @property
    def ends(self):
        model = base_model()
        B = self.scale * jnp.asarray(PAPER_B, self.scale.dtype)
        mean = model.params.mean.astype(B.dtype)
        changed = model.with_params(model.params._replace(B=B, mean=mean))
        return self.key, changed, self.start, self.end, self.duration

    @property
    def record(self):
        """A point of the start, one of the end, and back."""
        key, model, start, end, duration = self.ends
        times = duration * jnp.arange(3, dtype=duration.dtype)
        return key, model, times, jnp.stack([start, end, start])


def numbers(seed=0, dtype="float32"):
    shift = 0.1 * seed
    values = (1 + shift, [shift, 0.0], [0.3, 0.2 + shift], 0.5 + shift, 0.4 + shift)
    return Numbers(jax.random.key(seed), *(jnp.asarray(value, dtype) for value in values))


def bridges(given, **how):
    return jb.sample_bridges(*given.ends, **SIZES, coupling=given.pairs, **how)


def of_bridges(name, *options):
    return lambda given, **how: getattr(jb, name)(*given.ends[:2], bridges(given), *options, **how)


def expect(given):
    weighted = jb.sample_weighted_bridges(*given.ends, **SIZES, proposal=jb.Guided())
    return jb.expectation(lambda path: path[2], weighted, given.ends[1])


def chain(method, proposal=None):
    options = dict(SIZES, method=method)
    return lambda given, **how: jb.sample_exact_bridges(
        *given.ends, **options, proposal=given.pairs if proposal is None else proposal, **how
    )


def of_drift(name, **options):
    drift = dict(where=lambda params: params.B, num_steps=4)
    return lambda given, **how: getattr(jb, name)(*given.record, **drift, **options, **how)


BATCHED = {
    "sample_bridges": bridges,
    "weigh_bridges": of_bridges("weigh_bridges"),
    "hitting_counts": of_bridges("hitting_counts", 2),
}
OF_AN_INTERVAL = BATCHED | {
    "sample_weighted_bridges": lambda given, **how: jb.sample_weighted_bridges(
        *given.ends, **SIZES, proposal=jb.Guided(), **how
    ),
    "pseudo_marginal": chain("pseudo_marginal"),
    "renewal": chain("renewal"),
    "crank_nicolson": chain("crank_nicolson", jb.Guided()),
    "transition_log_density": lambda given, **how: jb.transition_log_density(
        *given.ends, num_proposals=30, num_steps=4, proposal=given.pairs, **how
    ),
    "expectation": expect,
}
OF_A_RECORD = {
    "gibbs": of_drift("gibbs", prior=PRIOR, num_iterations=2, proposal=jb.Coupling(0.5)),
    "pmmh": of_drift(
        "pmmh", prior=PRIOR, num_iterations=2, num_warmup=2, num_proposals=3, proposal=jb.Guided()
    ),
    "score": of_drift("score", num_bridges=3, proposal=jb.Guided()),
    "maximum_likelihood": of_drift(
        "maximum_likelihood", num_iterations=2, num_bridges=3, proposal=jb.Guided(), method="em"
    ),
    "log_likelihood": lambda given: jb.log_likelihood(
        *given.record, observation=SEEN, num_particles=3, num_filters=2, num_steps=4
    ),
    "smooth": lambda given, **how: jb.smooth(
        *given.record, observation=SEEN, num_draws=2, num_warmup=2, num_steps=4, **how
    ),
    "innovations": lambda given: jb.innovations(*given.record[1:], observation=SEEN, num_steps=4),
}
DOORS = OF_AN_INTERVAL | OF_A_RECORD
NO_METER = ("expectation", "log_likelihood", "innovations")
SILENT = (*NO_METER, "sample_weighted_bridges")  # what takes no search shows nothing
BOUNDS = {  # which are numbers too
    "sample_bridges": ["max_proposals"],
    "weigh_bridges": ["max_trials"],
    "hitting_counts": ["max_trials"],
    "pseudo_marginal": ["max_proposals", "max_trials"],
    "renewal": ["max_proposals"],
    "transition_log_density": ["max_trials"],
}
CHAINS = ("pseudo_marginal", "renewal", "crank_nicolson")
# One of those that make their programs alike.
MAPPED = (
    "sample_bridges", "sample_weighted_bridges", "transition_log_density", "expectation", "pmmh",
)  # fmt: skip


# Each hands the parameters on in a way of its own.
HANDED_ON = [
    "sample_bridges", "crank_nicolson", "pmmh",
]  # fmt: skip


class Guarded:
    """The package, its functions called where nothing may be transferred unasked, and where no NaN
    and no infinity may come out of a program."""

    def __getattr__(self, name):
        value = getattr(jaxbridge, name)
        if not inspect.isfunction(value):
            return value

        def guarded(*args, **kwargs):
            with jax.transfer_guard("disallow"), jax.debug_nans(True), jax.debug_infs(True):
                return value(*args, **kwargs)

        return guarded


def arrays(tree):
    """The numbers in it: keys are none."""
    numeric = lambda leaf: (
        eqx.is_array(leaf) and not jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)
    )
    return [leaf for leaf in jax.tree.leaves(tree) if numeric(leaf)]


def assert_same(made, expected):
    for one, other in zip(made, expected, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("name", slow_beyond(1, DOORS))
def test_numbers(name, capfd, monkeypatch):
    """Other numbers compile nothing, the same key gives the same numbers, and so it does inside
    `jit` and `vmap`, in batches of another size, with progress shown, and under guards."""
    run = lambda given, bound=100_000, **how: arrays(
        DOORS[name](given, **dict.fromkeys(BOUNDS.get(name, []), bound), **how)
    )
    first = jax.block_until_ready(run(numbers(0)))
    with count_compilations() as compiled, monkeypatch.context() as patch:
        second = run(numbers(1), 100_001)
        patch.setitem(globals(), "jb", Guarded())
        again = run(numbers(0))
    assert not compiled
    for one, other in zip(first, again, strict=True):
        np.testing.assert_array_equal(one, other)
    assert any(not np.array_equal(*pair) for pair in zip(first, second, strict=True))

    if name not in MAPPED:
        return
    how = {"batch_size": 7} if name in BATCHED else {}
    if name not in NO_METER:
        how["progress_meter"] = diffrax.TextProgressMeter(minimum_increase=0.2)
    both = jax.tree.map(lambda *each: jnp.stack(each), numbers(0), numbers(1))
    together = jax.jit(jax.vmap(lambda given: run(given, **how)))(both)
    for i, alone in enumerate((first, second)):
        assert_same([leaf[i] for leaf in together], alone)
    jax.effects_barrier()
    printed = capfd.readouterr().out
    assert name in SILENT or ("0.00%" in printed and "100.00%" in printed)


@pytest.mark.parametrize("of", ["model", "duration"])
def test_numbers_of_python_compile_what_arrays_do(of):
    """As an optimiser has them, who is given 0.8 and returns an array."""

    def run(number):
        kind = dict.fromkeys(("model", "duration"), jnp.float32(0.7)) | {of: number}
        model = jb.Diffusion(
            drift_of_number, log_stationary=potential_of_number, params=kind["model"]
        )
        run = jb.transition_log_density
        proposal = jb.ModifiedDiffusionBridge()
        return run(jax.random.key(0), model, [0.0], [1.0], kind["duration"], proposal=proposal)

    values = run(0.8).value
    with count_compilations() as compiled:
        again = run(jnp.float32(0.8)).value
    assert not compiled and again == values


def drift_of_number(x, p):
    return -p * x


def potential_of_number(x, p):
    return -p * x @ x


def test_what_is_missing_passes_guards():
    """Bridges that were not found, and -inf for their weights."""
    model = jb.ornstein_uhlenbeck([[1.0]])
    far = jnp.array([[0.5], [30.0]])
    key, start = jax.random.key(0), jnp.zeros(1)
    with jax.debug_nans(True), jax.debug_infs(True):
        found = jb.sample_bridges(key, model, start, far, 1.0, num_steps=4, max_proposals=64)
        weighted = jb.weigh_bridges(key, model, found, max_trials=64)
    assert found.met[0].all() and not found.met[1].any()
    assert np.isnan(found.paths[1]).all() and (weighted.log_weights[1] == -np.inf).all()


class WithNetwork(NamedTuple):
    """The paper's parameters, and what is no array."""

    B: jax.Array
    mean: jax.Array
    sigma: jax.Array
    network: eqx.nn.MLP
    name: str
    power: int

    @property
    def known(self):
        return paper_model().params._replace(B=self.B, mean=self.mean, sigma=self.sigma)


def drift_of_network(x, p):
    assert p.name == "linear" and p.power == 2 and isinstance(p.power, int)
    return paper_model().with_params(p.known).drift(x) + p.network(x)


def silent_network():
    """The paper's process, with a network in its drift that adds nothing."""
    network = eqx.nn.MLP(2, 2, 3, 1, key=jax.random.key(0))
    last = lambda net: (net.layers[-1].weight, net.layers[-1].bias)
    network = eqx.tree_at(last, network, jax.tree.map(jnp.zeros_like, last(network)))
    model = paper_model()
    return jb.Diffusion(
        drift_of_network,
        log_stationary=lambda x, p: model.with_params(p.known).log_stationary(x),
        params=WithNetwork(*model.params, network, "linear", 2),
        sample_stationary=lambda key, p: model.with_params(p.known).sample_stationary(key),
        normalised=True,
    )


def curved_model():
    """The paper's process without a network, and a drift that is not linear in form, as with it."""
    model = paper_model()
    return jb.Diffusion(
        lambda x, p: -p.B @ (x - p.mean) + 0 * x**3,
        log_stationary=lambda x, p: model.with_params(p).log_stationary(x),
        params=model.params,
        sample_stationary=lambda key, p: model.with_params(p).sample_stationary(key),
        normalised=True,
    )


@pytest.mark.slow
@pytest.mark.parametrize("name", HANDED_ON)
def test_parameters_may_hold_what_is_no_array(name, monkeypatch):
    """A network with its activation, a name, a whole number: all are what they were, and the
    numbers are those of the process without them."""

    def made_by(model):
        monkeypatch.setitem(globals(), "base_model", lambda: model())
        made = jax.tree_util.tree_leaves_with_path(DOORS[name](numbers()))
        own = [leaf for path, leaf in made if "network" not in jax.tree_util.keystr(path)]
        return [leaf for leaf in own if eqx.is_inexact_array(leaf)]

    assert_same(made_by(silent_network), made_by(curved_model))


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", slow_beyond(1, ["sample_bridges", "sample_weighted_bridges", *CHAINS])
)
def test_several_intervals_and_saved_times(name):
    """Intervals have a leading axis, each with its own numbers by its own key; `save_at` picks
    from the same paths, at the same shares of each."""
    several = numbers()._replace(
        start=jnp.array([[0.0, 0.0], [0.2, 0.1]]),
        end=jnp.array([[0.3, 0.2], [0.1, -0.3]]),
        duration=jnp.array([0.5, 0.8]),
    )
    both = DOORS[name](several, save_at=[0.0, 0.5, 1.0])
    assert both.paths.shape == (2, 30, 3, 2) and both.met.shape == (2, 30)
    np.testing.assert_allclose(both.times, several.duration[:, None] * np.array([0, 0.5, 1]))
    np.testing.assert_array_equal(both.paths[:, :, 0], np.stack(30 * [several.start], 1))
    np.testing.assert_array_equal(both.paths[:, :, 2], np.stack(30 * [several.end], 1))
    for i in range(2):
        mine = several._replace(
            start=several.start[i], end=several.end[i], duration=several.duration[i]
        )
        key = jax.random.fold_in(several.key, i) if name in CHAINS else several.key
        alone = DOORS[name](mine._replace(key=key))
        np.testing.assert_array_equal(both.paths[i, :, 0], alone.paths[:, 0])
        if i == 0 or name in CHAINS:
            np.testing.assert_allclose(both.paths[i], alone.paths[:, [0, 2, 4]], atol=1e-5)
            np.testing.assert_array_equal(both.met[i], alone.met)


@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize("name", slow_beyond(1, [*OF_AN_INTERVAL, "score"]))
def test_results_have_the_precision_of_what_is_given(name, dtype, x64):
    """Where both are enabled, and the γ of couplings has one of its own."""
    made = eqx.filter_eval_shape(DOORS[name], numbers(0, dtype))
    for path, leaf in jax.tree_util.tree_leaves_with_path(made):
        if jnp.issubdtype(getattr(leaf, "dtype", None), jnp.floating):
            assert leaf.dtype == dtype or jax.tree_util.keystr(path).endswith(".gamma")
        elif jnp.issubdtype(getattr(leaf, "dtype", None), jnp.integer):
            assert leaf.dtype == "int32"
