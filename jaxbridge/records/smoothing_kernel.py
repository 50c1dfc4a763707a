"""The chain of `smooth` on paths given a record, as a kernel for a user's own sampler."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key

from ..engine.checks import Numbers, as_floating, check_count, check_key, nondifferentiable
from ..engine.compiled import compiled_sooner
from ..engine.entry import public_entry
from ..exact import Kernel
from ..models.diffusion import Diffusion
from ..models.jumps import JumpsLike
from ..schemes import AbstractStepDensity
from .guide_search import Linearised, linearised, no_check
from .guided_record import guided
from .initial import Initial
from .observations import AbstractObservation
from .path_blocks import cuts, swept_path, tuned
from .problem import RecordProblem
from .record import check_is_one
from .several import as_record_problems
from .smooth import guided_paths


class SmoothingState(NamedTuple):
    """State of the chain of `smoothing_kernel`.

    - `position`: the path, shape (K, d), at the times that `smooth` returns.
    - `log_scales`: log β of the moves of B blocks in both partitions, shape (2, B).
    - `number`: number of steps so far.
    """

    position: Float[Array, "K d"]
    log_scales: Float[Array, "2 B"]
    number: Int[Array, ""]


class SmoothingInfo(NamedTuple):
    """Report of one step: `accepted`, whether each block moved, shape (2, B)."""

    accepted: Bool[Array, "2 B"]


@public_entry
def smoothing_kernel(
    model: Diffusion,
    times: Numbers,
    observations: Numbers,
    *,
    observation: AbstractObservation,
    initial: Initial = None,
    guide_path: Numbers | None = None,
    block_length: int = 10,
    num_warmup: int = 100,
    num_steps: int | None = None,
    step_size: float | None = None,
    initial_time: Numbers | None = None,
    jumps: JumpsLike = None,
    density: AbstractStepDensity | None = None,
) -> Kernel:
    """Return the kernel of `smooth`, which leaves the law of a path given its record invariant.

    In a Gibbs sampler of your own, alternate it with moves of the parameters given the path, and
    build it anew for each value of the parameters. σ must be known, because a path determines it.

    `init(position, rng_key)` takes a path of shape (K, d). With `None` it proposes a first path.
    `step(rng_key, state)` returns a `SmoothingState` and a `SmoothingInfo`.

    **Arguments:**

    - `model`, `times`, `observations`, `observation`, `initial`, `num_steps`, `step_size`,
        `initial_time`, `jumps`: as in `innovations`, for one record.
    - `guide_path`: a likely path, shape (K, d), along which the model is linearised. By default it
        is searched for, which takes as long as some steps. A fixed path, such as a mean of
        `smooth`, saves this time. It must not depend on the state of the chain.
    - `block_length`: as in `smooth`.
    - `num_warmup`: number of first steps, which adapt the sizes of the moves. Their draws do not
        count.
    - `density`: as in `innovations`, but steps are normal: for a state-dependent σ they are
        `EulerDensity()` by default.

    **Raises:** `ValueError` and `TypeError` for invalid arguments, and for several records.

    **Example:**

    ```python
    observation = jb.LinearGaussian(covariance=0.01)
    kernel = jb.smoothing_kernel(model, times, observations, observation=observation, num_steps=4)
    state, info = kernel.step(jax.random.key(1), kernel.init(None, jax.random.key(0)))
    ```
    """
    block_length = check_count("block_length", block_length, 2)
    warmup = jnp.int32(check_count("num_warmup", num_warmup, 0))
    check_is_one("smoothing_kernel", times, observations, "build a kernel")
    problem = as_record_problems(
        model,
        times,
        observations,
        observation,
        initial,
        num_steps=num_steps,
        step_size=step_size,
        initial_time=initial_time,
        jumps=jumps,
        density=density,
        normal_steps=True,
    ).problem(0)
    shape = problem.num_segments * problem.num_steps + 1, problem.dim

    def as_path(name: str, value: Numbers) -> Float[Array, "K d"]:
        path = as_floating(name, value)
        if path.shape != shape:
            raise ValueError(
                f"`{name}` must be a path at the times that `smooth` returns, shape {shape}; got "
                f"shape {path.shape}."
            )
        return path.astype(problem.like.dtype)

    if guide_path is None:
        linearisation = linearised(problem, model)
    else:
        linearisation = _linearised_along(problem, as_path("guide_path", guide_path))

    @public_entry
    def init(position, rng_key):
        check_key(rng_key)
        if position is None:
            path = guided_paths(rng_key, problem, linearisation, 1)[0]
        else:
            path = as_path("position", position)
        num_blocks = cuts(problem.num_segments, block_length).shape[-1]
        return SmoothingState(path, jnp.zeros((2, num_blocks), path.dtype), jnp.int32(0))

    @public_entry
    def step(rng_key, state):
        check_key(rng_key)
        return _step(rng_key, problem, linearisation, block_length, warmup, state)

    return Kernel(init, step)


@compiled_sooner
def _linearised_along(problem: RecordProblem, path: Float[Array, "K d"]) -> Linearised:
    guide = guided(problem, problem.model, path)
    return Linearised(path, guide, no_check(1, path.dtype))


@compiled_sooner
def _step(
    key: Key[Array, ""],
    problem: RecordProblem,
    linearisation: Linearised,
    block_length: int,
    num_warmup: Int[Array, ""],
    state: SmoothingState,
) -> tuple[SmoothingState, SmoothingInfo]:
    """Move all blocks of the path, and adapt the sizes of the moves in the warm-up."""
    problem, linearisation, state = nondifferentiable((problem, linearisation, state))
    path, log_scales, number = state
    given = problem, problem.model, linearisation[:2]
    path, accepted = swept_path(key, *given, block_length, log_scales, path)
    adapted = tuned(log_scales, accepted, (number + 1).astype(path.dtype))
    log_scales = jnp.where(number < num_warmup, adapted, log_scales)
    return SmoothingState(path, log_scales, number + 1), SmoothingInfo(accepted[..., 0])
