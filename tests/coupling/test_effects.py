"""The table of decisions, held to the primitives of the traced program."""

import math
from collections import Counter

import jax
import jax.extend
import jax.numpy as jnp
import pytest
from helpers import slow_beyond
from jax.scipy.special import gammaln

import jaxbridge as jb
from jaxbridge.models.dynamics import is_linear

D, N = 3, 10


# Each effect has a primitive of its own here: digamma comes from the derivative of log ν alone,
# cosh from that of σ, argmax from elimination, atan2 from the rotation.
def drift(x, p):
    return -x


def log_density(x, p):
    return -jnp.sum(gammaln(2 + x**2))


def diagonal(x, p):
    return 2 + jnp.sinh(x) ** 2


def full(x, p):
    return jnp.diag(diagonal(x, p)) + 0.1 * jnp.sinh(x)[:, None]


def turn(sigma, driven_sigma):
    return jnp.eye(D) * jnp.cos(jnp.arctan2(sigma[0, 1], driven_sigma[0, 0]))


def model(sigma=None, **options):
    return jb.Diffusion(drift, sigma, log_density, **options)


def coupling(gamma=0.5, meeting=None, scheme=None, rotation=turn):
    return jb.Coupling(gamma, meeting, scheme or jb.Euler(), rotation)


CONSTANT = jnp.eye(D) + 0.1
SCENES = {
    "reflection": (model(reversible=True), coupling(-1.0, jb.SignTest())),
    "crossing": (model(reversible=True), coupling(-1.0)),
    "crossing, Heun": (model(reversible=True), coupling(-1.0, scheme=jb.Heun())),
    "own noise": (model(reversible=True), coupling(0.5)),
    "autodiff": (model(), coupling(-1.0)),
    "given reversal": (model(reverse_drift=drift), coupling(-1.0)),
    "constant": (model(CONSTANT), coupling()),
    "constant function": (model(lambda x, p: CONSTANT), coupling(scheme=jb.Heun())),
    "diagonal": (model(diagonal, reversible=True), coupling()),
    "diagonal, Heun": (model(diagonal, reversible=True), coupling(scheme=jb.Heun())),
    "full": (model(full, reversible=True), coupling()),
    "full, Heun": (model(full, reversible=True), coupling(scheme=jb.Heun())),
    "full, not turned": (model(full), coupling(rotation=jb.no_rotation)),
    "everything": (model(full), coupling(scheme=jb.Heun())),
}


def equations(jaxpr, in_loop=False):
    """All equations of a program, and whether each is inside a loop over time."""
    for equation in jaxpr.eqns:
        yield equation, in_loop
        inside = in_loop or equation.primitive.name == "scan"
        for value in jax.tree.leaves(equation.params, is_leaf=is_program):
            if is_program(value):
                yield from equations(getattr(value, "jaxpr", value), inside)


def is_program(value):
    return isinstance(value, jax.extend.core.ClosedJaxpr | jax.extend.core.Jaxpr)


def program_of(function):
    return list(equations(jax.make_jaxpr(function)(jax.random.key(0)).jaxpr))


def proposals(model, coupling, **options):
    def sample(key):
        return jb.sample_bridges(
            key, model, jnp.zeros(D), jnp.ones(D), 1.0, num_steps=N, coupling=coupling, **options
        ).paths

    return program_of(sample)


@pytest.mark.parametrize("name", SCENES)
def test_the_program_contains_what_the_table_says(name):
    scene, program = SCENES[name], proposals(*SCENES[name])
    table = jb.effects(*scene, at=jnp.zeros(D), num_steps=N)
    in_loops = Counter(eqn.primitive.name for eqn, in_loop in program if in_loop)
    assert table.reverse_drift.simulated == (in_loops["digamma"] > 0)
    assert table.solves.simulated == (in_loops["argmax"] > 0)
    assert table.triangular_root.simulated == (in_loops["rsqrt"] > 0)
    assert table.rotation.simulated == (in_loops["atan2"] > 0)
    derivative_of_sigma = table.divergence.simulated or table.stratonovich.simulated
    assert derivative_of_sigma == (in_loops["cosh"] > 0)
    normals, uniforms = drawn(program)
    assert normals == N * (D + table.independent_noise.simulated)
    assert uniforms == N * table.crossing_uniforms.simulated


def drawn(program):
    """Normal and uniform numbers that each lane draws."""
    bits = [eqn.params["shape"] for eqn, _ in program if eqn.primitive.name == "random_bits"]
    # All lanes of the normal ones; the rest of the bits is for uniform ones.
    normals = [eqn.outvars[0].aval.size for eqn, _ in program if eqn.primitive.name == "erf_inv"]
    num_lanes = num_lanes_of(program)
    return sum(normals) // num_lanes, sum(map(math.prod, bits)) - sum(normals) // num_lanes


def num_lanes_of(program):
    """How many lanes the reversed path has, whose noise is the first to be drawn."""
    first = next(eqn for eqn, _ in program if eqn.primitive.name == "erf_inv")
    return first.outvars[0].aval.size // (N * D)


def test_reflection_of_a_reversible_model_is_one_draw_a_step():
    """One normal number for each step and dimension, one uniform, no autodiff, no solve."""
    program = proposals(*SCENES["crossing"])
    assert drawn(program) == (N * D, N)
    names = {eqn.primitive.name for eqn, _ in program}
    assert not names & {"digamma", "cosh", "argmax", "atan2", "while_loop", "triangular_solve"}


def test_every_effect_is_seen_and_left_out_by_some_scene():
    tables = [jb.effects(*scene, at=jnp.zeros(D), num_steps=N) for scene in SCENES.values()]
    for name in ("reverse_drift", "divergence", "solves", "rotation", "independent_noise"):
        assert {getattr(table, name).simulated for table in tables} == {True, False}
    for name in ("crossing_uniforms", "stratonovich"):
        assert {getattr(table, name).simulated for table in tables} == {True, False}


def test_divergence_and_correction_are_told_apart():
    """Both differentiate σ; each alone is there in one scene of these two."""
    euler = jb.effects(*SCENES["full, not turned"], at=jnp.zeros(D))
    heun = jb.effects(*SCENES["full, Heun"], at=jnp.zeros(D))
    assert euler.divergence.simulated and not euler.stratonovich.simulated
    assert heun.stratonovich.simulated and not heun.divergence.simulated


@pytest.mark.parametrize("save_at", [None, [0.0, 0.5]])
def test_paths_are_stored_where_they_are_asked_for(save_at):
    scene = SCENES["crossing"]
    table = jb.effects(*scene, at=jnp.zeros(D), save_at=save_at)
    program = proposals(*scene, num_bridges=64, save_at=save_at)
    written = {
        out.aval.shape[0]
        for eqn, in_loop in program
        if in_loop and eqn.primitive.name.startswith("dynamic_update")
        for out in eqn.outvars
    }
    times = N + 1 if table.stored_times.simulated else len(save_at)
    assert written == {times + 1}  # there is a row for waste


@pytest.mark.parametrize("num_steps", [50, 200])
@pytest.mark.slow
def test_associated_paths_stop_early_where_the_table_says(num_steps):
    scene = SCENES["crossing"]
    table = jb.effects(*scene, at=jnp.zeros(D), num_steps=num_steps)
    ou, ends = jb.ornstein_uhlenbeck(jnp.eye(D)), (jnp.zeros(D), jnp.ones(D))
    heun = jb.Coupling(scheme=jb.Heun())  # exact steps have a loop of their own
    bridges = jb.sample_bridges(
        jax.random.key(0), ou, *ends, 1.0, num_steps=num_steps, coupling=heun
    )
    program = program_of(lambda key: jb.hitting_counts(key, ou, bridges).counts)
    loops = [eqn for eqn, _ in program if eqn.primitive.name == "while"]
    assert len(loops) == 1 + table.early_stop.simulated  # the search is one


def test_the_table_reads_well():
    table = jb.effects(jb.hyperbolic(0.8, 2), jb.Coupling(-1.0))
    text = str(table)
    assert len(text.splitlines()) == 1 + len(table._fields)
    assert "reverse drift" in text and "declared reversible" in text and "left out" in text


def test_steps_are_exact_for_linear_models():
    assert jb.effects(jb.ornstein_uhlenbeck([[1.0]])).exact_steps.simulated
    assert not jb.effects(jb.hyperbolic(0.8, 2)).exact_steps.simulated


def normal_density(x, p):
    return jax.scipy.stats.multivariate_normal.logpdf(x, jnp.zeros(2), jnp.eye(2) / 2)


@pytest.mark.parametrize(
    "log_density, exact",
    [(lambda x, p: -jnp.sum(x**2), True), (lambda x, p: -x @ x, True), (normal_density, False)],
)
def test_steps_are_exact_if_both_drifts_are_seen_to_be_linear(log_density, exact):
    """The drift of the reversed diffusion is derived from the density; the last one has a solve."""
    model = jb.Diffusion(lambda x, p: -x, jnp.eye(2), log_density)
    assert is_linear(model.backward(jnp.zeros(2)), jnp.zeros(2)) == exact
    assert jb.effects(model).corrector.simulated != exact


def test_the_dimension_is_found():
    three = jb.Diffusion(lambda x, p: -jnp.diag(jnp.arange(1.0, 4.0)) @ x, None, log_density)
    assert jb.effects(three).reverse_drift.simulated
    full_in_three = jb.Diffusion(drift, lambda x, p: full(x[:3], p), log_density)
    assert jb.effects(full_in_three).triangular_root.simulated


def partly(x, p):
    return jnp.stack([jnp.sinh(x[1]), -x[0] - x[1]])


def in_season(x, p, t):
    return partly(x, p) + jnp.sin(t)


COLUMN = jnp.array([[0.0], [0.5]])
RECORDS = {
    "constant": jb.Diffusion(partly, COLUMN),
    "of time": jb.Diffusion(in_season, COLUMN),
    "varying": jb.Diffusion(partly, lambda x, p: COLUMN * (1 + x[1] ** 2)),
    "of time, all": jb.Diffusion(in_season, lambda x, p: jnp.eye(2) * (2 + gammaln(2 + x[0] ** 2))),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", slow_beyond(1, RECORDS))
def test_steps_of_records_contain_what_the_table_says(name):
    """The derivatives of the drift's sinh and of σ's gamma function, and the sine of time."""
    scene, table = RECORDS[name], jb.effects(RECORDS[name])
    seen = jb.LinearGaussian([[1.0, 0.0]], 0.1)
    paths = jb.innovations(
        scene, [0.0, 0.5, 1.0], jnp.zeros((3, 1)), observation=seen, initial=[0.0, 0.0], num_steps=3
    )
    program = program_of(lambda key: paths.path(None, jax.random.normal(key, (paths.size,))))
    in_loops = Counter(eqn.primitive.name for eqn, in_loop in program if in_loop)
    drift_is_differentiated = table.noise_by_drift.simulated or table.quadratic_noise.simulated
    assert drift_is_differentiated == (in_loops["cosh"] > 0)
    assert table.quadratic_noise.simulated == (in_loops["digamma"] > 0)
    assert table.time.simulated == (in_loops["sin"] > 0)
    assert not table.rotation.simulated and "no coupling applies" in table.rotation.why
