"""What is malformed is refused, before anything runs, with a sentence that says what to change."""

import functools
import itertools

import cir
import diffrax
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import optax
import pytest
from helpers import chosen_of, of_unknown_constant, paper_model, zeros_of
from inference_oracles import ou_1d

import jaxbridge as jb
from jaxbridge import plot
from jaxbridge.coupling.start_laws import as_start_law
from jaxbridge.proposals.auto import as_proposal, choice_between
from jaxbridge.records import as_observations

KEY, A, B, X, NAN = jax.random.key(0), [0.0, 0.0], [1.0, 0.0], jnp.ones(2), np.nan
TIMES, POINTS, LINE = [0.0, 1.0, 2.0], [[0.0, 0.0], [0.5, 0.2], [0.1, 0.3]], [[0.0], [0.5], [1.0]]
PAPER, HYPERBOLIC, OU = paper_model(), jb.hyperbolic(0.8, 2), jb.ornstein_uhlenbeck([[1.0]])
ROTATING = jb.ornstein_uhlenbeck([[1.2, 0.7], [-0.4, 0.9]], sigma=[[0.8, 0.2], [0.0, 1.1]])
DECAY, LOG_NORMAL, ROOT = lambda x, p: -x, lambda x, p: -x @ x, lambda x, p: jnp.sqrt(x)
FREE, VARYING = jb.Diffusion(DECAY), jb.Diffusion(DECAY, lambda x, p: 1 + x**2)
BLIND, NO_SAMPLER = jb.Diffusion(DECAY, reversible=True), jb.Diffusion(DECAY, None, LOG_NORMAL)
LAW, PRIOR = jb.GaussianLaw(A, jnp.eye(2)), jb.NormalPrior(1.0, 1.0)
BRIDGE, GUIDED, PAIRS = jb.ModifiedDiffusionBridge(), jb.Guided(), jb.Coupling(0.0)
TAYLOR = jb.ModifiedDiffusionBridge(jb.ItoTaylorDensity())
FUNCTION = "must be a function"


def of(call, *arguments, **options):
    """What prepares a call, once it is told which of these arguments to change."""
    return lambda *more, **changed: lambda: call(*arguments, *more, **(options | changed))


def each(what, call, values, *said):
    """A row for each of the values that a call may not be given."""
    return [(f"{what} {i}", call(value), *said) for i, value in enumerate(values)]


@functools.cache
def made(call, **options):
    """What a function returns, with zeros for its numbers, which are not worked out."""
    return zeros_of(lambda: call(KEY, PAPER, A, B, 1.0, **options))


approximate = functools.partial(made, jb.sample_bridges, num_bridges=3, num_steps=4)
weighted = functools.partial(made, jb.sample_weighted_bridges, num_steps=4, proposal=BRIDGE)
density = functools.partial(made, jb.transition_log_density, num_steps=4, proposal=BRIDGE)
choice = lambda num, *candidates: chosen_of(candidates, jnp.zeros(num, jnp.int32), (0,))
traced = lambda call, *arguments: lambda: jax.eval_shape(call, *arguments)

# Rows of tables: what is malformed, the call, a pattern of the sentence, and the exception where it
# is not `ValueError`.

diffusion, ou = of(jb.Diffusion, DECAY), of(jb.ornstein_uhlenbeck)
COMPLEX = lambda x, p: jax.lax.complex(x, x)
wrong = lambda name, function, method=None: (
    f"{name} in a wrong shape",
    lambda: getattr(jb.Diffusion(**({"drift": DECAY} | {name: function})), method or name)(X),
    f"`{name}` must return shape",
)
sigma = lambda sigma: lambda: jb.Diffusion(DECAY, sigma).diffusion(X)
hyperbolic, alpha = of(jb.hyperbolic), of(jb.hyperbolic, dim=2)
stationary = of(jb.stationary_diffusion, LOG_NORMAL)
two, noise = of(jb.ornstein_uhlenbeck, np.eye(2)), of(jb.ornstein_uhlenbeck, np.eye(2), None)
gaussian = of(jb.gaussian_bridge, PAPER, start=A, end=X, duration=1.0, times=[0.5])
at = lambda times, model=PAPER: of(jb.gaussian_bridge)(model, A, X, 1.0, times)
transition = of(jb.ou_transition, PAPER, start=A, duration=1.0)
simulate = of(jb.simulate, key=KEY, model=PAPER, x0=A, times=TIMES, num_paths=2, num_steps=2)
on = lambda times: simulate(times=times)
transform = of(jb.transform, model=cir.model(), forward=jnp.log, inverse=jnp.exp)
lamperti = of(jb.lamperti, model=cir.model(), at=0.5, reach=8.0)
domain = lambda domain: lambda: jb.Diffusion(DECAY, domain=domain).drift(X)
scaled = lambda s: jb.transform(jb.Diffusion(DECAY, s * jnp.eye(2)), jnp.sinh, jnp.arcsinh).model

neuron, inert = of(jb.fitzhugh_nagumo), of(jb.underdamped_langevin, LOG_NORMAL)
seasonal, heated = of(jb.seasonal_ornstein_uhlenbeck), of(jb.langevin, LOG_NORMAL)
one_point, of_four = lambda x: x, lambda a, b, c, d: a

MODELS = [
    # Parameters that cannot be, and functions of other arguments.
    *each("ε", lambda e: neuron(epsilon=e), [0.0, -1.0, NAN], "`epsilon` must be positive"),
    ("σ", neuron(sigma=-1.0), "`sigma` must be zero or more"),
    ("γ", neuron(gamma=np.inf), "`gamma` must be finite"),
    *each("kT", lambda t: inert(temperature=t), [0.0, -1.0, NAN], "`temperature` must be positive"),
    ("friction", inert(friction=-1.0), "`friction` must be zero or more"),
    *each("kT", lambda t: heated(temperature=t), [0.0, -1.0, NAN], "`temperature` must be pos"),
    ("kT", heated(temperature=[1.0]), "`temperature` must be a number"),
    (
        "kT",
        traced(lambda t: heated(temperature=t)().drift(X), 1.0),
        "`temperature` is a",
        TypeError,
    ),
    ("period", seasonal(period=0.0), "`period` must be positive"),
    ("rate", seasonal(rate=NAN), "`rate` must be finite"),
    ("mean", of(jb.GaussianLaw)([NAN], [[1.0]]), "`mean` must be finite"),
    *each("drift", of(jb.Diffusion), [one_point, of_four], "`drift` must be a fun.* or", TypeError),
    *(
        (
            f"{name} of one",
            diffusion(**{name: one_point}),
            f"`{name}` must be a function",
            TypeError,
        )
        for name in ("diffusion", "log_stationary", "reverse_drift", "domain")
    ),
    ("prepare of four", diffusion(prepare=of_four), "`prepare` must be a function", TypeError),
    (
        "NumPy's",
        lambda: jb.Diffusion(lambda x, p: np.sin(x)).drift(X),
        "`drift` cannot be",
        TypeError,
    ),
    ("beyond", lambda: jb.Diffusion(lambda x, p: p["a"] * x, params={}).drift(X), "`drift` raised"),
    ("solver", simulate(solver="heun"), "`solver` must be a solver of diffrax", TypeError),
    ("solver", simulate(solver=diffrax.Heun), "`solver` must be .* got the class", TypeError),
    *each(
        "solver",
        lambda solver: simulate(solver=solver),
        [diffrax.Tsit5(), diffrax.Kvaerno3(), diffrax.ALIGN(), diffrax.LeapfrogMidpoint()],
        "`solver` must be a solver of diffrax for any stochastic",
        TypeError,
    ),
    *each("drift", of(jb.Diffusion), [None, 3.0, X], f"`drift` {FUNCTION}", TypeError),
    ("log ν", diffusion(log_stationary=3.0), f"`log_stationary` {FUNCTION}", TypeError),
    ("reversal", diffusion(reverse_drift=3.0), f"`reverse_drift` {FUNCTION}", TypeError),
    ("sampler", diffusion(sample_stationary=3.0), f"`sample_stationary` {FUNCTION}", TypeError),
    ("prepare", diffusion(prepare=3.0), f"`prepare` {FUNCTION}", TypeError),
    *each("σ", diffusion, [2.0, np.ones((2, 0)), np.ones((2, 2, 2))], "`diffusion` must .*shape"),
    *each("σ", diffusion, [np.ones((2, 2)), B, np.ones((2, 3))], "`diffusion` must .*invertible"),
    ("σ that is missing", diffusion([1.0, NAN]), "`diffusion` must .*finite"),
    ("σ in space", sigma(np.eye(3)), "`diffusion` must have shape"),
    ("σ(x) in space", sigma(lambda x, p: jnp.eye(3)), "`diffusion` must have shape"),
    ("σ(x) a number", sigma(lambda x, p: x[0] * x[1]), "`diffusion` must have shape"),
    wrong("drift", lambda x, p: x @ x),
    wrong("drift", lambda x, p: x[:, None]),
    wrong("reverse_drift", lambda x, p: x @ x),
    wrong("log_stationary", lambda x, p: x),
    wrong("log_stationary", lambda x, p: x[:1], "reverse_drift"),
    ("i x", of(jb.Diffusion(COMPLEX).drift)(X), "`drift` .*real numbers", TypeError),
    ("i σ", sigma(COMPLEX), "`diffusion` .*real numbers", TypeError),
    ("no reversal", of(FREE.reverse_drift)(X), "log_stationary.*reverse_drift.*reversible=True"),
    ("no ν", of(FREE.log_stationary)(X), "log_stationary="),
    ("no ν to compare with", of(FREE.reversibility_residual)(X[None]), "log_stationary="),
    ("no sampler", of(FREE.sample_stationary)(KEY), "sample_stationary="),
    ("Langevin of a number", of(jb.langevin)(3.0), f"`log_density` {FUNCTION}", TypeError),
    *each("α", alpha, [0.0, -1.0, np.inf, NAN, B], "`alpha` must be one positive number"),
    ("α in words", hyperbolic("steep", 2), "`alpha` must be", TypeError),
    ("no dimension", hyperbolic(0.8, 0), "`dim` must be at least 1"),
    ("half a dimension", hyperbolic(1.0, 2.0), "`dim` must be a static Python integer", TypeError),
    ("log ν", of(jb.stationary_diffusion)(X), f"`log_density` {FUNCTION}", TypeError),
    ("V", stationary(V=np.eye(2)), f"`V` {FUNCTION}", TypeError),
    ("Q", stationary(Q=np.eye(2)), f"`Q` {FUNCTION}", TypeError),
    *each("not ergodic", ou, [-np.eye(2), [[-1.0]], [[0.0, 1.0], [-1.0, 0.0]]], "ergodic"),
    ("B is missing", ou([[NAN, 1.0], [-1.0, 0.0]]), "`B` must be finite"),
    *each("B", ou, [np.ones((2, 3)), [[1.0, 0.0]], [1.0, 2.0]], "`B` must be a square matrix"),
    ("B in words", ou("steep"), "`B` must be", TypeError),
    ("mean", two(np.zeros(3)), "`mean` must have shape"),
    ("mean is missing", two([NAN, 0.0]), "`mean` must be finite"),
    *each("σ", noise, [np.eye(3), 2.0], "`sigma` must have shape"),
    ("σ is singular", noise(np.ones((2, 2))), "`sigma` must be invertible"),
    # Noise in a part, and time.
    ("ν of time", lambda: jb.Diffusion(lambda x, p, t: -t * x, None, LOG_NORMAL), "not stationary"),
    ("neuron", of(jb.fitzhugh_nagumo)(sigma=np.ones(2)), r"`sigma` must be a number, shape \(\)"),
    ("neuron in space", lambda: jb.fitzhugh_nagumo().drift(np.ones(3)), r"at a point of shape"),
    ("potential", of(jb.underdamped_langevin)(3.0), f"`potential` {FUNCTION}", TypeError),
    (
        "friction",
        of(jb.underdamped_langevin, LOG_NORMAL)(np.ones(2)),
        "`friction` must be a number",
    ),
    ("half", lambda: jb.underdamped_langevin(LOG_NORMAL).drift(np.ones(3)), "even number of coord"),
    ("no model", of(jb.integrated)(3.0), "`model` must be", TypeError),
    ("integral", lambda: jb.integrated(HYPERBOLIC).drift(np.ones(3)), "even number of coord"),
    ("seasons", of(jb.seasonal_ornstein_uhlenbeck)(np.eye(2)), "`rate` must have shape"),
    # Closed forms.
    ("another model", of(jb.ou_stationary)(HYPERBOLIC), "made by `ornstein_uhlenbeck`", TypeError),
    (
        "another model",
        of(jb.ou_transition)(HYPERBOLIC, X, 1.0),
        "made by `ornstein_uhlenbeck`",
        TypeError,
    ),
    ("another model", at([0.5], HYPERBOLIC), "made by `ornstein_uhlenbeck`", TypeError),
    *each("times", at, [[0.5, 0.2], [-0.1, 0.2], [0.5, 1.1], [NAN]], "`times` must increase"),
    ("no times", gaussian(times=[]), "`times`"),
    ("time", gaussian(times=0.5), "`times` must have shape"),
    ("duration", gaussian(duration=-1.0), "`duration` must be positive"),
    ("durations", gaussian(duration=[1.0, 2.0]), "one interval"),
    ("starts", gaussian(start=[[0.0, 0.0], [1.0, 1.0]]), "one interval"),
    ("on a line", gaussian(start=[0.0], end=[1.0]), "`start`.*shape|dimension"),
    ("in space", gaussian(start=np.zeros(3), end=np.ones(3)), "`start`.*shape|dimension"),
    ("duration", transition(duration=-1.0), "`duration`"),
    ("durations", transition(duration=jnp.array([1.0, 2.0])), "`duration`"),
    *each("start", lambda x: transition(start=x), [jnp.ones(1), jnp.ones(3)], "`start`"),
    # Paths.
    ("key of old", simulate(key=jax.random.PRNGKey(0)), "`key` must be a typed key", TypeError),
    ("keys", simulate(key=jax.random.split(KEY)), "`key` must be a single key"),
    *each("times", on, [1.0, [1.0]], "`times` must have shape"),
    *each(
        "times",
        on,
        [[0.0, 0.0], [0.0, 2.0, 1.0], [1.0, 0.0], [NAN] * 2],
        "`times` must be increasing",
    ),
    *each("x0", lambda x: simulate(x0=x), [1.0, np.zeros((3, 2))], "`x0` must have shape"),
    ("x0 on a line", simulate(x0=[0.0]), r"at a point `x` of shape \(1,\)"),
    ("x0 in space", simulate(model=ROTATING, x0=np.zeros(3)), r"at a point of shape \(3,\)"),
    ("x0 in more dimensions than OU's", simulate(model=OU, x0=A), r"for points of shape \(1,\)"),
    (
        "x0 in less",
        simulate(model=HYPERBOLIC, x0=[0.0]),
        r"for points of shape \(2,\)",
    ),
    ("x0 in more", simulate(model=HYPERBOLIC, x0=np.zeros(3)), r"for points of shape \(2,\)"),
    ("no model", simulate(model=None), "`model` must be a", TypeError),
    ("no x0", simulate(model=FREE, x0=None), "sample_stationary="),
    # Other coordinates.
    ("forward", transform(forward=3.0), f"`forward` {FUNCTION}", TypeError),
    ("model", transform(model=X), "`model` must be", TypeError),
    (
        "a number",
        traced(lambda x: transform(forward=jnp.sum)().model.drift(x), X[:1]),
        "`forward` must return shape",
    ),
    ("bridges", lambda: transform()().back(3.0), "`bridges` must be", TypeError),
    ("σ is traced", traced(lambda s: scaled(s).drift(X), 0.5), "constant σ that is traced"),
    ("domain", domain(lambda x, p: x > 0), "`domain` must return one boolean"),
    ("model", lamperti(model=3.0), "`model` must be", TypeError),
    ("two points", lamperti(at=[0.5, 0.5]), "`at` must be a number"),
    ("outside", lamperti(at=-1.0), "`at` must be a point inside"),
    ("no reach", lamperti(reach=0.0), "`reach` must be positive"),
    ("endless", lamperti(reach=np.inf), "`reach` must be finite"),
    ("no nodes", lamperti(num_nodes=0), "`num_nodes`"),
    ("traced", traced(lambda at: lamperti(at=at)(), 0.5), "`at` must be a known number", TypeError),
    ("plane", lambda: lamperti(model=HYPERBOLIC)().model.drift(A), "one-dimensional"),
]

path = lambda times, shape, **how: of(jb.path_log_likelihood)(PAPER, times, np.zeros(shape), **how)
likelihood = lambda model, **how: of(jb.path_log_likelihood)(model, TIMES, POINTS, **how)
days = (20_000 + 0.01 * np.arange(6)).astype(np.float32)
step = lambda scheme, model: lambda: scheme.step(model.forward(X), X, jnp.asarray(0.1), X)
in_one = functools.partial(step, jb.GaussianTransition())
FULL = jb.Diffusion(DECAY, lambda x, p: jnp.diag(1 + x**2))

SCHEMES = [
    ("full noise", step(jb.Milstein(), FULL), "scalar or diagonal noise"),
    *each("not linear", in_one, [HYPERBOLIC, VARYING], "`GaussianTransition` needs linear drift"),
    ("a point", path([0.0, 1.0], (2,)), "`path` must have shape"),
    ("times", path([0.0, 1.0], (3, 2)), "`times` must have shape"),
    ("equal times", path([0.0, 0.0, 1.0], (3, 2)), r"`times\[0\]` = 0.0 and .*Merge the obs"),
    ("a missing time", path([0.0, NAN, 1.0], (3, 2)), r"`times\[1\]` = nan\. Remove"),
    ("no time", path([0.0, None, 1.0], (3, 2)), r"`times\[1\]` = nan\. Remove"),
    ("times of two", path([[0.0, 1.0, 1.0]] * 2, (2, 3, 2)), "`times` must be finite and incr"),
    ("times since 1970", path(days, (6, 2)), "`times` are too far from zero"),
    ("form", path(TIMES, (3, 2), form="other"), "`form` must be"),
    ("no gradient", likelihood(ROTATING, form="ito"), "gradient"),
    ("varying σ", likelihood(VARYING, form="ito_taylor"), "constant σ"),
]

coupling = of(jb.Coupling)
bridges = of(jb.sample_bridges, key=KEY, model=PAPER, start=A, end=B, duration=1.0)
weigh = lambda bridges, model=PAPER, **how: lambda: jb.weigh_bridges(KEY, model, bridges(), **how)
counts = lambda law: lambda: jb.hitting_counts(KEY, PAPER, approximate(), start_law=law)
IN_HALVES = {name: np.float16(value) for name, value in (("start", A), ("end", B), ("duration", 1))}
reversible = lambda sigma, **how: jb.Diffusion(DECAY, sigma, LOG_NORMAL, reversible=True, **how)
OF_ROOTS, SINGULAR = (
    reversible(lambda x, p: jnp.diag(x)),
    reversible(lambda x, p: jnp.zeros((2, 2))),
)
OF_OTHERS, IN_SPACE = reversible(lambda x, p: 1 + x[::-1] ** 2), reversible(np.eye(3))
HALF_LINE = reversible(ROOT, domain=lambda x, p: x[0] > 0)
INFINITE = jb.Diffusion(lambda x, p: -1 / x, reversible=True)
MILSTEIN, SINGULAR_LAW = jb.Coupling(scheme=jb.Milstein()), jb.GaussianLaw(A, jnp.ones((2, 2)))
FLAT = jb.Diffusion(lambda x, p: jnp.zeros(100), None, LOG_NORMAL)

COUPLING = [
    *each("γ", coupling, [-1.01, 1.0, 1.5, 2.0, NAN], r"`gamma` must be in \[-1, 1\)"),
    ("γ in jit", traced(lambda: jb.Coupling(1.5).gamma), "`gamma` must be in"),
    ("γs", coupling(jnp.zeros(3)), "`gamma` must be a scalar"),
    ("γ in words", coupling("none"), "`gamma` must be", TypeError),
    ("plane", coupling(0.5, jb.ReflectionPlane()), "reflection coupling only"),
    ("scheme", coupling(0.0, scheme="Heun"), "`scheme` must be", TypeError),
    ("meeting", coupling(0.0, meeting="crossing"), "`meeting` must be", TypeError),
    ("sign test", of(jb.SignTest)(-1.0), "`"),
    ("start law", of(as_start_law)(3.0), "`start_law` must be", TypeError),
    ("class", coupling(0.5, start_law=jb.Reversed), "not a class", TypeError),
    ("burn-in", of(jb.Stationary)(-1.0), "positive finite time"),
    ("mean", of(jb.GaussianLaw)([0.0], jnp.eye(2)), "must have shape"),
    ("covariance", of(jb.GaussianLaw)(A, jnp.eye(3)), "must have shape"),
    *each("law", of(jb.GaussianLaw, A), [-np.eye(2), np.eye(2)[::-1]], "positive semidef"),
    ("singular law", coupling(start_law=SINGULAR_LAW), "positive definite"),
    # Bridges.
    ("cube", bridges(start=[[A]]), "`start` must be one point"),
    ("line", bridges(start=[0.0]), "the same dimension"),
    ("3 and 2", bridges(start=[A] * 3, end=[A] * 2), "number of intervals"),
    ("none at all", bridges(start=np.ones((0, 2))), "at least one interval"),
    ("half precision", bridges(**IN_HALVES), "float32 or float64; got float16", TypeError),
    ("start is missing", bridges(start=[NAN, 0.0]), "`start` must be finite"),
    ("end is infinite", bridges(end=[np.inf, 0.0]), "`end` must be finite"),
    *each("duration", lambda t: bridges(duration=t), [0.0, -1.0], "`duration` must be positive"),
    ("durations", bridges(duration=[[1.0]]), "`duration` must have shape"),
    ("in jit", traced(bridges(duration=-1.0)), "`duration` must be positive"),
    ("too many", bridges(max_proposals=2**31), "`max_proposals` must be at most"),
    ("off the grid", bridges(save_at=[0.0, 0.013]), "`save_at` must lie on the grid"),
    ("beyond", bridges(save_at=[0.0, 1.2]), "`save_at` must lie in"),
    ("beyond in jit", traced(bridges(save_at=[0.5, 7.0])), "`save_at` must lie in"),
    ("back", bridges(save_at=[0.5, 0.2]), "`save_at` must increase"),
    ("a time", bridges(save_at=0.5), "`save_at` must be an array of times"),
    ("no reversal", bridges(model=FREE), "time reversal of this model is unknown"),
    *each("σ", lambda m: bridges(model=m), [OF_ROOTS, SINGULAR], "must be invertible"),
    ("α is missing", bridges(model=HYPERBOLIC.with_params(NAN)), "`params` .* must be finite"),
    ("1/0", bridges(model=INFINITE), "not finite at `start`"),
    ("in space", bridges(model=IN_SPACE), r"shape \(2, m\)"),
    ("full", bridges(model=OF_OTHERS, coupling=MILSTEIN), "needs diagonal noise"),
    ("outside", bridges(model=HALF_LINE, start=[0.5], end=[-0.5]), "not finite at `end`"),
    ("key of old", bridges(key=jax.random.PRNGKey(0)), "`key` must be a typed key", TypeError),
    ("coupling", bridges(coupling=0.5), "`coupling` must be", TypeError),
    ("model", bridges(model=lambda x: x), "`model` must be", TypeError),
    ("truth", bridges(start=[True, False]), "`start` must be real numbers", TypeError),
    ("words", bridges(end="b"), "`end` must be real numbers", TypeError),
    ("burn-in", of(jb.measure_burn_in)(KEY, HYPERBOLIC, A, -1.0), "`"),
    # What is seen of bridges, and of models.
    ("counts of a number", of(jb.hitting_counts)(KEY, HYPERBOLIC, 3.0), "`bridges`", TypeError),
    ("counts", counts(jb.GaussianLaw([0.0], [[1.0]])), r"must give points of shape \(2,\)"),
    ("effects of a number", of(jb.effects)(3.0), "`model`", TypeError),
    ("dimension", of(jb.effects)(FLAT), "Pass a point"),
    ("points", of(jb.effects)(HYPERBOLIC, at=np.zeros((2, 2))), r"shape \(d,\)"),
    ("coupling", of(jb.effects)(HYPERBOLIC, 0.5), "`coupling` must be", TypeError),
    ("no reversal", of(jb.effects)(FREE), "time reversal"),
]

sample = of(jb.sample_weighted_bridges, KEY, PAPER, A, B, 1.0)
choose = of(jb.choose_proposal, KEY, PAPER, A, B, 1.0)
choose_in_jit = lambda t: jb.choose_proposal(KEY, PAPER, A, B, t).chosen
kernel = of(jb.pseudo_marginal)
exact = of(jb.sample_exact_bridges, KEY, PAPER, A, B, 1.0)
by_noise = functools.partial(exact, method="crank_nicolson")
modified = of(jb.ModifiedDiffusionBridge)
bent = of(jb.sample_exact_bridges, KEY, VARYING, [0.3], [0.1], 1.0)
rooted = of(jb.sample_weighted_bridges, KEY, jb.Diffusion(lambda x, p: 1 - x, ROOT), [1.0])
LINEARISATION = '`linearisation` must be "end", "path" or a matrix'
refined = jb.Guided(refinement=4.0)

PROPOSALS = [
    *each("word", of(jb.Guided), ["start", "sideways"], LINEARISATION),
    ("vector", of(jb.Guided)([1.0, 2.0]), r"must be a matrix of shape \(d, d\)"),
    ("missing", of(jb.Guided)([[NAN]]), "must be finite"),
    (
        "matrix in space",
        sample(proposal=jb.Guided(jnp.eye(3))),
        r"must have shape \(2, 2\) for points of 2 dimensions",
    ),
    ("coarser", modified(refinement=0.5), "`refinement` must be between 1"),
    ("word", modified(refinement="2"), "`refinement` must be a Python number", TypeError),
    ("density", of(jb.Guided)("end", 2.0), "`density` must be `EulerDensity", TypeError),
    ("density", modified(density="exact"), "`density` must be", TypeError),
    ("too fine", sample(num_steps=2000, proposal=refined), "shorter than rounding errors"),
    ("off the grid", sample(save_at=[0.5], proposal=refined), "lie on the grid"),
    ("counts", sample(num_counts=2, proposal=GUIDED), "`num_counts`, `max_proposals` and `max_tr"),
    *(
        (what, rooted(end, duration, proposal=proposal), sentence)
        for proposal in (BRIDGE, GUIDED)
        for what, end, duration, sentence in [
            ("outside", [-0.5], 1.0, "inside the state space"),
            ("boundary", [0.0], 1.0, "must be invertible"),
            ("short", [0.5], 1e-38, "too short"),
        ]
    ),
    ("varying σ", bent(proposal=TAYLOR), "is for constant σ"),
    ("no ν", bent(proposal=PAIRS), "without time reversal, such as `ModifiedDiff"),
    # Choices.
    ("words", exact(proposal="best"), 'a result of `choose_proposal`, or "auto"', TypeError),
    ("kernel", kernel(PAPER, A, B, 1.0, proposal="auto"), "a kernel makes no pilot run"),
    ("duration is traced", traced(choose_in_jit, 1.0), "measures run times", TypeError),
    ("none", choose(candidates=[]), "at least one proposal"),
    ("two grids", choose(candidates=[GUIDED, refined]), "on one grid"),
    ("another choice", exact(proposal=choice(3, BRIDGE)), "for 3 intervals, but the problem has 1"),
    ("choice of choices", choose(candidates=[choice(1, BRIDGE)]), "single proposals"),
    ("renewal", exact(proposal="auto", method="renewal"), "renewal is for couplings", TypeError),
    ("noise", by_noise(proposal="auto"), "need a guided proposal", TypeError),
    ("one pilot run", choose(num_pilot=1), "`num_pilot` must be at least 2"),
]

log_density = of(jb.transition_log_density)
crank_nicolson = of(jb.crank_nicolson, HYPERBOLIC, A, B, 2.0)
renewal = jb.renewal(PAPER, A, B, 1.0, num_steps=20)
fine, fine_paths = functools.partial(density, num_steps=8), functools.partial(weighted, num_steps=8)
by_another = functools.partial(density, proposal=GUIDED)
extrapolate = lambda fine, coarse: lambda: jb.extrapolate(fine(), coarse())
expectation = lambda bridges: lambda: jb.expectation(lambda path: path, bridges(), PAPER)
POINT, UNKNOWN = ([0.0], [0.5], 1.0), of_unknown_constant()
UNKNOWN_PAIRS = as_proposal(PAIRS, UNKNOWN, jnp.zeros(1))
OWN_RUN = jb.Coupling(0.0, start_law=jb.Stationary(burn_in=3.0))
WAYS = [
    None,
    PAIRS,
    jb.Coupling.as_published(0.5),
    UNKNOWN_PAIRS,
    choice(1, UNKNOWN_PAIRS),
    OWN_RUN,
]
REMEDIES = [
    "in proportion to exp of `log_stationary`",
    "normalised=True",
    r"fit_start_law\(..., for_density=True\)",
    '"auto"',
]
WITH_REMEDIES = "(?s)" + "".join(f"(?=.*{remedy})" for remedy in REMEDIES)
rough = lambda way: log_density(KEY, UNKNOWN, *POINT, proposal=way)
middle_of = lambda path: path[3, 0]
weighted_mean = lambda fn: weighted().mean(fn)
BEYOND = [
    lambda path: path[50],
    lambda path: path[-50, 0],
    lambda path: jnp.diff(path, axis=0)[50],
    lambda path: path[np.array([0, 50])],
    lambda path: path[jnp.arange(55)],
]


STOP = ("stop_gradient", TypeError)


def middle(end):
    """Of which forward mode would give a pathwise derivative that is not one."""
    some = jb.sample_bridges(KEY, PAPER, A, end, 1.0, num_steps=10)
    return jb.weigh_bridges(KEY, PAPER, some).mean()[5]


def with_gamma(gamma):
    """A coupling's own numbers: reverse mode would end in the midst of its loops."""
    density = jb.transition_log_density(KEY, PAPER, A, B, 1.0, proposal=jb.Coupling(gamma))
    return density.value


def of_sigma(sigma):
    made_at = PAPER.with_params(PAPER.params._replace(sigma=sigma))
    return jb.expectation(middle_of, weighted(), made_at)


EXACT = [
    ("a number", of(jb.weigh_bridges)(KEY, HYPERBOLIC, B), "`bridges`", TypeError),
    ("paths", weigh(lambda: approximate().paths), "`bridges` must come from", TypeError),
    ("thinned", weigh(lambda: approximate(save_at=(0.5, 1.0))), "without `save_at`"),
    ("start law", weigh(approximate, start_law=lambda k: k), "`start_law` must be", TypeError),
    ("class", weigh(approximate, start_law=jb.Stationary), "Pass `Stationary", TypeError),
    ("no counts", weigh(approximate, num_counts=0), "at least 1"),
    ("another law", weigh(approximate, BLIND, start_law=LAW), "need the stationary density"),
    *each("derivative", lambda d: traced(d(middle), X), [jax.jacfwd, jax.jacrev], *STOP),
    *each("coupling", lambda d: traced(d(with_gamma), 0.5), [jax.grad, jax.jacfwd], *STOP),
    # Chains.
    ("method", exact(method="gibbs"), '`method` must be "pseudo_marginal", "renewal"'),
    ("proposal", exact(proposal=0.5), "`proposal` must be", TypeError),
    ("counts", exact(method="renewal", num_counts=2), "counts nothing"),
    ("step", exact(step_size=0.5), '`step_size` is for method="crank_nicolson"'),
    ("shape", exact(position=np.zeros((3, 2))), r"`position` must be a path, shape \(51, 2\)"),
    (
        "elsewhere",
        exact(position=np.zeros((51, 2)) + 9.0),
        "`position` must be finite, with the end points",
    ),
    ("intervals", kernel(PAPER, [A] * 3, [B] * 3, 1.0), "for one interval"),
    ("another grid", of(renewal.init)(jnp.zeros((5, 2)), KEY), r"shape \(21, 2\), or `None`"),
    ("no sampler", kernel(NO_SAMPLER, A, B, 1.0), r"Stationary\(burn_in"),
    ("long step", crank_nicolson(step_size=1.5), r"`step_size` must be a number in \(0, 1\]"),
    ("no noise", crank_nicolson(proposal=PAIRS), "need a guided proposal", TypeError),
    # Densities.
    ("no ν", log_density(KEY, BLIND, *POINT), "log_stationary"),
    ("word", log_density(KEY, OU, *POINT, proposal="coupling"), "`proposal` must be", TypeError),
    *each("constant", rough, WAYS, WITH_REMEDIES),
    # Expectations.
    ("a number", of(jb.expectation, lambda path: path)(3.0, HYPERBOLIC), "`bridges`", TypeError),
    ("not exact", expectation(approximate), "exact law", TypeError),
    ("thinned", expectation(lambda: weighted(save_at=(1.0,))), "whole path"),
    ("of σ", traced(jax.grad(of_sigma), jnp.eye(2)), "σ depends on parameters", TypeError),
    # Functions of a path.
    *each("beyond", lambda fn: of(weighted_mean)(fn), BEYOND, r"`fn` takes the entry -?\d+ of"),
    ("of two", of(weighted_mean)(lambda x, y: x), "`fn` must be a function `.path.`", TypeError),
    ("NumPy's", of(weighted_mean)(lambda path: np.exp(path)), "`fn` cannot be traced", TypeError),
    # Two grids.
    ("coarse first", extrapolate(density, fine), "half as many steps"),
    ("density and paths", extrapolate(density, weighted), "must both be results", TypeError),
    ("two proposals", extrapolate(fine, by_another), "the same single proposal"),
    ("whole paths", lambda: extrapolate(fine_paths, weighted)().mean(), "save_at"),
    # Diagnostics.
    ("draws", of(jb.effective_sample_size)("many"), "`draws`", TypeError),
    ("few draws", of(jb.effective_sample_size)([1.0, 2.0]), "at least 4"),
    ("one chain", of(jb.effective_sample_size)(np.ones(9), chains=True), "(chains, n, ...)"),
    ("chains", of(jb.effective_sample_size)(np.ones((2, 9)), chains=2), "`True`", TypeError),
    ("draws", of(jb.potential_scale_reduction)("many"), "`", TypeError),
    ("few draws", of(jb.potential_scale_reduction)(np.ones((4, 3, 2))), "at least 4 draws"),
]

linear, seen_by = of(jb.LinearGaussian), of(jb.ObservationDensity)
AT, VALUES, TWO = np.arange(4.0), np.zeros((4, 2)), [0.0, 1.0]
READERS = {
    "innovations": lambda key, *record, **how: jb.innovations(*record, **how),
    "log_likelihood": jb.log_likelihood,
    "smooth": jb.smooth,
}
SEEN, EXACTLY = jb.LinearGaussian(covariance=0.1), jb.LinearGaussian(covariance=0.0)
OF_SPACE = jb.LinearGaussian([[1.0, 0.0, 0.0]], 0.1)
seen = lambda *arguments, **options: dict(observation=jb.LinearGaussian(*arguments, **options))
several = lambda times, values: of(jb.log_likelihood)(KEY, OU, times, values, observation=SEEN)
smooth = of(jb.smooth, KEY, observation=SEEN, initial=[0.0], proposal=GUIDED, num_steps=4)
between = functools.partial(smooth, OU, TIMES, LINE)
DRAWN = jb.Diffusion(DECAY, sample_stationary=lambda key, p: jnp.zeros(1), reversible=True)
of_draws = functools.partial(smooth, DRAWN, TIMES, LINE)
RECORD = dict(times=AT, observations=VALUES, observation=SEEN, initial=A)
NO_NOISE = jb.LinearGaussian(covariance=lambda params: jnp.zeros(2))
GUESSED = jb.ObservationDensity(lambda y, x, p: -(y - x) @ (y - x), NO_NOISE)
POSITIVE = jb.Diffusion(lambda x, p: 1 - x, [0.5], domain=lambda x, p: jnp.all(x > 0))
outside = lambda reader, observation, values, initial=1.0: of(READERS[reader])(
    KEY, POSITIVE, TWO, np.array(values)[:, None], observation=observation, initial=[initial]
)
OF_A_RECORD = [
    (
        "another state",
        dict(observation=OF_SPACE, observations=VALUES[:, :1]),
        r"`matrix` must have shape \(1, 2\)",
    ),
    (
        "another state, and no beginning",
        dict(observation=OF_SPACE, observations=VALUES[:, :1], initial=None),
        r"`matrix` must have shape \(1, 2\)",
    ),
    (
        "a part without a matrix",
        dict(observations=VALUES[:, :1], initial=None),
        "`observations` have 1 components, but without a `matrix`",
    ),
    ("other components", seen([B], 0.1), "the observation model has 1"),
    ("noise of others", seen(covariance=np.eye(3)), "`covariance` must have shape"),
    ("redundant", seen([[1.0, 0.0], [2.0, 0.0]], 0.0), "have rank 1: leave out"),
    (
        "redundant together",
        seen([B, B], np.ones((2, 2))),
        "`matrix` and `covariance` side by side have rank 1",
    ),
    ("a guess without noise", dict(observation=GUESSED), "`guess` must have positive variances"),
    ("fewer rows", dict(observations=VALUES[:3]), "one row per time"),
    ("times go back", dict(times=AT[::-1]), "`times` must be increasing"),
    ("a time is missing", dict(times=[0.0, NAN, 2.0, 3.0]), r"`times\[1\]` = nan\. Remove"),
    ("one time", dict(times=AT[:1], observations=VALUES[:1]), "at least two times"),
    ("infinite", dict(observations=VALUES + np.inf), r"`observations\[0, 0\]` is infinite"),
    ("before the beginning", dict(initial_time=1.0), "`times` must begin at `initial_time`"),
    ("no beginning", dict(initial_time=NAN), "`initial_time` must be finite"),
    ("lengths", dict(observations=VALUES[:3], initial_time=-1.0), r"got \(4,\) and \(3, 2\)"),
    ("two kinds of steps", dict(num_steps=4, step_size=0.1), "not both"),
    ("no steps", dict(num_steps=0), "`num_steps` must be at least 1"),
    ("backward steps", dict(step_size=-1.0), "`step_size` must be a positive"),
    ("initial of another shape", dict(initial=[0.0]), "`initial` must be a point of shape"),
    ("initial is not finite", dict(initial=[0.0, NAN]), "`initial` must be finite"),
]
ROUGH = jb.Diffusion(DECAY, None, lambda x, p: 7 - x @ x)
SEEING = "`observation` must be a `LinearGaussian`"
by_number = lambda y, x, p: 0.0
reads = lambda reader, model=PAPER: of(READERS[reader], KEY, model, **RECORD)

RECORDS = [
    ("vector", linear([1.0, 0.0]), r"`matrix` must have shape \(m, d\)"),
    ("missing", linear([[NAN, 0.0]]), "`matrix` must be finite"),
    ("negative", linear(covariance=-1.0), "must not be negative"),
    ("indefinite", linear(covariance=[[1.0, 2.0], [2.0, 1.0]]), "positive semidefinite"),
    ("triangular", linear(covariance=[[1.0, 2.0], [0.0, 9.0]]), "symmetric"),
    ("one row", linear(covariance=np.ones((1, 2))), "`covariance` must have shape"),
    ("infinite", linear(covariance=np.inf), "must be finite"),
    ("without noise", seen_by(by_number, jb.LinearGaussian()), "positive"),
    ("density", seen_by(3, SEEN), f"`log_density` {FUNCTION}", TypeError),
    ("guess", seen_by(by_number, 0.1), "`guess` must be a `LinearGaussian`", TypeError),
    ("a number", reads("smooth")(observation=0.1), SEEING, TypeError),
    *(
        (f"{reader}: {what}", reads(reader)(**changed), message)
        for reader, (what, changed, message) in itertools.product(READERS, OF_A_RECORD)
    ),
    *(
        ("outside the domain", outside(reader, *seen), message)
        for reader in ("innovations", "log_likelihood")
        for *seen, message in (
            (
                EXACTLY,
                [1.0, -1.0],
                r"`observations\[1\]` is an exact observation of the state .* `domain`",
            ),
            (
                jb.LinearGaussian([[-2.0]]),
                [-1.0, 2.0],
                r"`observations\[1\]` is an exact observation of the state",
            ),
            (SEEN, [1.0, -1.0], -1.0, "`initial` must be inside .* `domain`"),
        )
    ),
    ("no beginning", reads("innovations", FREE)(initial=None), "`initial` is missing"),
    *(
        ("unknown constant", reads(reader, ROUGH)(initial=None), "not declared `normalised`")
        for reader in ("innovations", "log_likelihood")
    ),
    # Several records.
    ("one and two", several([TWO], [LINE[:2]] * 2), "got 1 and 2"),
    ("columns", several([TWO] * 2, [LINE[:2], VALUES[:2]]), r"columns.*\[1, 2\]"),
    ("times go back", several([TWO, [0, -1.0]], [LINE[:2]] * 2), "in record 1: .*increasing"),
    # Paths between what was seen.
    ("no proposal", between(proposal=None, num_proposals=3), "`num_proposals` is for a `proposal`"),
    ("blocks", between(block_length=3), "`block_length` is for paths without"),
    ("free", smooth(FREE, TIMES, LINE), "leave out `proposal`, so that paths are guided by the"),
    ("no ν", of_draws(proposal=PAIRS), "give `Diffusion` a `log_stationary`"),
    ("no noise", between(observation=EXACTLY), "every observed component must have noise"),
    ("half known", between(initial=jb.GaussianLaw([0.0], [[0.0]])), "covariance of `initial`"),
    ("proposal", between(proposal=3), "`proposal` must be a `Coupling`", TypeError),
    ("no proposals", between(num_proposals=0), "`num_proposals` must"),
]

fit = of(jb.fit_start_law, KEY)
precision = of(jb.work_precision, KEY, PAPER, start=A, end=B, duration=1.0, num_steps=(4,))
choose_pairs = of(jb.choose_proposal, KEY, UNKNOWN, *POINT, candidates=[PAIRS])
rough_cost = of(jb.work_precision, KEY, UNKNOWN, *POINT, proposals=[PAIRS], methods=("density",))
variation = lambda bridges, **how: lambda: jb.hitting_variation(KEY, PAPER, bridges(), **how)

TUNING = [
    (
        "no ν",
        fit(BLIND, *POINT, for_density=True),
        "need the stationary density, whatever the start law",
    ),
    ("constant", choose_pairs(for_density=True), "in proportion to exp of `log_stationary`"),
    (
        "in jit",
        traced(lambda a: fit(PAPER, a, a, 1.0)(), X),
        "cannot be chosen inside `jit`",
        TypeError,
    ),
    ("intervals", fit(PAPER, [A] * 2, [A] * 2, 1.0, num_pilot=40), "one interval"),
    *each(
        "methods", lambda m: precision(methods=m), [("exact",), ()], "`methods` must be names among"
    ),
    ("method", precision(methods=("crank_nicolson",)), "none of `proposals` fits"),
    ("half precision", precision(dtypes=("float16",)), "`dtypes` must be"),
    ("no error", precision(target=0.0), "`target` must be positive"),
    ("no steps", precision(num_steps=(0,)), "`num_steps` must be at least 1"),
    ("no numbers of steps", precision(num_steps=()), "at least one number of steps"),
    ("an odd number of steps", precision(num_steps=(5,)), "`num_steps` must be even"),
    ("no bridges", precision(num_bridges=0), "`num_bridges` must be at least 1"),
    ("intervals", precision(start=[A] * 2), "one interval"),
    ("auto", precision(proposals=["auto"]), "must be single proposals"),
    ("constant", rough_cost(log_density=-0.4), "in proportion to exp of `log_stationary`"),
    ("a number", of(jb.hitting_variation)(KEY, HYPERBOLIC, 3.0), "`bridges`", TypeError),
    ("not exact", variation(approximate), "must have the exact law", TypeError),
    ("counts", variation(weighted, num_counts=(5, 5)), "two or more increasing"),
    ("one bridge", variation(lambda: weighted(num_bridges=1)), "must be two or more"),
]

ON_A_LINE = dict(model=ou_1d(), times=TIMES, observations=LINE)
RATE = lambda params: params[0]
gibbs = of(jb.gibbs, KEY, **ON_A_LINE, prior=PRIOR, where=RATE, constraint=lambda rate: rate > 0)
guided = functools.partial(gibbs, proposal=GUIDED)
pmmh = of(jb.pmmh, KEY, **ON_A_LINE, prior=jb.NormalPrior((1.0, 1.0), (0.5, 0.5)))
maximum = of(jb.maximum_likelihood, KEY, **ON_A_LINE, proposal=BRIDGE)
drift_of = of(jb.maximum_likelihood, KEY, ROTATING, TIMES, POINTS, where=lambda p: p.B)
UNDECIDED, by = choice_between([PAIRS, BRIDGE]), lambda proposal: maximum(proposal=proposal)
of_noise = of(jb.maximum_likelihood, KEY, **ON_A_LINE, observation=SEEN)
score = of(jb.score, KEY)
observed = of(as_observations, HYPERBOLIC)
MASKED = np.ma.masked_equal(TIMES, 1.0)
masked = lambda points: observed(TIMES, np.ma.masked_invalid(points))
two_records = lambda last: of(as_observations)(OU, TIMES, [LINE, last])
normal = lambda *arguments: gibbs(prior=jb.NormalPrior(*arguments))
LOG, OUTSIDE = lambda x, p: jnp.sum(jnp.log(x)), [[1.0], [0.5], [-0.1]]
IN_ROOTS = dict(model=jb.Diffusion(lambda x, p: p * (1 - x), ROOT, LOG, 1.0), where=None)
rate_draw = lambda key, p: jax.random.normal(key, (1,)) / jnp.sqrt(2 * p)
RATED = jb.Diffusion(
    lambda x, p: -p * x,
    None,
    lambda x, p: -p * x @ x,
    1.0,
    reversible=True,
    sample_stationary=rate_draw,
)
UNKNOWN_RATE = jb.Diffusion(lambda x, p: -p * x, params=1.0, reversible=True)
with_pairs = of(jb.pmmh, KEY, times=TIMES, observations=LINE, prior=PRIOR, proposal=PAIRS)

DAYS = ["2024-02-28", "2024-02-29", "2024-03-01"]
INITIAL = dict(initial=[0.0])
TINY, MANY = dict(step_size=1e-9), dict(num_steps=2**26)

INFERENCE = [
    # Too much.
    *each(
        "steps",
        lambda call: call(**TINY),
        [gibbs, pmmh, maximum],
        "`step_size` = .* of 3",
    ),
    *each("steps", lambda call: call(**MANY), [gibbs, pmmh, maximum], "`num_steps` = 67,108,864"),
    ("steps of a record", of_noise(**TINY), "`step_size` = 1e-09 needs 2e.09 steps"),
    ("meter", gibbs(progress_meter=True), "`progress_meter` must be `None` or", TypeError),
    ("where", gibbs(where=lambda params: params[9]), "`where` raised IndexError"),
    (
        "where",
        gibbs(where=lambda params: 2.0),
        "`where` must return whole leaves or branches of `model.params`",
    ),
    ("times", gibbs(times=[0.0, 2.0, 1.0]), r"`times\[1\]`.*Sort them"),
    ("missing time", gibbs(times=[0.0, NAN, 1.0]), r"`times\[1\]` = nan\. Remove"),
    ("two times", gibbs(times=[0.0, 1.0]), "one row per time; got"),
    ("one time", gibbs(times=[0.0], observations=[[1.0]]), "need at least two entries"),
    ("missing", gibbs(observations=[[0.0], [NAN], [1.0]]), r"`observations\[1\]`.*leave out"),
    ("no shape", gibbs(observations=1.0), "one row per time; got"),
    ("twice", gibbs(times=[0.0, 1.0, 1.0]), r"equal `times\[1\]` = 1.0 .*Merge the observations"),
    (
        "a start",
        gibbs(initial=[0.0], initial_time=0.0),
        "`initial` and `initial_time`: only for records",
    ),
    ("dates", gibbs(times=np.array(DAYS, "datetime64[D]")), "got dates. Convert them", TypeError),
    ("days", gibbs(times=np.array([0, 1, 2], "timedelta64[D]")), "time differences", TypeError),
    ("late", gibbs(times=np.float32([7e4, 70_000.01, 70_000.02])), "`times` are too far from zero"),
    (
        "outside",
        gibbs(observations=OUTSIDE, **IN_ROOTS),
        r"`observations\[2\]`.*outside the state space",
    ),
    ("prior's mean", normal(jnp.zeros(3), 1.0), "`prior.mean` must be"),
    ("prior's entries", normal({"rate": 0.0}, 1.0), "must have the structure of the parameters"),
    ("prior's shape", normal(0.0, jnp.ones((2, 2))), "`prior.variance` must be"),
    ("prior's variance", normal(0.0, -1.0), "positive"),
    ("a number", gibbs(prior=3.0), "`prior` must be", TypeError),
    ("in words", gibbs(prior="flat"), "`prior` must be", TypeError),
    ("-inf", gibbs(init=0, constraint=None, prior=lambda rate: jnp.log(rate)), "`prior` is -inf"),
    ("σ unknown", gibbs(where=None, proposal=jb.Guided()), "`proposal`: .* with a known σ"),
    ("σ unknown", gibbs(where=lambda p: p[1], method="renewal"), "`method`: .*use `pmmh`"),
    ("constraint", gibbs(constraint=lambda rate: rate > 5), "do not satisfy `constraint`"),
    ("constraint", gibbs(constraint=3.0), "`constraint` must be", TypeError),
    ("bridges", gibbs(bridges="other"), "`bridges` must be"),
    ("method", gibbs(method="other"), "`method` must be"),
    ("steps", gibbs(num_steps=3, step_size=0.1), "not both"),
    ("backwards", gibbs(step_size=-1.0), "`step_size` must be"),
    ("init", gibbs(init=jnp.zeros(3)), "`init` must have"),
    ("renewal", guided(method="renewal"), "renewal is for couplings", TypeError),
    ("pairs", guided(bridges="approximate"), 'bridges="approximate" is for couplings', TypeError),
    ("no law to start from", gibbs(model=UNKNOWN_RATE, where=None, proposal=PAIRS), "burn_in"),
    ("covariance", pmmh(covariance=np.ones(3)), "`covariance` must have shape"),
    ("covariance", pmmh(covariance=[-1.0, 0.1]), "`cov.* must be finite, symmetric and positive"),
    ("no ν", with_pairs(model=UNKNOWN_RATE), "need the stationary density"),
    ("no constant", with_pairs(model=RATED), "normalised=True"),
    ("method", drift_of(method="other"), "`method` must be"),
    ("optimizer", drift_of(optax.sgd(0.1), method="em"), "takes no `optimizer`"),
    ("σ", drift_of(method="em", where=None), "σ depends"),
    *each("pairs", by, [PAIRS, UNDECIDED], "with couplings its estimates have no derivative"),
    ("counts", maximum(num_counts=2), "`num_counts`"),
    ("EM", maximum(method="em"), "EM would never change it"),
    ("EM", of_noise(method="em"), "for complete observations without noise"),
    ("guided", of_noise(proposal="guided"), "for complete observations without noise"),
    ("counts", of_noise(num_counts=2), "`num_counts`: only for complete observations"),
    (
        "trials",
        pmmh(observation=SEEN, max_trials=9),
        "`max_trials`: only for complete observations",
    ),
    (
        "guided",
        pmmh(observation=SEEN, proposal=GUIDED),
        "`proposal`: only for complete observations",
    ),
    (
        "chains",
        gibbs(observation=SEEN, method="renewal"),
        "`method`: only for complete observations",
    ),
    (
        "σ, by a coupling",
        score(**ON_A_LINE, proposal=jb.Coupling(0.5)),
        "σ depends on the unknown parameters",
    ),
    ("nothing unknown", score(FREE, TIMES, LINE), "no parameters"),
    # Observations.
    (
        "masked row",
        masked([[0.0, 0.0], [NAN, NAN], [0.1, 0.3]]),
        r"`observations\[1\]` is masked but .* the whole row with its time",
    ),
    (
        "masked entry",
        masked([[0.0, 0.0], [0.5, 0.2], [0.1, NAN]]),
        r"`observations\[2\]` is masked, in coordinate 1, but .* the whole row",
    ),
    (
        "masked time",
        observed(MASKED, POINTS),
        r"`times\[1\]` is masked but observations must be complete",
    ),
    (
        "missing entry",
        observed(TIMES, [[0.0, 0.0], [0.5, NAN], [0.1, 0.3]]),
        r"`observations\[1\]` = .* for coordinate 1, but .* leave out this row, with its time",
    ),
    (
        "missing row",
        observed(TIMES, [[0.0, 0.0], [0.5, 0.2], [NAN, NAN]]),
        r"`observations\[2\]` = .* is not finite: leave out observations that are missing",
    ),
    ("of two records", two_records([[0.0], [0.0], [NAN]]), r"in record 1: `observations\[2\]`"),
]

# Options that another option, or the model, leaves without use.
BUDGET = ("num_counts", "max_proposals", "max_trials")
FREE_RATE = jb.Diffusion(lambda x, p: -p * x, params=1.0)
on_line = {"times": TIMES, "observations": LINE}
of_free = dict(model=FREE_RATE, where=None, constraint=None)
exactly_seen = of(jb.log_likelihood, KEY, OU, **on_line)
CHAIN = jb.PMMHState(jnp.ones(2), 0.0, 0.0, 0.0, jnp.eye(2), 0, (), None)
PATHS = jb.RecordState(jnp.ones(1), None, None, None, 0, jnp.ones((1, 0)), None)
going_on = functools.partial(pmmh, init=CHAIN)

UNUSED = [
    *each(
        "initial", lambda call: call(**INITIAL), [gibbs, pmmh, maximum], "`initial`: only for rec"
    ),
    ("num_warmup", gibbs(num_warmup=3), "`num_warmup`: only for records"),
    ("one state", exactly_seen(times=TIMES[:1], observations=LINE[:1]), "at least two entries"),
    ("a gap", exactly_seen(observations=[NAN, 0.5, 1.0]), "leave out observations that are miss"),
    *(
        (name, exactly_seen(**{name: value}), f"without an `observation` .*leave out .*`{name}`")
        for name, value in [
            ("initial", [0.0]),
            ("initial_time", 0.0),
            ("density", jb.EulerDensity()),
            ("num_filters", 4),
        ]
    ),
    # The work of couplings, where there are none.
    *(
        (f"{name}, no reversal", call(proposal="auto", **{name: 5}), f"`{name}`: for couplings")
        for name in BUDGET
        for call in (
            of(jb.sample_weighted_bridges, KEY, FREE, A, B, 1.0),
            of(jb.sample_exact_bridges, KEY, FREE, A, B, 1.0),
            of(jb.score, KEY, FREE_RATE, **on_line),
            functools.partial(gibbs, **of_free),
        )
    ),
    *(
        (f"{name}, no reversal", call(proposal="auto", **{name: 5}), f"`{name}`: for couplings")
        for name in ("num_counts", "max_trials")
        for call in (
            of(jb.transition_log_density, KEY, FREE, A, B, 1.0),
            of(jb.pmmh, KEY, FREE_RATE, **on_line, prior=PRIOR),
        )
    ),
    *each("σ", lambda b: maximum(proposal="auto", **{b: 5}), BUDGET, ": for couplings.*σ depends"),
    # Counts, where nothing is counted.
    *(
        (f"{name} of {how}", gibbs(proposal=PAIRS, **how, **{name: 5}), f"`{name}`: only weights")
        for name in ("num_counts", "max_trials")
        for how in ({}, {"method": "renewal"}, {"bridges": "approximate"})
    ),
    # A new start, where there is none.
    ("covariance", gibbs(observation=SEEN, init=PATHS, covariance=[0.1]), "`cov.*for a new start"),
    ("covariance", going_on(covariance=[0.1, 0.1]), "`covariance` is for a new start"),
    *each("state", lambda b: going_on(**{b: 5}), BUDGET[::2], ": for a new start"),
    # Declarations.
    ("normalised", diffusion(normalised=True), "`normalised=True` describes `log_stationary`"),
    ("two reversals", diffusion(reverse_drift=DECAY, reversible=True), "leave out `reverse_drift`"),
    # References.
    ("log_density", precision(num_steps=(4,), log_density=-1.0), "`log_density`: for a method"),
    ("fn", precision(methods=("density",), fn=lambda p: p), "`fn`: for a method of paths"),
    (
        "reference",
        precision(methods=("density",), reference=(0.0, 1.0)),
        "`reference`: for a method of paths",
    ),
]

draw = of(plot.bridge_fan, TIMES[:2])
in_space = of(plot.paths_in_space, TIMES[:2])
FLAT_AXES = lambda: in_space(np.ones((1, 2, 2)), plt.subplots()[1])()

PLOT = [
    ("nothing", draw(np.full((3, 2, 2), NAN)), "`paths` must contain a finite path"),
    ("points", draw(np.ones(2)), "`paths` must have shape"),
    ("space", in_space(np.ones((1, 2, 3))), "two coordinates"),
    ("flat axes", FLAT_AXES, "`ax` must be made with", TypeError),
    ("missing", of(plot.qq)({"none": np.full(3, NAN)}, 0.0, 1.0), "must contain finite draws"),
]

# What every function refuses.

KERNELS = (jb.pseudo_marginal, jb.renewal, jb.crank_nicolson)
OF_AN_INTERVAL = [
    jb.sample_bridges,
    jb.sample_weighted_bridges,
    jb.sample_exact_bridges,
    jb.transition_log_density,
    jb.work_precision,
    jb.fit_start_law,
    jb.tune_coupling,
    jb.choose_proposal,
    lambda key, *ends: jb.gaussian_bridge(*ends, times=[0.5]),
    *(lambda key, *ends, kernel=kernel: kernel(*ends).init(key) for kernel in KERNELS),
]
INTERVALS = {
    "a point of another dimension": (PAPER, [0.0], B, 1.0),
    "points in a cube": (PAPER, [[[0.0, 0.0]]], B, 1.0),
    "a point that is missing": (PAPER, [NAN, 0.0], B, 1.0),
    "a point in words": (PAPER, "here", B, 1.0),
    "complex numbers": (PAPER, [1j, 0.0], B, 1.0),
    "no interval": (PAPER, np.ones((0, 2)), B, 1.0),
    "no time at all": (PAPER, A, B, 0.0),
    "time that runs backwards": (PAPER, A, B, -1.0),
    "a model that is none": (3.0, A, B, 1.0),
}
OF_OBSERVATIONS = [
    of(jb.gibbs, KEY, prior=PRIOR),
    of(jb.pmmh, KEY, prior=PRIOR),
    of(jb.score, KEY),
    of(jb.maximum_likelihood, KEY),
    of(jb.path_log_likelihood),
]
OBSERVATIONS = {
    "half precision": (HYPERBOLIC, np.float16(TIMES), np.float16(POINTS)),
    "one time less than points": (HYPERBOLIC, [0.0, 1.0], POINTS),
    "times that do not increase": (HYPERBOLIC, [0.0, 1.0, 1.0], POINTS),
    "a time that is missing": (HYPERBOLIC, [0.0, NAN, 2.0], POINTS),
    "times in words": (HYPERBOLIC, "often", POINTS),
    "a point alone": (HYPERBOLIC, [0.0], [[0.0, 0.0]]),
    "points without coordinates": (HYPERBOLIC, TIMES, [0.0, 0.5, 0.1]),
    "points in words": (HYPERBOLIC, TIMES, "there"),
    "complex numbers": (HYPERBOLIC, TIMES, [[1j, 0.0]] * 3),
    "a model that is none": ("model", TIMES, POINTS),
    # Last, for a likelihood of NaN is data: bridges that were not found are NaN.
    "a point that is missing": (HYPERBOLIC, TIMES, [[0.0, 0.0], [NAN, 0.2], [0.1, 0.3]]),
}
ENDS = dict(model=PAPER, start=A, end=B, duration=1.0)
DATA = dict(model=HYPERBOLIC, times=TIMES, observations=POINTS)
COUNTED = [
    (of(jb.sample_bridges, KEY, **ENDS), "num_bridges num_steps max_proposals batch_size"),
    (of(jb.sample_weighted_bridges, KEY, **ENDS), "num_bridges"),
    (of(jb.sample_exact_bridges, KEY, **ENDS), "num_bridges"),
    (of(jb.transition_log_density, KEY, **ENDS), "num_proposals"),
    (of(jb.gibbs, KEY, **DATA, prior=PRIOR), "num_iterations thin"),
    (of(jb.pmmh, KEY, **DATA, prior=PRIOR), "num_iterations num_proposals"),
    (of(jb.score, KEY, **DATA), "num_bridges"),
    (of(jb.maximum_likelihood, KEY, **DATA), "num_bridges"),
    (of(jb.simulate, KEY, HYPERBOLIC, A, TIMES), "num_paths num_steps"),
    (of(jb.measure_burn_in, KEY, HYPERBOLIC, A, 1.0), "num_steps"),
]
INTEGER = "a static Python integer"
COUNTS = [(0, "at least [12]"), (-1, "at least [12]"), (2.5, INTEGER), (True, INTEGER)]
KEYED = [
    of(jb.sample_bridges, **ENDS),
    of(jb.transition_log_density, **ENDS),
    of(jb.gibbs, **DATA, prior=PRIOR),
    of(jb.pmmh, **DATA, prior=PRIOR),
    of(jb.simulate, model=HYPERBOLIC, x0=A, times=TIMES),
    *(
        lambda key, kernel=kernel: lambda: kernel(PAPER, A, B, 1.0).step(key, None)
        for kernel in KERNELS
    ),
]
ANY = (ValueError, TypeError)

EVERYWHERE = [
    *(
        (what, of(call, KEY)(*INTERVALS[what]), "`", ANY)
        for call, what in itertools.product(OF_AN_INTERVAL, INTERVALS)
    ),
    *(
        (what, call(*OBSERVATIONS[what]), "`", ANY)
        for call, what in list(itertools.product(OF_OBSERVATIONS, OBSERVATIONS))[:-1]
    ),
    *(
        (f"{name}={count}", call(**{name: count}), f"`{name}` must be {said}", ANY)
        for call, names in COUNTED
        for name, (count, said) in itertools.product(names.split(), COUNTS)
    ),
    *(
        ("key", call(key=key), "`key`", ANY)
        for call, key in itertools.product(KEYED, [0, None, jnp.zeros(2, jnp.uint32)])
    ),
]

TABLE = {
    "models": MODELS,
    "schemes": SCHEMES,
    "coupling": COUPLING,
    "proposals": PROPOSALS,
    "exact": EXACT,
    "records": RECORDS,
    "tuning": TUNING,
    "inference": INFERENCE,
    "unused": UNUSED,
    "plot": PLOT,
    "everywhere": EVERYWHERE,
}
ROWS = [
    pytest.param(call, message, *(error or [ValueError]), id=f"{folder}: {what}")
    for folder, rows in TABLE.items()
    for what, call, message, *error in rows
]


@pytest.mark.parametrize("call, message, error", ROWS)
def test_refusals(call, message, error, unchecked):
    with pytest.raises(error, match=message) as caught:
        call()
    sentence = str(caught.value)
    assert "`" in sentence and "Tracer" not in sentence
