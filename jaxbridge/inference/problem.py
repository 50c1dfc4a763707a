"""What is inferred from what: the unknown parameters of a model, from discrete observations."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float, Key, PyTree

from ..engine.checks import Numbers, check_count, check_key, is_traced
from ..models.bridge_problem import Intervals
from ..models.diffusion import Diffusion, check_diffusion
from .observations import Group, as_observations, step_groups
from .unknowns import (
    Constraint,
    Unknowns,
    as_unknowns,
    check_allowed,
    check_coordinates_known,
    check_sigma_known,
    init_vectors,
)


class Problem(NamedTuple):
    """The intervals between observations, in groups of one number of steps, and the unknown
    parameters, with θ as it is in the model."""

    intervals: Intervals
    groups: tuple[Group, ...]
    unknowns: Unknowns
    theta: Float[Array, " p"]

    @property
    def like(self) -> Float[Array, " d"]:
        """A point of the state space."""
        return self.intervals.start[0]

    def pilot_model(self, theta: Float[Array, "*chains p"]) -> Diffusion:
        """The model at which proposals are chosen: that of the first chain."""
        return self.unknowns.at(first_chain(theta))


def as_problem(
    key: Key[Array, ""],
    model: Diffusion,
    times: Numbers,
    observations: Numbers,
    where: Callable[[PyTree], PyTree] | None,
    num_steps: int | None,
    step_size: float | None,
    sigma_unknown: str | None = None,
) -> Problem:
    """What the arguments that all ways of inference share say. `sigma_unknown` is what to do
    instead where σ depends on the unknown parameters, if it must not.

    **Raises:** `ValueError` and `TypeError` for arguments that do not fit.
    """
    check_key(key)
    check_diffusion(model)
    intervals = as_observations(model, times, observations)
    unknowns, theta = as_unknowns(model, where, intervals.start[0])
    check_coordinates_known(unknowns, theta)
    if sigma_unknown is not None:
        check_sigma_known(unknowns, theta, intervals.start[0], sigma_unknown)
    groups = step_groups(intervals.duration, num_steps, step_size)
    return Problem(intervals, groups, unknowns, theta)


def starting_points(
    problem: Problem,
    init: PyTree,
    num_chains: int | None,
    constraint: Constraint | None,
    log_prior: Callable[[Array], Array],
    state_type: type,
) -> tuple[Float[Array, "*chains p"], Any]:
    """θ of each chain, and the state to go on from, if `init` is one."""
    chains = () if num_chains is None else (check_count("num_chains", num_chains),)
    state = init if isinstance(init, state_type) else None
    theta = problem.theta
    if state is not None:
        theta = state.theta
        if theta.shape[-1] != problem.theta.shape[0]:
            raise ValueError(
                f"`init` is a state of {theta.shape[-1]} unknown parameters, but there are "
                f"{problem.theta.shape[0]}."
            )
        if theta.shape[:-1] != chains and num_chains is not None:
            raise ValueError(
                f"`init` is a state of chains {theta.shape[:-1]}, but `num_chains` is {num_chains}."
            )
    elif init is not None:
        theta = init_vectors(problem.unknowns, init, chains).astype(theta.dtype)
    if theta.ndim == 1:
        theta = jnp.broadcast_to(theta, (*chains, *theta.shape))
    check_allowed(constraint, problem.unknowns, theta)
    for row in theta.reshape(-1, theta.shape[-1]):
        if not is_traced(value := log_prior(row)) and not jnp.isfinite(value):
            raise ValueError(
                f"`prior` is {value} at the parameters to start from, "
                f"{problem.unknowns.pick(row)}: start where its density is positive, by `init=`."
            )
    return theta, state


def first_chain(theta: Float[Array, "*chains p"]) -> Float[Array, " p"]:
    """θ of the first chain."""
    return theta.reshape(-1, theta.shape[-1])[0]
