"""Validated problem of a record: model, observations, observation model and initial law.

All functions that take records validate their arguments here, so their errors are the same.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..coupling import Stationary
from ..engine.checks import is_traced
from ..engine.times import check_resolved
from ..models.diffusion import Diffusion, check_diffusion
from ..models.jumps import JumpMap
from ..schemes import (
    AbstractStepDensity,
    check_step_density,
    known_transition,
    most_accurate_density,
)
from .initial import Initial, as_initial, bound, check_initial
from .motion import Motion
from .observations import (
    AbstractObservation,
    LinearGaussian,
    Row,
    Scalars,
    check_observation,
    matrix_for,
)
from .record import Record, Steps

# Dimensions up to 2 d plus this number are tried, to name the right one in the error message.
_MOST_TRIED = 8


class RecordProblem(eqx.Module):
    """Record of a model, with the observation model and the law of the first state.

    `density` is the density of the steps, and `jump_map` the map of the jumps, if there are any.
    """

    model: Diffusion
    record: Record
    observation: AbstractObservation
    initial: Initial
    density: AbstractStepDensity
    jump_map: JumpMap | None
    dim: int = eqx.field(static=True)

    @property
    def num_steps(self) -> int:
        """Return N, the number of steps per segment."""
        return self.record.num_steps

    @property
    def num_segments(self) -> int:
        """Return K, the number of segments."""
        return self.record.dt.shape[-2]

    @property
    def like(self) -> Float[Array, " d"]:
        """Return an example of a state, which shows only shape and dtype."""
        return jnp.zeros(self.dim, self.record.dt.dtype)

    @property
    def rows(self) -> Row:
        """Return the observations at the ends of segments, leading axis K + 1."""
        return Row(self.record.values, self.record.times)

    def on_grid(self, record: Record) -> Record:
        """Return a record with equal steps on the grid that `density` needs.

        Steps to observations are normal. If the others are not, they are split (`guided_steps`).
        """
        return record if self.density.is_normal else record.with_split_ends()

    def steps(self, model: Diffusion) -> Steps:
        """Return all steps, leading axes (K, N)."""
        dt, times = self.record.dt, self.record.middles()

        def transition(dt, time):
            dynamics = model.forward_at(self.like)(time)
            return known_transition(self.density, dynamics, self.like, dt)

        jumps = self.record.jumps_of_steps()
        return Steps(dt, times, jax.vmap(jax.vmap(transition))(dt, times), jumps)

    def jumps_are_affine(self, model: Diffusion) -> bool:
        """Return whether each jump is an affine function of the state."""
        if self.jump_map is None or self.record.jump is None:
            return True
        return self.jump_map.is_affine(self.like, self.record.jump, model.params)

    def after_jumps(self, model: Diffusion, begins: Float[Array, "K d"]) -> Float[Array, "K d"]:
        """Return the states after the jumps at the beginnings of all segments."""
        if self.jump_map is None:
            return begins
        return jax.vmap(self.motion(model).after_jump)(begins, self.record.jump)

    def motion(self, model: Diffusion) -> Motion:
        """Return the law of the steps at these parameters."""
        return Motion(self.density, model.forward_at(self.like), self.jump_map, model.params)

    def scalars(self, model: Diffusion) -> Scalars:
        """Return the observations as independent scalars, leading axis K + 1."""
        of_one = lambda row: self.observation.scalars(row, model.params, self.dim)
        return jax.vmap(of_one)(self.rows)


def problem_of(
    model: Diffusion,
    record: Record,
    observation: AbstractObservation,
    initial: Initial,
    density: AbstractStepDensity | None = None,
    jump_map: JumpMap | None = None,
    any_constant: bool = False,
    normal_steps: bool = False,
) -> RecordProblem:
    """Validate the model, observation model and initial law of a record.

    - `any_constant`: whether the stationary density may be unnormalised. It may be if only paths at
        fixed parameters are needed.
    - `normal_steps`: whether all steps must be normal (`most_accurate_density`).

    **Raises:** `ValueError` and `TypeError` for invalid arguments.
    """
    check_diffusion(model)
    check_observation(observation)
    m = record.values.shape[1]
    # Without a matrix the whole state is observed.
    dim = m if observation.matrix is None else observation.matrix.shape[1]
    like = jnp.zeros(dim, record.values.dtype)
    _check_dimension(model, observation, like)
    observation.check(record.values, like, record.first_time, model.params)
    if initial is None:
        if not model.has_density:
            raise ValueError(
                "`initial` is missing, and the model has no stationary law to use by default: pass "
                "a point or a `GaussianLaw` as `initial`, or a `log_stationary` to `Diffusion` "
                "(with `normalised=True` for likelihoods)."
            )
        initial = Stationary()
    initial = as_initial(initial)
    if isinstance(bound(initial, model), Stationary) and not (model.normalised or any_constant):
        raise ValueError(
            "`initial` is the stationary law, whose constant is part of the likelihood and may "
            "depend on parameters, but this model is not declared `normalised`: declare it if "
            "`log_stationary` is the log of a density, or pass a point or a `GaussianLaw` as "
            "`initial`."
        )
    check_initial(initial, model, like)
    check_domain(model, observation, record)
    check_clock(model, observation, record)
    if jump_map is not None:
        assert record.jump is not None
        jump_map.check(like, record.jump.inputs[0], model.params)
    density = check_step_density(density)
    if density is None:
        density = most_accurate_density(model, like, normal_steps)
    return RecordProblem(model, record, observation, initial, density, jump_map, dim)


def _check_dimension(
    model: Diffusion, observation: AbstractObservation, like: Float[Array, " d"]
) -> None:
    """Raise `ValueError` if the dimensions of the model and of the observation model differ."""
    if _has_dimension(model, like):
        return
    (d,), most = like.shape, 2 * like.shape[0] + _MOST_TRIED
    fits = [n for n in range(1, most) if _has_dimension(model, jnp.zeros(n, like.dtype))]
    if not fits:  # the error is in the model, and its evaluation reports it
        return
    if observation.matrix is None:
        raise ValueError(
            f"`observations` have {d} components, but without a `matrix` the whole state of "
            f"{fits[0]} components is observed: pass the `matrix` of the observation model, shape "
            f"({d}, {fits[0]})."
        )
    rows = observation.matrix.shape[0]
    raise ValueError(
        f"`matrix` must have shape ({rows}, {fits[0]}) for a state of {fits[0]} dimensions; got "
        f"shape {observation.matrix.shape}."
    )


def _has_dimension(model: Diffusion, like: Float[Array, " d"]) -> bool:
    """Return whether the model accepts states of this shape."""

    def coefficients(model, x):
        dynamics = model.forward_at(x)(jnp.zeros((), x.dtype))
        return dynamics.drift(x), dynamics.sigma(x).as_matrix(len(x), x.dtype)

    try:
        # Shapes are enough, so nothing is computed.
        _, sigma = jax.eval_shape(coefficients, model, like)
    except Exception:  # functions of the user may raise anything
        return False
    return sigma.shape[0] == like.shape[0]


def check_clock(model: Diffusion, observation: AbstractObservation, record: Record) -> None:
    """Raise `ValueError` if large times are too imprecise for time-dependent functions."""
    if model.depends_on_time:
        check_resolved(record.clock, record.since, record.dt)
    elif observation.depends_on_time:
        check_resolved(record.clock, record.since, record.durations)


def check_domain(model: Diffusion, observation: AbstractObservation, record: Record) -> None:
    """Raise `ValueError` if a complete exact observation is outside the state space."""
    is_inside = model.state_space()
    if is_inside is None or not isinstance(observation, LinearGaussian):
        return
    if observation.depends_on_time:  # the noise may vanish at some times only
        return
    d, values = record.values.shape[-1], record.values[record.which]
    if is_traced(model, observation, values):
        return
    matrix, first_time = matrix_for(observation.matrix, d, values.dtype), record.first_time
    matrix, R, offset = (
        np.asarray(part, float)
        for part in (
            matrix,
            observation.covariance_for(model.params, d, first_time),
            observation.offset_for(model.params, d, first_time),
        )
    )
    # Only complete observations without noise determine the state.
    if matrix.shape != (d, d) or np.any(R):
        return
    complete = np.all(np.isfinite(np.asarray(values)), axis=1)
    states = np.linalg.solve(matrix, np.where(complete[:, None], values - offset, 0).T).T
    inside = jax.vmap(is_inside)(jnp.asarray(states, values.dtype))
    outside = np.flatnonzero(complete & ~np.asarray(inside))
    if outside.size:
        raise ValueError(
            f"`observations[{outside[0]}]` is an exact observation of the state "
            f"{states[outside[0]]}, which is outside the model's `domain`: give it noise, or "
            "replace it by NaN."
        )
