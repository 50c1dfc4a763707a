"""What is asked of a record: the model, what was seen and how, and where it began."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..coupling import Stationary
from ..engine.checks import Numbers
from ..engine.memory_maps import warn_near_limit_of_maps
from ..models.diffusion import Diffusion, check_diffusion
from ..proposals.guided import check_step_density
from ..schemes import AbstractStepDensity, EulerDensity, ItoTaylorDensity
from .initial import Initial, bound, initial_law
from .observation import Observation, Scalars, check_observation
from .record import Record, as_records, split_records


class RecordProblem(eqx.Module):
    """A record of a model, how it was seen, and where it began; `density` is that of the steps."""

    model: Diffusion
    record: Record
    observation: Observation
    initial: Initial
    density: AbstractStepDensity
    dim: int = eqx.field(static=True)

    @property
    def num_steps(self) -> int:
        """N, of each segment."""
        return self.record.num_steps

    @property
    def num_segments(self) -> int:
        return self.record.dt.shape[-2]

    @property
    def like(self) -> Float[Array, " d"]:
        """A point, of which only shape and dtype count."""
        return jnp.zeros(self.dim, self.record.dt.dtype)

    def scalars(self, model: Diffusion) -> Scalars:
        """What is seen at the ends of segments, with a leading axis K + 1."""
        of_one = lambda y: self.observation.scalars(y, model.params, self.dim)
        return jax.vmap(of_one)(self.record.values)


def as_record_problem(
    model: Diffusion,
    times: Numbers,
    observations: Numbers,
    observation: Observation,
    initial: Initial,
    *,
    num_steps: int | None = None,
    step_size: float | None = None,
    initial_time: Numbers | None = None,
    density: AbstractStepDensity | None = None,
    any_constant: bool = False,
) -> RecordProblem:
    """What the arguments that all who read one record share say. The constant of ν may be unknown
    where only paths at fixed parameters are asked for, `any_constant`.

    **Raises:** `ValueError` and `TypeError` for arguments that do not fit.
    """
    seen = split_records(times, observations)
    if len(seen) > 1:
        raise ValueError(
            f"`observations` are {len(seen)} records, and here there is a path of one: given the "
            "parameters they are independent, so take one after the other."
        )
    (record,) = as_records(seen, num_steps, step_size, initial_time)
    return problem_of(model, record, observation, initial, density, any_constant)


def problem_of(
    model: Diffusion,
    record: Record,
    observation: Observation,
    initial: Initial,
    density: AbstractStepDensity | None = None,
    any_constant: bool = False,
) -> RecordProblem:
    """What is asked of a record.

    **Raises:** `ValueError` and `TypeError` for arguments that do not fit.
    """
    warn_near_limit_of_maps()
    check_diffusion(model)
    check_observation(observation)
    m = record.values.shape[1]
    guess = observation.linear
    dim = m if guess.matrix is None else guess.matrix.shape[1]
    like = jnp.zeros(dim, record.values.dtype)
    observation.check(dim, m, like, model.params)
    if initial is None:
        if not model.has_density:
            raise ValueError(
                "`initial` is missing: give a point, a `GaussianLaw`, or the model a "
                "`log_stationary`, whose law is where records begin by default."
            )
        initial = Stationary()
    if isinstance(bound(initial, model), Stationary) and not (model.normalised or any_constant):
        raise ValueError(
            "`initial` is the stationary law, whose constant is part of the likelihood and may "
            "depend on parameters, but this model is not declared `normalised`: declare it, if "
            "`log_stationary` is the log of a density, or give `initial=` a point or a "
            "`GaussianLaw`."
        )
    jax.eval_shape(lambda model: initial_law(initial, model, like), model)  # for its checks
    if density is None:
        varies = model.sigma_varies(like)
        density = EulerDensity() if varies else ItoTaylorDensity()
    return RecordProblem(model, record, observation, initial, check_step_density(density), dim)
