"""Several devices: the same numbers as on one, from lanes that are really split.

Each test is a process of its own, in which the CPU passes for eight devices.
"""

import pytest
from helpers import run_program

PRELUDE = """
import re
import jax, jax.numpy as jnp, jaxbridge as jb, numpy as np
from jax.sharding import AxisType, PartitionSpec as P
from jaxbridge.studies.paper import study_model

model, key = study_model(), jax.random.key(0)
a, b, durations = jnp.array([[0.0, 0.0], [0.5, 0.5], [1.0, -1.0]]), [1.0, 0.0], [1.0, 0.5, 2.0]
pulled = jb.ModifiedDiffusionBridge()

def meshes():
    two, eight = jax.devices()[:2], jax.devices()
    yield jax.make_mesh((2,), ("x",), devices=two)
    yield jax.make_mesh((4, 2), ("x", "y"), axis_types=(AxisType.Auto,) * 2, devices=eight)

def assert_same(this, other):
    for x, y in zip(jax.tree.leaves(this), jax.tree.leaves(other), strict=True):
        if jnp.issubdtype(x.dtype, jnp.floating):
            np.testing.assert_allclose(x, y, rtol=1e-4, atol=1e-5)
        else:
            np.testing.assert_array_equal(x, y)

def lane_counts(text):
    "From the shapes of paths of ten steps in two dimensions."
    return {int(n) for n in re.findall(r"<10x2x(\\d+)xf32>", text)}
"""


def run_on_eight_devices(program):
    run_program(PRELUDE + program, deadline=300, num_devices=8, in_haste=True)


@pytest.mark.slow
def test_same_numbers_on_one_two_and_eight_devices():
    run_on_eight_devices("""
def approximate(key):
    return jb.sample_bridges(
        key, model, a, b, durations, num_bridges=5, num_steps=10, batch_size=37
    )

alone = approximate(key)
for mesh in meshes():
    with jax.set_mesh(mesh):
        split = approximate(key)
    assert_same(alone, split)
    assert len(split.paths.devices()) == mesh.size
assert not np.allclose(alone.paths, approximate(jax.random.key(1)).paths, atol=0.1)
""")


@pytest.mark.slow
def test_every_device_simulates_its_share():
    """Paths in the lowered program are those of 40 / 2 and 40 / 8 lanes. Where the caller has
    split the intervals already, the lanes of a device stay there."""
    run_on_eight_devices("""
def paths(start):
    return jb.sample_bridges(key, model, start, b, 1.0, num_steps=10, batch_size=40).paths

def draws(start):
    return jb.sample_weighted_bridges(
        key, model, start, b, 1.0, num_bridges=40 // len(start), num_steps=11, proposal=pulled
    ).paths

def lanes(sample, start):
    return lane_counts(jax.jit(sample).lower(start).as_text())

starts = jnp.zeros((8, 2))
assert lanes(paths, starts) == {40}
for mesh in meshes():
    with jax.set_mesh(mesh):
        assert lanes(paths, starts) == {40 // mesh.size}
text = lambda starts: jax.jit(draws).lower(starts).as_text()
assert "<10x40xf32>" in text(starts) and "<10x40xf32>" in text(starts[:1])
with jax.set_mesh(mesh):
    assert "<10x5xf32>" in text(starts) and "<10x40xf32>" not in text(starts)
    assert "<10x5xf32>" in text(starts[:1]) and "<10x40xf32>" not in text(starts[:1])
by_hand = jax.shard_map(
    paths, mesh=mesh, in_specs=P(("x", "y")), out_specs=P(("x", "y")), check_vma=False
)
assert lanes(by_hand, starts) == {40}
""")


@pytest.mark.slow
def test_same_numbers_from_everything_else():
    run_on_eight_devices("""
settings = dict(num_steps=10)
approximate = jb.sample_bridges(key, model, a, b, durations, num_bridges=3, **settings)
density = lambda start, proposal: jb.transition_log_density(
    key, model, start, b, 0.5, num_proposals=20, proposal=proposal, **settings
)

@jax.jit
def everything(start):
    return (
        jb.weigh_bridges(key, model, approximate),
        density(start, jb.Coupling()),
        jax.value_and_grad(lambda start: density(start, pulled).value)(start),
    )

alone = everything(a[0])
*_, mesh = meshes()
with jax.set_mesh(mesh):
    split = everything(a[0])
assert_same(alone, split)
""")


@pytest.mark.slow
def test_numbers_that_devices_share_by_their_type():
    """Along explicit axes the type of an array says how it is split: end points, observations and
    parameters, with the mesh in force and in a program, or without."""
    run_on_eight_devices("""
mesh = jax.make_mesh((2, 4), ("x", "y"), axis_types=(AxisType.Explicit,) * 2)
wide = lambda params: jb.Diffusion(
    lambda x, p: -p @ x, log_stationary=lambda x, p: -x @ p @ x, params=params
)
split = lambda x: jax.device_put(x, jax.NamedSharding(mesh, P("x")))
points = np.random.default_rng(0).normal(size=(8, 2)).astype(np.float32)
times, seen = np.arange(8.0), jb.LinearGaussian(covariance=0.1)

def everything(params, points):
    model = wide(params)
    record = dict(observation=seen, initial=jnp.zeros(2), num_steps=4)
    return (
        jb.transition_log_density(
            key, model, points, points, 0.2, num_proposals=20, num_steps=10, proposal=pulled
        ),
        jb.log_likelihood(key, model, times, points, num_particles=8, num_filters=2, **record),
        jb.path_log_likelihood(model, times, points),
    )

alone = everything(np.eye(2, dtype=np.float32), points)
given = split(jnp.eye(2)), split(points)
assert_same(alone, everything(given[0], points))
with jax.set_mesh(mesh):
    assert_same(alone, jax.jit(everything)(*given))
""")


@pytest.mark.slow
def test_batches_along_the_default_axes_of_a_mesh():
    """These are explicit. JAX has no `vmap` of some loops there, even of its own."""
    run_on_eight_devices("""
mesh = jax.make_mesh((8,), ("x",))
points = np.random.default_rng(0).normal(size=(8, 2)).astype(np.float32)
split = jax.device_put(points, jax.NamedSharding(mesh, P("x")))

def density(end):  # the rest of the result is rounding of this exact law
    options = dict(num_proposals=20, num_steps=4, proposal=jb.Guided())
    return jb.transition_log_density(key, model, a[0], end, 0.5, **options).value

def total(ends):
    return jnp.sum(jax.vmap(lambda end: density(end) + end[0])(ends))

over_batch, slope = jax.jit(jax.vmap(density)), jax.jit(jax.grad(total))
alone = over_batch(points), slope(points)
assert_same(alone, (over_batch(split), slope(split)))
with jax.set_mesh(mesh):
    assert_same(alone, (over_batch(split), slope(split)))
    assert over_batch(split).sharding.spec == P("x")
""")
