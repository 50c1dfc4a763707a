"""Proposals that are pulled to the end point: the Euler scheme with bent noise.

On a grid 0 = t_0 < ... < t_N = T with steps δ_i the Euler scheme is

    x_{i+1} = μ_i + √δ_i σ(x_i) y_i,    μ_i = x_i + α(x_i) δ_i,    y_i ~ N(0, I).

A proposal goes the same steps with y_i ~ N(m_i, C_i), which may depend on x_i, and x_N = b. Its
weight is the Euler density of the path over that of the proposal,

    w = N(b; μ_{N-1}, V(x_{N-1}) δ_{N-1}) Π_{i<N-1} N(y_i; 0, I) / N(y_i; m_i, C_i),

so E[w h(x)] = p̂_T(a, b) E[h(x) | x_N = b] for the Euler scheme without any further error, and
for the diffusion up to its step error, O(δ). With the densities of another discretisation in
the place of Euler's (`step_density`) that is the target: for constant σ O(δ²) is to be had. No
stationary law is called for.

m and C follow from a guess h_{i+1}(x) of the density of b seen from x at t_{i+1}. Where log h
is quadratic, with r̃ = ∇log h(μ_i) and H̃ = -∇²log h, tilting N(0, I) by h gives

    C = (I + δ σᵀ H̃ σ)⁻¹,    m = √δ C σᵀ r̃

(r̃ and H̃ as in Schauer, van der Meulen & van Zanten 2017; the discrete form as in Whitaker,
Golightly, Boys & Sherlock 2017). With the true density in the place of h this is Doob's
h-transform, and w is constant.
"""

from abc import abstractmethod
from typing import Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int, Key, PyTree

from .arrays import Numbers, as_floating, is_traced
from .devices import num_devices
from .diffusion import Diffusion, Dynamics
from .intervals import Intervals, check_model
from .lanes import join_rows, over_lanes, split_rows
from .linalg import all_finite, cholesky, dot, inverse, matmul, matvec, solve, total
from .noise import Store, noisy_scan
from .schemes import Euler
from .search import most_lanes
from .sigma import AbstractSigma
from .step_density import AbstractStepDensity, EulerDensity
from .weighted import (
    AbstractWeightedProposal,
    WeightedPaths,
    block_over_devices,
    in_blocks,
    masked,
)

# Of the duration: shorter steps are lost in the rounding of points.
_SHORTEST_STEP = 1e-10


class NoiseLaw(NamedTuple):
    """N(m, L Lᵀ), the law of one step's standardised noise, which `noise_law` of an
    `AbstractGuidedProposal` returns: `mean` is m, shape (d,), and `root` L, a number, shape (), or
    a lower triangle, (d, d)."""

    mean: Float[Array, " d"]
    root: Float[Array, "..."]

    def bend(self, xi: Float[Array, " d"]) -> Float[Array, " d"]:
        """y = m + L ξ."""
        return self.mean + (self.root * xi if self.root.ndim == 0 else matvec(self.root, xi))

    def unbend(self, y: Float[Array, " d"]) -> Float[Array, " d"]:
        """ξ = L⁻¹ (y - m)."""
        centred = y - self.mean
        return centred / self.root if self.root.ndim == 0 else solve(self.root, centred)

    def log_weight(self, xi: Float[Array, " d"], y: Float[Array, " d"]) -> Float[Array, ""]:
        """log [N(y; 0, I) / N(y; m, L Lᵀ)]."""
        if self.root.ndim == 0:
            log_det = xi.shape[0] * jnp.log(self.root)
        else:
            log_det = total(jnp.log(jnp.diagonal(self.root)))
        return (dot(xi, xi) - dot(y, y)) / 2 + log_det


class Step(NamedTuple):
    """One step of one interval, as `noise_law` of an `AbstractGuidedProposal` sees it.

    - `guide`: what the proposal worked out for the step.
    - `dt`: its length δ_i, in units of time.
    - `remaining`: T - t_i, the time from its beginning to the end.
    - `end`: b, shape (d,).
    """

    guide: PyTree
    dt: Float[Array, "*lanes"]
    remaining: Float[Array, "*lanes"]
    end: Float[Array, "d *lanes"]


class AbstractGuidedProposal(AbstractWeightedProposal):
    """Euler paths whose noise is bent so that they end in b.

    A proposal is a law of the noise, `noise_law`, and what can be worked out for it before any
    path is simulated, `guide`. `density` is that of the target's steps, and `refinement` is ρ
    in t_i = T [1 - (1 - i/N)^ρ].
    """

    density: eqx.AbstractVar[AbstractStepDensity]
    refinement: eqx.AbstractVar[float]

    @abstractmethod
    def guide(
        self,
        dynamics: Dynamics,
        start: Float[Array, " d"],
        end: Float[Array, " d"],
        dt: Float[Array, " N"],
    ) -> PyTree:
        """Anything with leading axis N - 1, of which `noise_law` sees one entry per step."""

    @abstractmethod
    def noise_law(
        self,
        step: Step,
        x: Float[Array, " d"],
        drift: Float[Array, " d"],
        sigma: AbstractSigma,
    ) -> NoiseLaw:
        """N(m_i, C_i) at x_i = x, given α(x) and σ(x)."""

    def check(self, model, intervals):
        check_model(model, intervals, Euler())

    def check_prepared(self, model):
        pass

    def prepared(self, key, model, intervals, num_steps):
        return self

    def fractions(self, num_steps):
        return 1 - self.remaining(num_steps)

    def remaining(self, num_steps: int) -> Float[np.ndarray, " points"]:
        """(T - t_i) / T, down to zero."""
        if num_steps**-self.refinement < _SHORTEST_STEP:
            raise ValueError(
                f"`refinement` = {self.refinement:g} makes the last of {num_steps} steps too short "
                "to be told from none: choose a smaller one."
            )
        return (1 - np.arange(num_steps + 1) / num_steps) ** self.refinement

    def draw(
        self,
        keys,
        model,
        intervals,
        num_steps,
        stored,
        misses_count,
        active=None,
        progress_meter=None,
    ):
        block = block_over_devices(eqx.Partial(_draw_block, self, model, stored, num_steps))
        rows = num_devices() * most_lanes(intervals.start.shape[1])
        return in_blocks(block, keys, intervals, rows, active, progress_meter)

    def reweigh(self, keys, model, intervals, paths, active=None):
        dynamics = model.forward(intervals.start[0])
        _, log_weights = noise_of(self, dynamics, intervals, paths)
        kept = paths[:, None]
        made = _weighted(kept, log_weights[:, None])
        return made if active is None else masked(made, active)


class ModifiedDiffusionBridge(AbstractGuidedProposal):
    """The modified diffusion bridge of Durham & Gallant (2002): as if α and V stayed as they are
    at the current point,

        x_{i+1} ~ N(x_i + (b - x_i) δ_i/(T - t_i), V(x_i) δ_i (T - t_{i+1})/(T - t_i)).

    The best and cheapest proposal on intervals so short that the drift matters little. For
    σ = I it is the Brownian bridge.

    **Arguments:**

    - `density`: of the target's steps, by default `EulerDensity()`; for constant σ
        `TrapezoidDensity()` is far closer to the diffusion.
    - `refinement`: ρ in t_i = T [1 - (1 - i/N)^ρ]: above one, steps shrink towards the end,
        which pays where σ varies much on the way.

    **Example:**

    ```python
    proposal = jb.ModifiedDiffusionBridge()
    chain = jb.sample_exact_bridges(key, model, start, end, 0.1, num_bridges=100, proposal=proposal)
    ```
    """

    density: AbstractStepDensity
    refinement: float = eqx.field(static=True)

    def __init__(self, density: AbstractStepDensity | None = None, refinement: float = 1.0):
        self.density = _check_density(density)
        self.refinement = _check_refinement(refinement)

    def guide(self, dynamics, start, end, dt):
        return None

    def noise_law(self, step, x, drift, sigma):
        return _bridge_law(step, sigma, (step.end - x) / step.remaining - drift)


class ResidualBridge(AbstractGuidedProposal):
    """The residual bridge of Whitaker, Golightly, Boys & Sherlock (2017): the modified diffusion
    bridge of x - ξ, where ξ solves dξ = α(ξ) dt from the start,

        x_{i+1} = x_i + Δξ_i + (b - ξ_N - (x_i - ξ_i)) δ_i/(T - t_i) + noise.

    Better where the drift carries all paths along, on intervals that are short beside the time
    in which it would pull them together.

    **Arguments:**

    - `density`: of the target's steps, by default `EulerDensity()`; for constant σ
        `TrapezoidDensity()` is far closer to the diffusion.
    - `refinement`: ρ in t_i = T [1 - (1 - i/N)^ρ]: above one, steps shrink towards the end,
        which pays where σ varies much on the way.

    **Example:**

    ```python
    proposal = jb.ResidualBridge()
    chain = jb.sample_exact_bridges(key, model, start, end, 0.5, num_bridges=100, proposal=proposal)
    ```
    """

    density: AbstractStepDensity
    refinement: float = eqx.field(static=True)

    def __init__(self, density: AbstractStepDensity | None = None, refinement: float = 1.0):
        self.density = _check_density(density)
        self.refinement = _check_refinement(refinement)

    def guide(self, dynamics, start, end, dt):
        xi, xi_end = deterministic_path(dynamics, start, dt)
        slope = jax.vmap(dynamics.drift)(xi)
        return slope[:-1], (xi + end - xi_end)[:-1]

    def noise_law(self, step, x, drift, sigma):
        slope, target = step.guide
        return _bridge_law(step, sigma, slope - drift + (target - x) / step.remaining)


class _GaussianGuess(NamedTuple):
    """log h(x) = ρᵀ(x - b) - ½ (x - b)ᵀ H (x - b) + constant."""

    shift: Float[Array, " d"]
    precision: Float[Array, "d d"]


class Guided(AbstractGuidedProposal):
    """Guided proposals (Schauer, van der Meulen & van Zanten 2017): h is the transition density
    of a linear process

        dX̃ = [α̃ + F (X̃ - b)] dt + σ̃ dW,

    on the same Euler grid, so that for an Ornstein–Uhlenbeck process and `EulerDensity` all
    weights are equal.

    **Arguments:**

    - `linearisation`: "end", the drift linearised at b, F = ∇α(b), α̃ = α(b), σ̃ = σ(b); "path", all
        of them linearised along the deterministic path dξ = α(ξ) dt from the start, bent so that
        it ends in b; or a matrix F of shape (d, d), with α(b) and σ(b).
    - `density`: of the target's steps, by default `EulerDensity()`; for constant σ
        `TrapezoidDensity()` is far closer to the diffusion.
    - `refinement`: ρ in t_i = T [1 - (1 - i/N)^ρ]: above one, steps shrink towards the end,
        which pays where σ varies much on the way.

    **Raises:** `ValueError` and `TypeError` for anything else.

    **Example:**

    ```python
    proposal = jb.Guided()
    chain = jb.sample_exact_bridges(key, model, start, end, 2.0, num_bridges=100, proposal=proposal)
    ```
    """

    density: AbstractStepDensity
    refinement: float = eqx.field(static=True)
    _along: str = eqx.field(static=True)
    _matrix: Float[Array, "d d"] | None

    def __init__(
        self,
        linearisation: Literal["end", "path"] | Numbers = "end",
        density: AbstractStepDensity | None = None,
        refinement: float = 1.0,
    ):
        self.density = _check_density(density)
        self.refinement = _check_refinement(refinement)
        if isinstance(linearisation, str):
            if linearisation not in ("end", "path"):
                raise ValueError(
                    f'`linearisation` must be "end", "path" or a matrix; got {linearisation!r}.'
                )
            self._along, self._matrix = linearisation, None
            return
        self._along, self._matrix = "end", as_floating("linearisation", linearisation)
        if self._matrix.ndim != 2 or self._matrix.shape[0] != self._matrix.shape[1]:
            raise ValueError(
                f"`linearisation` must be a matrix, shape (d, d); got {self._matrix.shape}."
            )
        if not is_traced(self._matrix) and not np.all(np.isfinite(self._matrix)):
            raise ValueError(f"`linearisation` must be finite; got {self._matrix}.")

    @property
    def linearisation(self) -> str:
        """What the drift is linearised along, in a word."""
        return f'"{self._along}"' if self._matrix is None else "matrix"

    def guide(self, dynamics, start, end, dt):
        d = end.shape[0]
        if self._matrix is not None and self._matrix.shape != (d, d):
            raise ValueError(
                f"the matrix of `Guided` must have shape ({d}, {d}) for points in {d} dimensions; "
                f"got {self._matrix.shape}."
            )
        points = end[None]
        if self._along == "path":
            xi, xi_end = deterministic_path(dynamics, start, dt)
            done = jnp.concatenate([jnp.zeros_like(dt[:1]), jnp.cumsum(dt)[:-1]]) / jnp.sum(dt)
            points = xi + done[:, None] * (end - xi_end)
        coefficients = jax.vmap(lambda x: self._linear(dynamics, x, end))(points)

        def back(guess: _GaussianGuess, inputs) -> tuple[_GaussianGuess, _GaussianGuess]:
            """h_i from h_{i+1}, by one step of the linear process."""
            (F, drift, V), dt = inputs
            shift, H = guess
            step = jnp.eye(d, dtype=end.dtype) + F * dt
            gain = inverse(jnp.eye(d, dtype=end.dtype) + matmul(H, V) * dt)
            shift = matvec(step.T, matvec(gain, shift - matvec(H, drift) * dt))
            H = matmul(step.T, matmul(matmul(gain, H), step))
            return _GaussianGuess(shift, (H + H.T) / 2), guess

        F, drift, V = jax.tree.map(lambda leaf: leaf[-1], coefficients)
        step = jnp.eye(d, dtype=end.dtype) + F * dt[-1]
        pull = matmul(step.T, inverse(V))  # of the last step, from t_{N-1} to b itself
        last = _GaussianGuess(-matvec(pull, drift), matmul(pull, step) / dt[-1])
        num_steps = dt.shape[0]
        each = jax.tree.map(
            lambda leaf: jnp.broadcast_to(leaf, (num_steps, *leaf.shape[1:]))[:-1], coefficients
        )
        _, guesses = lax.scan(back, last, (each, dt[:-1]), reverse=True)
        return guesses

    def noise_law(self, step, x, drift, sigma):
        shift, H = step.guide
        d, root_dt = x.shape[0], jnp.sqrt(step.dt)
        r = shift - matvec(H, x + drift * step.dt - step.end)
        curvature = _congruence(H, sigma, d)
        C = inverse(jnp.eye(d, dtype=x.dtype) + step.dt * curvature)
        C = (C + C.T) / 2
        return NoiseLaw(root_dt * matvec(C, sigma.mv_transpose(r)), cholesky(C))

    def _linear(self, dynamics: Dynamics, x: Float[Array, " d"], end: Float[Array, " d"]):
        """F, the linear drift at b, and Ṽ, when the diffusion is linearised at x."""
        F = jax.jacfwd(dynamics.drift)(x) if self._matrix is None else self._matrix.astype(x.dtype)
        sigma = dynamics.sigma(x)
        V = _congruence_of_root(sigma, x)
        return F, dynamics.drift(x) + matvec(F, end - x), V


class _Steps(NamedTuple):
    """The fields of `Step` that change from step to step, for a scan."""

    guide: PyTree
    dt: Float[Array, "*steps I"]
    remaining: Float[Array, "*steps I"]


class _State(NamedTuple):
    """The point where a path is, its log weight so far, and what was seen at that point."""

    x: Float[Array, "d *lanes"]
    log_weight: Float[Array, "*lanes"]
    seen: PyTree


class _Lanes:
    """The steps of a proposal for n paths of each of I intervals, side by side: I n lanes. What
    belongs to a single interval is worked out once and shared by its paths."""

    def __init__(
        self,
        proposal: AbstractGuidedProposal,
        dynamics: Dynamics,
        intervals: Intervals,
        num_steps: int,
        num_draws: int = 1,
    ):
        start, end, duration = intervals
        fractions = proposal.remaining(num_steps)
        dt = jnp.asarray(-np.diff(fractions), start.dtype)[:, None] * duration
        remaining = jnp.asarray(fractions[:-1], start.dtype)[:, None] * duration
        guide = jax.vmap(proposal.guide, in_axes=(None, 0, 0, 1), out_axes=-1)(
            dynamics, start, end, dt
        )
        self._num_draws = num_draws
        self._of_lane = None if start.shape[0] == 1 else -1
        self.start, self.end, self._last_dt = start.T, end.T, dt[-1]
        self.steps = _Steps(guide, dt[:-1], remaining[:-1])
        self._proposal, self._dynamics, self._density = proposal, dynamics, proposal.density

    def spread(self, leaf: Float[Array, "*shape I"]) -> Float[Array, "*shape lanes"]:
        """What belongs to an interval, for each of its lanes."""
        return jnp.repeat(leaf, self._num_draws, axis=-1)

    def begin(self) -> _State:
        """Paths at their start, with weight one."""
        start = self.spread(self.start)
        look = over_lanes(-1)(lambda x: self._density.look(self._dynamics, x))
        return _State(start, jnp.zeros_like(start[0]), look(start))

    def advance(self, state: _State, xi: Float[Array, "d lanes"], steps: _Steps) -> _State:
        """One step with the noise ξ, and the weight with its factor."""

        def one(state, xi, step):
            law, mu, sigma = _step_law(self._proposal, self._dynamics, step, state.x)
            y = law.bend(xi)
            x_next = mu + jnp.sqrt(step.dt) * sigma.mv(y)
            return self._weighed(state, x_next, law.log_weight(xi, y), step.dt)

        return over_lanes(-1, -1, self._of_lane)(one)(state, xi, self._step(steps))

    def retrace(
        self, state: _State, x_next: Float[Array, "d lanes"], steps: _Steps
    ) -> tuple[_State, Float[Array, "d lanes"]]:
        """The step to these points, and the noise ξ that it takes."""

        def one(state, x_next, step):
            law, mu, sigma = _step_law(self._proposal, self._dynamics, step, state.x)
            y = sigma.solve(x_next - mu) / jnp.sqrt(step.dt)
            xi = law.unbend(y)
            return self._weighed(state, x_next, law.log_weight(xi, y), step.dt), xi

        return over_lanes(-1, -1, self._of_lane)(one)(state, x_next, self._step(steps))

    def finish(self, state: _State) -> Float[Array, " lanes"]:
        """The log weights with that of the last step, to b."""

        def one(state, last):
            end, dt = last
            # Euler steps may lead out of the state space, where no bridge ends.
            inside = all_finite(self._dynamics.drift(end))
            inside &= jnp.isfinite(self._dynamics.sigma(end).log_abs_det())
            density = _log_euler_density(self._dynamics, state.x, end, dt)
            weighed = self._weighed(state, end, density, dt)
            return jnp.where(inside, weighed.log_weight, jnp.nan)

        last = self._for_lanes((self.end, self._last_dt))
        return over_lanes(-1, self._of_lane)(one)(state, last)

    def _step(self, steps: _Steps) -> Step:
        return Step(*self._for_lanes((*steps, self.end)))

    def _for_lanes(self, of_intervals: PyTree) -> PyTree:
        """Without an axis for a single interval, which all lanes share."""
        if self._of_lane is None:
            return jax.tree.map(lambda leaf: leaf[..., 0], of_intervals)
        return jax.tree.map(self.spread, of_intervals)

    def _weighed(self, state: _State, x_next, log_weight, dt) -> _State:
        """The state at x_next, given the weight of the Euler step."""
        seen = self._density.look(self._dynamics, x_next)
        both = (state.x, x_next, state.seen, seen)
        log_weight += self._density.log_ratio(self._dynamics, *both, dt)
        return _State(x_next, state.log_weight + log_weight, seen)


def _step_law(
    proposal: AbstractGuidedProposal, dynamics: Dynamics, step: Step, x: Float[Array, " d"]
) -> tuple[NoiseLaw, Float[Array, " d"], AbstractSigma]:
    """N(m_i, C_i), μ_i and σ at x."""
    drift, sigma = dynamics.drift(x), dynamics.sigma(x)
    return proposal.noise_law(step, x, drift, sigma), x + drift * step.dt, sigma


def _log_euler_density(
    dynamics: Dynamics, x: Float[Array, " d"], x_next: Float[Array, " d"], dt: Float[Array, ""]
) -> Float[Array, ""]:
    """log N(x_next; x + α(x) δ, V(x) δ)."""
    sigma = dynamics.sigma(x)
    white = sigma.solve(x_next - x - dynamics.drift(x) * dt)
    log_det = x.shape[0] * jnp.log(2 * np.pi * dt) / 2 + sigma.log_abs_det()
    return -dot(white, white) / dt / 2 - log_det


def noise_of(
    proposal: AbstractGuidedProposal,
    dynamics: Dynamics,
    intervals: Intervals,
    paths: Float[Array, "I points d"],
) -> tuple[Float[Array, "I steps d"], Float[Array, " I"]]:
    """The noise ξ_0, ..., ξ_{N-2} from which the proposal makes these paths, one for each
    interval, and their log weights."""
    lanes = _Lanes(proposal, dynamics, intervals, paths.shape[1] - 1)

    def each(state, inputs):
        x_next, steps = join_rows(inputs)
        state, xi = lanes.retrace(join_rows(state), x_next, steps)
        return split_rows(state), split_rows(xi)

    inputs = split_rows((jnp.moveaxis(paths, 0, -1)[1:-1], lanes.steps), axis=1)
    state, xi = lax.scan(each, split_rows(lanes.begin()), inputs)
    return jnp.moveaxis(join_rows(xi, axis=1), -1, 0), lanes.finish(join_rows(state))


def path_of(
    proposal: AbstractGuidedProposal,
    dynamics: Dynamics,
    intervals: Intervals,
    xi: Float[Array, "I steps d"],
) -> tuple[Float[Array, "I points d"], Float[Array, " I"]]:
    """The paths that the proposal makes from this noise, and their log weights: the inverse of
    `noise_of`."""
    lanes = _Lanes(proposal, dynamics, intervals, xi.shape[1] + 1)

    def each(state, inputs):
        state = lanes.advance(join_rows(state), *join_rows(inputs))
        return split_rows(state), split_rows(state.x)

    inputs = split_rows((jnp.moveaxis(xi, 0, -1), lanes.steps), axis=1)
    state, path = lax.scan(each, split_rows(lanes.begin()), inputs)
    path = jnp.concatenate([lanes.start[None], join_rows(path, axis=1), lanes.end[None]])
    return jnp.moveaxis(path, -1, 0), lanes.finish(join_rows(state))


def _weighted(paths: Float[Array, "I n K d"], log_weights: Float[Array, "I n"]) -> WeightedPaths:
    """One simulated path each; those that left the finite numbers are not found."""
    found = jnp.isfinite(log_weights)
    return WeightedPaths(
        jnp.where(found[..., None, None], paths, jnp.nan),
        jnp.where(found, log_weights, -jnp.inf),
        found,
        jnp.zeros_like(found),
        jnp.ones(found.shape, jnp.int32),
        (~found).astype(jnp.int32),
    )


class _Inputs(NamedTuple):
    """Everything that paths and weights may be differentiated with respect to."""

    proposal: AbstractGuidedProposal
    model: Diffusion
    intervals: Intervals


def _draw_block(
    proposal: AbstractGuidedProposal,
    model: Diffusion,
    stored: Int[Array, " K"] | None,
    num_steps: int,
    keys: Key[Array, "I n"],
    intervals: Intervals,
    active: Bool[Array, " I"] | None,
) -> WeightedPaths:
    return _weighted(*_draw(_Inputs(proposal, model, intervals), keys, stored, num_steps))


@eqx.filter_custom_jvp
def _draw(
    inputs: _Inputs, keys: Key[Array, "I n"], stored: Int[Array, " K"] | None, num_steps: int
) -> tuple[Float[Array, "I n K d"], Float[Array, "I n"]]:
    """One path for each key, and its log weight."""
    return _simulate(inputs, keys, stored, num_steps, None)


@_draw.def_jvp
def _draw_tangents(primals, tangents):
    """Paths that left the finite numbers have no derivatives. They are run without noise here, for
    in reverse mode a masked 0 · ∞ would be NaN."""
    inputs, keys, stored, num_steps = primals
    drawn = _draw(inputs, keys, stored, num_steps)
    found = jnp.isfinite(drawn[1])

    def again(inputs):
        paths, log_weights = _simulate(inputs, keys, stored, num_steps, found)
        return jnp.where(found[..., None, None], paths, 0), jnp.where(found, log_weights, 0)

    return drawn, eqx.filter_jvp(again, (inputs,), (tangents[0],))[1]


def _simulate(
    inputs: _Inputs,
    keys: Key[Array, "I n"],
    stored: Int[Array, " K"] | None,
    num_steps: int,
    noisy: Bool[Array, "I n"] | None,
) -> tuple[Float[Array, "I n K d"], Float[Array, "I n"]]:
    """Paths and log weights; without noise where `noisy` is given and false."""
    proposal, model, intervals = inputs
    dynamics = model.forward(intervals.start[0])
    (num_intervals, num_draws), (_, d) = keys.shape, intervals.start.shape
    dtype = intervals.start.dtype
    lanes = _Lanes(proposal, dynamics, intervals, num_steps, num_draws)
    state, end = lanes.begin(), lanes.spread(lanes.end)
    path = state.x[None][:0]
    store = slots = None
    if stored is not None:
        # Row K is for waste; rows of the first and the last step are filled by hand.
        rows = jnp.broadcast_to(state.x, (stored.shape[0] + 1, *state.x.shape))
        slots = jnp.full(num_steps + 1, stored.shape[0]).at[stored].set(jnp.arange(len(stored)))
        store = Store(slots[1:-1], rows)
    start = state.x
    if num_steps > 1:

        def step(state, inputs):
            xi, steps = inputs
            xi = xi if noisy is None else jnp.where(noisy.reshape(-1), xi, 0)
            state = lanes.advance(state, xi, steps)
            return state, state.x

        state, path = noisy_scan(
            step,
            state,
            keys.reshape(-1),
            lambda key, k: jax.random.normal(key, (k, d), dtype),
            lanes.steps,
            num_steps - 1,
            store=store,
        )
    elif store is not None:
        path = store.rows
    log_weights = lanes.finish(state).reshape(keys.shape)
    if slots is None:
        path = jnp.concatenate([start[None], path, end[None]])
    else:
        path = path.at[slots[-1]].set(end)[:-1]
    path = path.reshape(-1, d, num_intervals, num_draws)
    return jnp.moveaxis(path, (2, 3), (0, 1)), log_weights


def deterministic_path(
    dynamics: Dynamics, start: Float[Array, " d"], dt: Float[Array, " N"]
) -> tuple[Float[Array, "N d"], Float[Array, " d"]]:
    """ξ_0, ..., ξ_{N-1} and ξ_N of dξ = α(ξ) dt from the start, by Euler's rule."""
    end, path = lax.scan(lambda xi, dt: (xi + dynamics.drift(xi) * dt, xi), start, dt)
    return path, end


def _bridge_law(step: Step, sigma: AbstractSigma, velocity: Float[Array, " d"]) -> NoiseLaw:
    """m = √δ σ⁻¹ v and C = (T - t_{i+1})/(T - t_i) I."""
    mean = jnp.sqrt(step.dt) * sigma.solve(velocity)
    return NoiseLaw(mean, jnp.sqrt((step.remaining - step.dt) / step.remaining))


def _congruence(matrix: Float[Array, "d d"], sigma: AbstractSigma, d: int) -> Float[Array, "d d"]:
    """σᵀ M σ."""
    columns = jax.vmap(sigma.mv_transpose, in_axes=1, out_axes=1)(matrix)
    return jax.vmap(sigma.mv_transpose)(columns)


def _congruence_of_root(sigma: AbstractSigma, x: Float[Array, " d"]) -> Float[Array, "d d"]:
    """V = σ σᵀ."""
    matrix = sigma.as_matrix(x.shape[0], x.dtype)
    return matmul(matrix, matrix.T)


def _check_density(density: AbstractStepDensity | None) -> AbstractStepDensity:
    density = EulerDensity() if density is None else density
    if not isinstance(density, AbstractStepDensity):
        raise TypeError(
            f"`density` must be `EulerDensity()` or `TrapezoidDensity()`; got {density!r}."
        )
    return density


def _check_refinement(refinement: float) -> float:
    if isinstance(refinement, bool) or not isinstance(refinement, int | float):
        raise TypeError(
            f"`refinement` must be a Python number, known when compiling; got {refinement!r}."
        )
    if not 1 <= refinement <= 4:
        raise ValueError(f"`refinement` must be between 1 (equal steps) and 4; got {refinement}.")
    return float(refinement)
