"""Unconditional paths of a diffusion, from the solvers of diffrax."""

from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Key

from ..engine.arguments import check_instance, shown
from ..engine.checks import Numbers, as_floating, check_count, check_key, check_num_steps
from ..engine.compiled import compiled
from ..engine.entry import public_entry
from ..engine.times import as_times, check_increasing, check_resolved
from .diffusion import Diffusion, check_diffusion
from .dynamics import Dynamics, ito_correction
from .jumps import Jumps
from .sigma import AbstractSigma, Diagonal


@public_entry
def simulate(
    key: Key[Array, ""],
    model: Diffusion,
    x0: Numbers | None,
    times: Numbers,
    *,
    num_paths: int = 1,
    num_steps: int = 50,
    solver: diffrax.AbstractSolver | None = None,
    jumps: Jumps | None = None,
) -> Float[Array, "num_paths K d"]:
    """Simulate unconditional paths from `times[0]` on.

    **Arguments:**

    - `key`: a typed key.
    - `model`: the diffusion. It needs neither a time reversal nor a stationary law.
    - `x0`: the start, shape (d,), or one start per path, (num_paths, d). `None` samples the starts
        from the stationary law, with the model's sampler.
    - `times`: increasing, shape (K,) with K ≥ 2, in units of time. Their origin is arbitrary,
        because differences are computed in double precision. Coefficients that depend on time
        receive these times.
    - `num_paths`: the number of paths.
    - `num_steps`: the number of solver steps between two successive times.
    - `solver`: a diffrax solver that takes fixed steps; by default `diffrax.Heun()`. A Stratonovich
        solver receives the Stratonovich drift. A solver that needs a Lévy area receives it.
    - `jumps`: known jumps of the state, such as doses. A path has the state before a jump at its
        time. A jump between two times splits the interval, and each part has `num_steps` steps.

    **Returns:** paths, shape (num_paths, K, d), differentiable in forward mode. A path that
    explodes is NaN or infinite from there on.

    **Raises:** `ValueError` for shapes that do not fit, for times that do not increase, and without
    `x0` for a model without sampler. If coefficients depend on time, `ValueError` also for times so
    far from zero that single precision cannot resolve a step. Traced times are not checked.
    `TypeError` for a solver that is not for all stochastic differential equations.

    **Example:**

    ```python
    paths = jb.simulate(key, model, start, jnp.linspace(0, 10, 101), num_paths=8)
    paths.shape  # (8, 101, 2)
    ```
    """
    check_key(key)
    check_diffusion(model)
    num_paths = check_count("num_paths", num_paths)
    time_axis = as_times("times", times)
    if len(time_axis.shape) != 1 or time_axis.shape[0] < 2:
        raise ValueError(f"`times` must have shape (K,) with K ≥ 2; got {time_axis.shape}.")
    check_increasing(time_axis)
    jump = jump_map = which = None
    if jumps is not None:
        check_instance("jumps", jumps, Jumps, "a `Jumps`")
        time_axis, is_asked, jump = jumps.split(time_axis)
        jump_map, which = jumps.map, np.flatnonzero(is_asked)
    num_steps = check_num_steps(num_steps, time_axis.shape[0] - 1)
    start_key, path_key = jax.random.split(key)
    if x0 is None:
        x0 = jax.vmap(model.prepared().sample_stationary)(jax.random.split(start_key, num_paths))
    x0 = as_floating("x0", x0)
    if x0.shape[:-1] not in ((), (num_paths,)) or x0.ndim == 0:
        raise ValueError(
            f"`x0` must have shape (d,) or ({num_paths}, d), one per path; got {x0.shape}."
        )
    x0 = jnp.broadcast_to(x0, (num_paths, x0.shape[-1]))
    solver = diffrax.Heun() if solver is None else solver
    _check_solver(solver)
    clock, elapsed = time_axis.clock(x0.dtype)
    gaps = time_axis.gaps.astype(x0.dtype)
    if model.depends_on_time:
        check_resolved(clock, elapsed, gaps / num_steps)
    if jumps is not None:
        jumps.map.check(x0[0], jumps.inputs[0], model.params)
    intervals = elapsed[:-1], gaps, jump
    paths = _simulate(path_key, model, x0, clock, intervals, jump_map, num_steps, solver)
    return paths if which is None else paths[:, which]


def _check_solver(solver: Any) -> None:
    """Raise `TypeError` unless the solver is for all stochastic differential equations."""
    check_instance("solver", solver, diffrax.AbstractSolver, "a solver of diffrax, an instance")
    general = diffrax.AbstractItoSolver | diffrax.AbstractStratonovichSolver
    # These have the interface, but assume the structure of a Langevin equation.
    langevin_only = diffrax.ALIGN | diffrax.QUICSORT | diffrax.ShOULD
    if not isinstance(solver, general) or isinstance(solver, langevin_only):
        raise TypeError(
            "`solver` must be a solver of diffrax for any stochastic differential equation, an "
            "`AbstractItoSolver` or `AbstractStratonovichSolver` that is not only for Langevin "
            "equations, such as `diffrax.Heun()`, `diffrax.Euler()` or `diffrax.SRA1()`; got "
            f"{shown(solver)}."
        )


@compiled
def _simulate(key, model, x0, clock, intervals, jump_map, num_steps, solver):
    """Return the paths, from one solution per interval.

    Each interval has its own clock, which starts at zero. The noise is a function of the times of
    the steps, which must be distinct in floating point, and scales with their differences.
    """
    dynamics_at, (starts, gaps, jumps) = model.forward_at(x0[0]), intervals
    fractions = np.arange(1 + num_steps) / num_steps
    stratonovich = isinstance(solver, diffrax.AbstractStratonovichSolver)

    # `t` is the time since `start`, the beginning of the interval.
    def drift(t, x, start):
        dynamics = dynamics_at(clock(start + t))
        if stratonovich and dynamics.sigma_varies:
            return dynamics.drift(x) - ito_correction(dynamics, x)
        return dynamics.drift(x)

    def sigma(t, x, start):
        return _as_operator(dynamics_at(clock(start + t)), x)

    noise_dim = jax.eval_shape(sigma, starts[0], x0[0], starts[0]).in_size()
    shape = jax.ShapeDtypeStruct((noise_dim,), x0.dtype)

    def solve_interval(x, interval):
        key, (start, gap, jump) = interval
        if jump is not None:
            x = jump_map(x, jump, model.params)
        # Unsafe only for steps that are rejected and repeated; here steps are fixed.
        noise = diffrax.UnsafeBrownianPath(shape, key, _levy_area(solver))
        solution = diffrax.diffeqsolve(
            diffrax.MultiTerm(diffrax.ODETerm(drift), diffrax.ControlTerm(sigma, noise)),
            solver,
            jnp.zeros_like(gap),
            gap,
            None,
            x,
            start,
            saveat=diffrax.SaveAt(t1=True),
            stepsize_controller=diffrax.StepTo(ts=jnp.asarray(fractions, gap.dtype) * gap),
            adjoint=diffrax.ForwardMode(),
            max_steps=num_steps,
            throw=False,  # paths that explode are returned
        )
        x = jnp.asarray(solution.ys)[0]
        return x, x

    def one_path(key, x0):
        keys = jax.random.split(key, len(gaps))
        _, path = lax.scan(solve_interval, x0, (keys, (starts, gaps, jumps)))
        return jnp.concatenate([x0[None], path])

    return jax.vmap(one_path)(jax.random.split(key, len(x0)), x0)


def _levy_area(solver: diffrax.AbstractSolver):
    """Return the smallest class of increments with the Lévy area that the solver needs."""
    required_area = getattr(solver, "minimal_levy_area", diffrax.AbstractBrownianIncrement)
    # From the least information about the noise to the most.
    candidates = (
        diffrax.BrownianIncrement,
        diffrax.SpaceTimeLevyArea,
        diffrax.SpaceTimeTimeLevyArea,
    )
    return next(candidate for candidate in candidates if issubclass(candidate, required_area))


def _as_operator(dynamics: Dynamics, x: Float[Array, " d"]) -> lx.AbstractLinearOperator:
    """Return σ(x) as an operator of lineax, as diffrax needs it."""
    sigma: AbstractSigma = dynamics.sigma(x)
    if isinstance(sigma, Diagonal):
        return lx.DiagonalLinearOperator(sigma.diagonal)
    matrix = sigma.as_matrix(x.shape[0], x.dtype)
    return lx.MatrixLinearOperator(matrix)
