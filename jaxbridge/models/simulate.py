"""Unconditional paths of the diffusion, by diffrax."""

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
from ..engine.doors import door
from ..engine.times import as_times, check_increasing, check_resolved
from .diffusion import Diffusion, check_diffusion
from .dynamics import Dynamics, ito_correction
from .sigma import AbstractSigma, Diagonal


@door
def simulate(
    key: Key[Array, ""],
    model: Diffusion,
    x0: Numbers | None,
    times: Numbers,
    *,
    num_paths: int = 1,
    num_steps: int = 50,
    solver: diffrax.AbstractSolver | None = None,
) -> Float[Array, "num_paths K d"]:
    """Unconditional paths, started at `times[0]`.

    **Arguments:**

    - `key`: a typed key.
    - `model`: the diffusion. Neither its reversal nor its stationary law is called for.
    - `x0`: the start, shape (d,), or one for each path, (num_paths, d), or `None` to draw from
        the stationary law by the model's sampler.
    - `times`: increasing, shape (K,), in units of time. Their zero does not matter: differences
        are taken in double precision. Coefficients that depend on time get these times; where
        single precision cannot resolve them beside a step, that is refused, but not of traced ones.
    - `num_paths`: how many paths.
    - `num_steps`: solver steps between one time and the next.
    - `solver`: a diffrax solver that takes fixed steps; by default `diffrax.Heun()`. A solver
        for Stratonovich equations is given the drift in that form, and one that asks for a
        Lévy area gets it.

    **Returns:** paths, shape (num_paths, K, d). A path that left the finite numbers is NaN or
    infinite from there on. Differentiable in forward mode.

    **Raises:** `ValueError` for shapes that do not fit or times that do not increase.

    **Example:**

    ```python
    paths = jb.simulate(key, model, start, jnp.linspace(0, 10, 101), num_paths=8)
    paths.shape  # (8, 101, 2)
    ```
    """
    check_key(key)
    check_diffusion(model)
    num_paths = check_count("num_paths", num_paths)
    known = as_times("times", times)
    if len(known.shape) != 1 or known.shape[0] < 2:
        raise ValueError(f"`times` must have shape (K,) with K ≥ 2; got {known.shape}.")
    check_increasing(known)
    num_steps = check_num_steps(num_steps, known.shape[0] - 1)
    start_key, path_key = jax.random.split(key)
    if x0 is None:
        x0 = jax.vmap(model.prepared().sample_stationary)(jax.random.split(start_key, num_paths))
    x0 = as_floating("x0", x0)
    if x0.shape[:-1] not in ((), (num_paths,)) or x0.ndim == 0:
        raise ValueError(
            f"`x0` must have shape (d,) or ({num_paths}, d), one for each path; got {x0.shape}."
        )
    x0 = jnp.broadcast_to(x0, (num_paths, x0.shape[-1]))
    solver = diffrax.Heun() if solver is None else solver
    _check_solver(solver)
    clock, since = known.clock(x0.dtype)
    gaps = known.gaps.astype(x0.dtype)
    if model.depends_on_time:
        check_resolved(clock, since, gaps / num_steps)
    return _simulate(path_key, model, x0, clock, since[:-1], gaps, num_steps, solver)


def _check_solver(solver: Any) -> None:
    """Raise `TypeError` for anything but a solver of stochastic differential equations."""
    check_instance("solver", solver, diffrax.AbstractSolver, "a solver of diffrax, an instance")
    of_any = diffrax.AbstractItoSolver | diffrax.AbstractStratonovichSolver
    of_langevin = diffrax.ALIGN | diffrax.QUICSORT | diffrax.ShOULD
    if not isinstance(solver, of_any) or isinstance(solver, of_langevin):
        raise TypeError(
            "`solver` must be a solver of diffrax for any stochastic differential equation, such "
            "as `diffrax.Heun()`, `diffrax.Euler()` or `diffrax.SRA1()`: an "
            "`AbstractItoSolver` or an `AbstractStratonovichSolver`, not of Langevin's equation "
            f"only; got {shown(solver)}."
        )


@compiled
def _simulate(key, model, x0, clock, starts, gaps, num_steps, solver):
    """Paths by one solution for each interval, on a clock of its own that begins with zero: noise
    is drawn by the times of steps, which must be distinct, and is scaled by their differences."""
    dynamics_at = model.forward_at(x0[0])
    fractions = np.arange(1 + num_steps) / num_steps
    stratonovich = isinstance(solver, diffrax.AbstractStratonovichSolver)

    def drift(t, x, start):
        dynamics = dynamics_at(clock(start + t))
        if stratonovich and dynamics.sigma_varies:
            return dynamics.drift(x) - ito_correction(dynamics, x)
        return dynamics.drift(x)

    def sigma(t, x, start):
        return _as_operator(dynamics_at(clock(start + t)), x)

    num_noises = jax.eval_shape(sigma, starts[0], x0[0], starts[0]).in_size()
    shape = jax.ShapeDtypeStruct((num_noises,), x0.dtype)

    def over_interval(x, interval):
        key, start, gap = interval
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
            throw=False,
        )
        x = jnp.asarray(solution.ys)[0]
        return x, x

    def one_path(key, x0):
        keys = jax.random.split(key, len(gaps))
        _, path = lax.scan(over_interval, x0, (keys, starts, gaps))
        return jnp.concatenate([x0[None], path])

    return jax.vmap(one_path)(jax.random.split(key, len(x0)), x0)


def _levy_area(solver: diffrax.AbstractSolver):
    """The least that the solver must know of the Brownian path."""
    least = getattr(solver, "minimal_levy_area", diffrax.AbstractBrownianIncrement)
    candidates = (
        diffrax.BrownianIncrement,
        diffrax.SpaceTimeLevyArea,
        diffrax.SpaceTimeTimeLevyArea,
    )
    return next(candidate for candidate in candidates if issubclass(candidate, least))


def _as_operator(dynamics: Dynamics, x: Float[Array, " d"]) -> lx.AbstractLinearOperator:
    sigma: AbstractSigma = dynamics.sigma(x)
    if isinstance(sigma, Diagonal):
        return lx.DiagonalLinearOperator(sigma.diagonal)
    matrix = sigma.as_matrix(x.shape[0], x.dtype)
    return lx.MatrixLinearOperator(matrix)
