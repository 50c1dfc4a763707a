"""Functions of one point over lanes: the results of `vmap`, without interleaved arrays."""

import re

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

import jaxbridge as jb
from jaxbridge.coupling.join import Inputs, propose
from jaxbridge.engine.lanes import compute_once, join_rows, over_lanes, over_points, split_rows
from jaxbridge.engine.linalg import cholesky, inverse, polar_factor, safe_norm
from jaxbridge.models.bridge_problem import Intervals
from jaxbridge.proposals.coupled import pair_log_weights

B = np.array([[1.5, 1.0, 0.2], [0.3, -1.0, 1.5], [0.0, 0.5, 2.0]])


def _matrix(x):
    return jnp.stack([jnp.stack([x[i] * x[j] + float(i == j) for j in range(3)]) for i in range(3)])


@jax.custom_jvp
def _softened(x):
    return jnp.sqrt(1 + x * x)


_softened.defjvp(lambda primals, tangents: (_softened(*primals), 3 * tangents[0]))


def _energy(x):
    return _softened(x[0]) * (x @ x) - jnp.sum(jnp.where(x > 0, x**3, jnp.sin(x)))


FUNCTIONS = {
    "linear": lambda x: -jnp.asarray(B, x.dtype) @ (x - 1),
    "hyperbolic": lambda x: -0.8 * x / jnp.sqrt(1 + x @ x),
    "vector times matrix": lambda x: x @ jnp.asarray(B, x.dtype),
    "outer": lambda x: jnp.outer(x, x) @ x,
    "scalar": lambda x: x @ x,
    "constant": lambda x: jnp.ones(3, x.dtype),
    "where": lambda x: jnp.where(x > 0, jnp.sin(x), 1 / (1 + x * x)),
    "reductions": lambda x: jnp.stack([x.sum(), x.max(), x.min(), jnp.prod(x), x.mean()]),
    "any": lambda x: (jnp.any(x > 1), jnp.all(jnp.isfinite(x)), jnp.argmax(x)),
    "stacked": lambda x: jnp.concatenate([x[::-1], jnp.stack([x[0] * x[1], -x[2]]), x[1:]]),
    "side by side": lambda x: jnp.stack([x, x * x, jnp.ones(3, x.dtype)], axis=1) @ x,
    "padded": lambda x: lax.pad(jnp.outer(x, x[:2]), x[2], [(1, 2, 1), (-1, 3, 0)]),
    "moved": lambda x: jnp.broadcast_to(x[:, None], (3, 2)).T.reshape(-1)[::2],
    "column by column": lambda x: jnp.outer(x, jnp.arange(2.0, dtype=x.dtype)).reshape(
        -1, order="F"
    ),
    "row by row": lambda x: jnp.stack([sum(jnp.unstack(_matrix(x), axis=1)), *[x * a for a in x]]),
    "nothing": lambda x: (jnp.sum(x[3:] ** 2), x[3:] @ x[3:], x[:0]),
    "extremes": lambda x: (jnp.maximum(x, 0.5), jnp.clip(x, -0.1, 0.2), jax.nn.logsumexp(x)),
    "roll": lambda x: jnp.roll(x, 1) - jnp.diff(x, append=x[:1]),
    "set": lambda x: x.at[1].set(x[0]).at[2].add(2.0),
    "norm": lambda x: safe_norm(x - x),
    "matrix": lambda x: inverse(_matrix(x)) @ cholesky(_matrix(x)),
    "polar": lambda x: polar_factor(_matrix(x)),
    "einsum": lambda x: jnp.einsum("ij,jk,k->i", _matrix(x), jnp.asarray(B, x.dtype), x),
    "batched product": lambda x: jnp.einsum("ij,ij->i", _matrix(x), _matrix(2 * x)),
    "relu": lambda x: jax.nn.relu(x) + jax.nn.softplus(x) + jax.nn.sigmoid(x),
    "own derivative": _softened,
    "cond": lambda x: lax.cond(x[0] > 0, lambda y: y * y, lambda y: jnp.cos(y), x),
    "loop": lambda x: lax.fori_loop(0, 4, lambda i, y: y - 0.1 * jnp.sin(y), x),
    "scan": lambda x: lax.scan(lambda c, b: (c + b @ x, c), x[0], jnp.asarray(B, x.dtype)),
    "traced index": lambda x: x[jnp.argmax(jnp.abs(x))] * x[jnp.array([2, 0])],
    "gradient": jax.grad(_energy),
    "hessian": jax.hessian(_energy),
    "jacobian": lambda x: jax.jacfwd(lambda y: jnp.asarray(B, y.dtype) @ jnp.tanh(y))(x),
    "converted": lambda x: (x > 0).astype(jnp.int32) + jnp.round(x).astype(jnp.int32),
    "special": lambda x: jax.scipy.special.gammaln(1 + x * x) + jax.scipy.special.erf(x),
}


def _points(lanes=7, seed=0):
    return jax.random.normal(jax.random.key(seed), (3, lanes))


def _assert_close(got, wanted):
    def check(got, wanted):
        assert got.shape == wanted.shape and got.dtype == wanted.dtype
        tolerance = 1e-12 if wanted.dtype == jnp.float64 else 2e-5
        np.testing.assert_allclose(got, wanted, rtol=tolerance, atol=tolerance)

    jax.tree.map(check, got, wanted)


@pytest.mark.parametrize("name", FUNCTIONS)
def test_equals_vmap(name, precision):
    function, x = FUNCTIONS[name], _points()
    wanted = jax.jit(jax.vmap(function, in_axes=-1, out_axes=-1))(x)
    _assert_close(jax.jit(over_lanes(-1)(function))(x), wanted)


@pytest.mark.parametrize("name", sorted(set(FUNCTIONS) - {"any", "converted", "constant"}))
@pytest.mark.slow
def test_derivatives_equal_those_of_vmap(name):
    function, x, tangent = FUNCTIONS[name], _points(), _points(seed=1)
    by_lanes, by_vmap = over_lanes(-1)(function), jax.vmap(function, in_axes=-1, out_axes=-1)
    jvp = lambda f: jax.jit(lambda x, tangent: jax.jvp(f, (x,), (tangent,)))(x, tangent)
    _assert_close(jvp(by_lanes), jvp(by_vmap))
    total = lambda f: lambda x: sum(jnp.sum(jnp.sin(leaf)) for leaf in jax.tree.leaves(f(x)))
    if name != "set":
        grad = lambda f: jax.jit(jax.grad(total(f)))(x)
        _assert_close(grad(by_lanes), grad(by_vmap))


@pytest.mark.parametrize("d", [2, 8])  # coordinate by coordinate, and array by array
@pytest.mark.parametrize("density", [jb.EulerDensity(), jb.ItoTaylorDensity()])
def test_every_equation_of_a_step_has_a_rule(density, d, monkeypatch):
    """To go through `vmap` is right, but several times slower: new primitives would show."""
    model = jb.langevin(lambda x, p: -jnp.sum(x**4) - x[0] * x[1])

    def refuse(jaxpr, equation, *_):
        raise AssertionError(equation.primitive.name)

    def step(x, xi):
        law = density.steps_from(model.forward(x), x).law(jnp.array(0.1))
        return law.log_relative(law.point(xi))

    monkeypatch.setattr("jaxbridge.engine.lanes._by_vmap", refuse)
    x = jnp.ones((d, 16))
    assert over_lanes(-1, -1)(step)(x, x).shape == (16,)


def test_derivatives_by_what_the_function_closes_over():
    x = _points()

    def loss(over, matrix):
        step = over(lambda x: jnp.tanh(matrix @ x) * matrix[0, 1])
        return jnp.sum(lax.scan(lambda x, _: (step(x), None), x, length=3)[0] ** 2)

    matrices = jnp.stack([jnp.asarray(B, x.dtype), jnp.asarray(B.T, x.dtype)])
    over_vmap = lambda function: jax.vmap(function, in_axes=-1, out_axes=-1)
    got, wanted = [
        jax.jit(jax.vmap(jax.grad(lambda matrix: loss(over, matrix))))(matrices)  # noqa: B023
        for over in (over_lanes(-1), over_vmap)
    ]
    _assert_close(got, wanted)


def test_trees_of_arguments_and_what_lanes_share():
    x, dt = _points(), jnp.arange(1.0, 8.0)
    tree = {"own": x[:2], "shared": jnp.ones(3), "nothing": None}
    axes = {"own": -1, "shared": None, "nothing": None}

    @over_lanes(-1, axes, None, None, -1)
    def function(x, tree, flag, i, dt):
        assert flag is True
        return {"a": x * tree["shared"] * dt + i.astype(x.dtype), "b": (tree["own"], i, None)}

    made = jax.jit(lambda i: function(x, tree, True, i, dt))(jnp.int32(2))
    _assert_close(made["a"], x * dt + 2)
    _assert_close(made["b"][0], x[:2])
    _assert_close(made["b"][1], jnp.full(7, 2, jnp.int32))


def test_long_sums_are_not_written_out():
    function = lambda x: jnp.sin(jnp.outer(x, jnp.arange(400.0))).sum(1)
    jaxpr = jax.make_jaxpr(over_lanes(-1)(function))(_points())
    assert len(jaxpr.jaxpr.eqns) < 20
    _assert_close(over_lanes(-1)(function)(_points()), jax.vmap(function, -1, -1)(_points()))


def test_rows():
    tree = (_points(), jnp.ones(7), None)
    _assert_close(join_rows(split_rows(tree)), tree)
    assert len(jax.tree.leaves(split_rows(tree))) == 4


@pytest.mark.parametrize(["scheme", "num_held"], [(jb.Euler(), 0), (jb.Heun(), 2)])
def test_steps_of_a_proposal_are_not_interleaved(scheme, num_held):
    """But for the predicted points of Heun's steps, each held once: in the reversed path, and in
    the one that is driven by it."""
    lanes, B = 6400, jnp.array([[1.5, 1.0], [1.0, 1.5]])
    model = jb.Diffusion(
        lambda x, p: -B @ x, log_stationary=lambda x, p: -x @ B @ x, reversible=True
    )
    points = jnp.zeros((2, lanes))
    intervals = Intervals(points, points, jnp.ones(lanes))
    inputs = Inputs(model, jb.Coupling(0.5, scheme=scheme), intervals)

    def run(keys):
        return propose(inputs, keys, 10)

    keys = jax.random.split(jax.random.key(0), lanes)
    text = jax.jit(run).lower(keys).compile().as_text()
    made_in_steps = [line for line in text.splitlines() if "while/body" in line]
    assert len(made_in_steps) > 50
    whole_points = r"= f32\[(6400,2|2,6400)\]\S* (fusion|concatenate|copy)\("
    whole = [line for line in made_in_steps if re.search(whole_points, line)]
    held = [line for line in whole if "dot_general" in line]
    # Each is a product, of what is joined in one fusion.
    assert len(held) == num_held and len(whole) <= 3 * num_held
    assert not any("[6400,2]" in line for line in whole)


def test_a_function_of_a_held_value_computes_that_once():
    """XLA's CPU compiler would compute it anew for each number that is read of it."""

    def nested(hold):
        def function(x):
            y = jnp.sum(jnp.sin(jnp.outer(jnp.arange(1.0, 7.0), x)), axis=0)
            return jnp.sum(jnp.cos(jnp.outer(jnp.arange(1.0, 7.0), hold(y))), axis=0)

        return jax.jit(over_lanes(-1)(function))

    held, plain = nested(compute_once), nested(lambda y: y)
    points = _points()
    _assert_close(held(points), plain(points))
    where_made = [
        re.findall(r"^(\S+ [^\n]*\{.*?)^\}", text, re.MULTILINE | re.DOTALL)
        for text in (f.lower(points).compile().as_text() for f in (held, plain))
    ]
    both = [[" sine(" in body and " cosine(" in body for body in bodies] for bodies in where_made]
    assert any(both[1]) and not any(both[0])
    for function in (held, plain):
        slope = jax.grad(lambda x, function=function: jnp.sum(function(x)))(points)
        _assert_close(slope, jax.grad(lambda x: jnp.sum(plain(x)))(points))


def test_infinite_numbers_do_not_reach_what_is_held_with_them():
    """And large and small numbers keep their value, and tangents theirs."""
    largest = jnp.finfo(jnp.float32).max
    points = jnp.array([[jnp.inf, 1.0], [-jnp.inf, largest], [-largest, 3e-38]]).T
    held = jax.jit(over_lanes(-1)(compute_once))(points)
    np.testing.assert_array_equal(held, points)
    slope = jax.grad(lambda x: jnp.sum(over_lanes(-1)(compute_once)(x)[1]))(points)
    np.testing.assert_array_equal(slope, [[0, 0, 0], [1, 1, 1]])


def test_what_is_held_can_be_tangents():
    """Reverse mode transposes them."""
    points = jnp.array([[1.0, 2.0], [3.0, 4.0]])
    (transposed,) = jax.linear_transpose(over_lanes(-1)(jax.lax.optimization_barrier), points)(
        points
    )
    np.testing.assert_array_equal(transposed, points)


@pytest.mark.slow
@pytest.mark.parametrize("width", [8, 16, 32])
def test_layers_of_a_network_are_products_of_matrices(width):
    """Written out, a layer has a term for each weight, of which the compiler makes derivatives."""
    network = eqx.nn.MLP(2, 2, width, 2, activation=jnp.tanh, key=jax.random.key(0))
    points = jax.random.normal(jax.random.key(1), (2, 5))

    def total(network, over):
        return jnp.sum(over(jax.grad(lambda x: jnp.sum(network(x))))(points) ** 2)

    slopes, expected = (
        eqx.filter_grad(total)(network, over)
        for over in (over_lanes(-1), lambda of_point: jax.vmap(of_point, -1, -1))
    )
    for one, other in zip(jax.tree.leaves(slopes), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-4, atol=1e-6)
    made = eqx.filter_make_jaxpr(eqx.filter_grad(total))(network, over_lanes(-1))[0]
    assert len(made.jaxpr.eqns) < 100 * width


@pytest.mark.optimised
def test_sums_of_features_at_very_many_points():
    """Of which XLA's CPU compiler (JAX 0.10.2) leaves those beyond the first 32,768 numbers
    uncomputed under `vmap`: six features at 8,000 points. In weights of bridges, and by itself."""
    rng = np.random.default_rng(0)
    W, shift = rng.normal(size=(6, 2)).astype(np.float32), rng.normal(size=6).astype(np.float32)
    points = rng.normal(size=(8000, 2)).astype(np.float32)
    log_nu = lambda x: jnp.sum(jnp.cos(jnp.sum(W * x, axis=1) + shift))
    expected = np.sum(np.cos(points @ W.T + shift), axis=1)
    np.testing.assert_allclose(jax.jit(over_points(log_nu))(points), expected, atol=1e-5)

    model = jb.Diffusion(lambda x, p: -x, log_stationary=lambda x, p: log_nu(x))
    weigh = jax.jit(lambda end, x: pair_log_weights(jb.Stationary(), model, end, x, jnp.ones(8000)))
    np.testing.assert_allclose(weigh(points, points), expected, atol=1e-5)
