"""Log-likelihood of a path, observed at times t_0 < ... < t_K (section 4 of the paper, any model).

If σ does not depend on the parameters, the likelihood is a density relative to the law of σW. By
Girsanov's theorem its logarithm is

    ∫ αᵀ V⁻¹ dX - ½ ∫ αᵀ V⁻¹ α dt.

Four forms have this limit as δ → 0; a fifth one is the Euler density itself.

* "girsanov": sums with the coefficients at the left points. It is the Euler density without the
  terms that do not depend on the drift. For any σ(x); the error is O(δ).
* "trapezoid": trapezoid rule in Stratonovich form,

      Σ ½ (β + β') · Δw - ¼ (|β|² + |β'|²) δ - ½ div β' δ,    β = σ⁻¹α,

  for constant σ and a drift without curl: in one dimension, or for models declared reversible. The
  divergence is at the end of each step, which corrects the bias of the first term. The error is
  O(δ²). If β is linear in parameters, the form is quadratic and concave in them.
* "ito_taylor": `ItoTaylorDensity` step by step, for constant σ. The error is O(δ²).
* "ito": for constant V and a gradient drift V⁻¹α = ∇A, that is for reversible models, where
  A = ½ log ν. By Itô's formula the logarithm contains no stochastic integral:

      A(X_T) - A(X_0) - ½ ∫ [tr(V ∇²A) + ∇AᵀV ∇A] dt,

  in which tr(V ∇²A) = div α. The trapezoid rule gives the integral with an error of O(δ²). For the
  hyperbolic diffusion this form is α H_T - ½ α² B_T, equation (likelihood).
* "euler": Σ log N(x_{i+1}; x_i + α(x_i) δ_i, V(x_i) δ_i), a density of the points of the path. It
  is the only form in which σ may depend on parameters.

The orders hold for means over paths. For a single path the error of "girsanov" is O(√δ). So is that
of "ito_taylor" if the drift has a curl, because then the points of a path do not determine the
integral; without a curl it is O(δ).
"""

import math
from collections.abc import Iterable
from typing import Literal, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from ..engine.arguments import check_choice
from ..engine.checks import Numbers, as_floating, check_precision, is_traced
from ..engine.compiled import compiled
from ..engine.entry import public_entry
from ..engine.lanes import over_lanes
from ..engine.linalg import dot, sum_first_axis
from ..engine.times import as_times, check_increasing
from ..models.diffusion import Diffusion, check_diffusion
from ..models.dynamics import Dynamics
from .step_density import AbstractStepDensity, EulerDensity, ItoTaylorDensity

Form = Literal["girsanov", "trapezoid", "ito_taylor", "ito", "euler"]


@public_entry
def path_log_likelihood(
    model: Diffusion, times: Numbers, path: Numbers, *, form: Form | None = None
) -> Float[Array, "*batch"]:
    """Return the log-likelihood of paths, differentiable in the parameters of the drift.

    With `form="euler"` it is also differentiable in the parameters of σ.

    **Arguments:**

    - `model`: the diffusion.
    - `times`: increasing, shape (K,). For I intervals with separate times, shape (I, K).
    - `path`: points at these times, shape (..., K, d), or (I, ..., K, d) with times of shape
        (I, K). The paths of bridges of one or several intervals have these shapes.
    - `form`: "girsanov", "trapezoid", "ito_taylor", "ito" or "euler". The default is the most
        accurate form for the model. It is "girsanov" for a state-dependent σ. For constant σ it is
        "ito" for a reversible model with a stationary density, "trapezoid" for other reversible or
        one-dimensional models, and "ito_taylor" otherwise.

    **Returns:** log-likelihoods, shape `path.shape[:-2]`, in the dtype of `path`. They are logs of
    densities, relative to the law of σW, or to Lebesgue measure for "euler".

    **Raises:** `ValueError` for shapes that do not fit, times that do not increase, coefficients
    that depend on time, a σ with fewer columns than rows, or a form that is invalid for the model.
    `TypeError` for arguments of other types, for half precision, and for a derivative in parameters
    of σ, except with "euler".

    **Example:**

    ```python
    def log_likelihood(params):
        return jb.path_log_likelihood(model.with_params(params), bridges.times, bridges.paths)

    jax.jacfwd(log_likelihood)(model.params).B  # the score of each path, shape (100, 2, 2)
    ```
    """
    check_diffusion(model)
    if form is not None:
        check_choice("form", form, get_args(Form))
    _, steps, path = as_grid_and_paths(times, path)
    return log_likelihood_of_steps(model, steps, path, form)


def as_grid_and_paths(
    times: Numbers, path: Numbers
) -> tuple[Float[Array, "*I K"], Float[Array, "*I steps"], Float[Array, "*batch K d"]]:
    """Validate times and paths at these times; return times, their differences, and paths."""
    grid, path = as_times("times", times), as_floating("path", path)
    times, steps = grid
    if path.ndim < 2 or path.shape[-2] < 2:
        raise ValueError(
            "`path` must have shape (..., K, d) with at least two points, K >= 2; got shape "
            f"{path.shape}."
        )
    check_precision("`path`", path.dtype)
    num_times = path.shape[-2]
    fits = times.shape == (num_times,) or (
        path.ndim > 2 and times.shape == (path.shape[0], num_times)
    )
    if not fits:
        raise ValueError(
            f"`times` must have shape ({num_times},), the number of points of the path, or (I, "
            f"{num_times}) for paths of shape (I, ..., {num_times}, d); got {times.shape} for "
            f"paths of shape {path.shape}."
        )
    if times.ndim == 1:
        check_increasing(grid)
    elif not is_traced(steps) and not np.all(np.asarray(steps) > 0):
        raise ValueError(
            "`times` must be finite and increase strictly in each interval; got steps between "
            f"{np.min(steps)} and {np.max(steps)}. Sort them and remove duplicates."
        )
    return jnp.asarray(times, path.dtype), steps.astype(path.dtype), path


def for_each_path(grid: Float[Array, "*I n"], batch: tuple[int, ...]) -> Float[Array, "P n"]:
    """Repeat numbers of one grid, or of one grid per interval, for each path of a batch."""
    n = grid.shape[-1]
    if grid.ndim == 2:
        grid = grid.reshape(len(grid), *[1] * (len(batch) - 1), n)
    return jnp.broadcast_to(grid, (*batch, n)).reshape(-1, n)


def log_likelihood_of_steps(
    model: Diffusion,
    steps: Float[Array, "*I K"],
    path: Float[Array, "*batch points d"],
    form: Form | None,
) -> Float[Array, "*batch"]:
    """Return `path_log_likelihood` for given step sizes, of one grid or one grid per interval."""
    batch, (num_points, d) = path.shape[:-2], path.shape[-2:]
    steps = for_each_path(steps, batch)
    paths = path.reshape(-1, num_points, d)
    if form != "euler":
        known_sigma(model.diffusion(paths[0, 0]))
    return _compiled(model, steps.T, paths, form).reshape(batch)


@eqx.filter_custom_jvp
def known_sigma(sigma: Array) -> Array:
    """Return σ unchanged, and raise `TypeError` if a derivative in it is taken."""
    return sigma


@known_sigma.def_jvp
def _refuse(primals, tangents):
    raise TypeError(
        "σ depends on parameters in which a derivative is taken, but a path has no density "
        "relative to the law of σW that depends on σ: differentiate in the parameters of the drift "
        'only, or pass `form="euler"` for the Euler density of the points of the path.'
    )


def log_likelihoods(
    model: Diffusion,
    steps: Float[Array, "K P"],
    paths: Float[Array, "P points d"],
    form: Form | None,
) -> Float[Array, " P"]:
    """Return the log-likelihoods of P paths, with the step sizes in the columns of `steps`."""
    like = paths[0, 0]
    model = model.prepared()
    model.check_invertible_sigma(like)
    dynamics, form = model.forward(like), _form(model, like, form)
    # (d, K+1, P), written out: loops over lanes that are not adjacent would not vectorise.
    points = lax.optimization_barrier(jnp.moveaxis(paths, (0, 1), (-1, -2)))
    if form == "ito":
        return _ito(model, dynamics, steps, points)
    d, num_points, num_paths = points.shape
    lanes = points.reshape(d, -1)

    # Columns of `lanes` are ordered by point, then by path; so are those of the steps.
    def of_steps(leaf, shift):
        leaf = leaf.reshape(*leaf.shape[:-1], num_points, num_paths)
        leaf = lax.slice_in_dim(leaf, shift, num_points - 1 + shift, axis=-2)
        return leaf.reshape(*leaf.shape[:-2], -1)

    def of_step(x, x_next, dt):
        if form in ("ito_taylor", "trapezoid"):
            step = _ito_taylor if form == "ito_taylor" else _trapezoid
            return step(dynamics, x, x_next, dt)
        value = _girsanov(dynamics, x, x_next, dt)
        return value + _driftless(dynamics, x, x_next, dt) if form == "euler" else value

    ends = (of_steps(lanes, shift) for shift in (0, 1))
    values = over_lanes(-1, -1, -1)(of_step)(*ends, steps.reshape(-1))
    return jnp.sum(values.reshape(num_points - 1, num_paths), axis=0)


_compiled = compiled(log_likelihoods)


def _ito(model: Diffusion, dynamics: Dynamics, steps, points) -> Float[Array, " P"]:
    """Return the form "ito", with A = ½ log ν."""

    def integrand(x):
        """Return ½ [div α + αᵀ V⁻¹ α]."""
        # One linearisation serves all directions of the divergence.
        alpha, slope = jax.linearize(dynamics.drift, x)
        directions = [jnp.asarray(direction, x.dtype) for direction in np.eye(x.shape[0])]
        divergence = sum_first_axis(jnp.stack([slope(e)[i] for i, e in enumerate(directions)]))
        beta = dynamics.sigma(x).root().solve(alpha)
        return (divergence + dot(beta, beta)) / 2

    values = over_lanes(-1)(integrand)(points.reshape(points.shape[0], -1))
    values = values.reshape(points.shape[1:])
    integral = jnp.sum((values[1:] + values[:-1]) / 2 * steps, axis=0)
    log_nu = over_lanes(-1)(model.log_stationary)
    return (log_nu(points[:, -1]) - log_nu(points[:, 0])) / 2 - integral


def _girsanov(dynamics: Dynamics, x, x_next, dt) -> Float[Array, ""]:
    """Return αᵀ V⁻¹ Δx - ½ αᵀ V⁻¹ α δ."""
    sigma = dynamics.sigma(x).root()
    beta = sigma.solve(dynamics.drift(x))
    return dot(beta, sigma.solve(x_next - x) - dt / 2 * beta)


def _trapezoid(dynamics: Dynamics, x, x_next, dt) -> Float[Array, ""]:
    """Return ½ (β + β') · Δw - ¼ (|β|² + |β'|²) δ - ½ div β' δ."""
    sigma = dynamics.sigma(x)
    before, (after, slope) = dynamics.drift(x), jax.linearize(dynamics.drift, x_next)
    before, after, dw = (sigma.solve(vector) for vector in (before, after, x_next - x))
    units = [jnp.asarray(unit, x.dtype) for unit in np.eye(x.shape[0])]
    # For constant σ, div β in noise coordinates equals div α.
    divergence = sum_first_axis(jnp.stack([slope(unit)[i] for i, unit in enumerate(units)]))
    squares = dot(before, before) + dot(after, after)
    return dot(before + after, dw) / 2 - dt / 4 * squares - dt / 2 * divergence


def _ito_taylor(dynamics: Dynamics, x, x_next, dt) -> Float[Array, ""]:
    """Return the log density of the Itô–Taylor step relative to N(x'; x, V δ)."""
    law = ItoTaylorDensity().steps_from(dynamics, x).law(dt)
    dw = dynamics.sigma(x).solve(x_next - x)
    driftless = (x.shape[0] - dot(dw, dw) / dt) / 2  # `log_relative` of N(x, V δ)
    return law.log_relative(x_next) - driftless


def _driftless(dynamics: Dynamics, x, x_next, dt) -> Float[Array, ""]:
    """Return log N(x'; x, V(x) δ)."""
    sigma, d = dynamics.sigma(x).root(), x.shape[0]
    dw = sigma.solve(x_next - x)
    return -dot(dw, dw) / (2 * dt) - sigma.log_abs_det() - d / 2 * jnp.log(2 * math.pi * dt)


def forms_of(model: Diffusion, like: Float[Array, " d"]) -> tuple[Form, ...]:
    """Return the valid forms relative to the law of σW, the most accurate one first."""
    if model.sigma_varies(like):
        return ("girsanov",)
    forms: tuple[Form, ...] = ("ito_taylor", "girsanov")
    if model.reversible or like.shape[0] == 1:
        forms = ("trapezoid", *forms)
    return ("ito", *forms) if model.reversible and model.has_density else forms


def density_of_form(form: Form) -> AbstractStepDensity:
    """Return the step density that equals the form, or is nearest to it."""
    return EulerDensity() if form in ("girsanov", "euler") else ItoTaylorDensity()


def forms_of_targets(
    targets: Iterable[AbstractStepDensity | None], model: Diffusion, like: Float[Array, " d"]
) -> tuple[Form, ...]:
    """Return the forms for bridges with these targets, the most accurate one first.

    A target is `None` for the diffusion itself. Bridges of the Euler chain need the likelihood of
    that chain. With another one, paths and parameters would have no common law. Quadratic steps
    have no likelihood of paths; there the result is that of first order, "girsanov".
    """
    if any(target is not None and target.order == 1 for target in targets):
        return ("girsanov",)
    forms = forms_of(model, like)
    # "girsanov" is last; it is of lower order than the targets, so it is omitted.
    return forms if forms == ("girsanov",) else forms[:-1]


def _form(model: Diffusion, like: Float[Array, " d"], form: Form | None) -> Form:
    """Return the form, by default the most accurate one; raise if the model does not have it."""
    forms = forms_of(model, like)
    if form is None:
        return forms[0]
    if form in (*forms, "euler"):
        return form
    if form == "trapezoid" and "ito_taylor" in forms:
        raise ValueError(
            '`form="trapezoid"` needs a one-dimensional model, or one with `reversible=True`: pass '
            'form="ito_taylor".'
        )
    if "ito_taylor" not in forms:
        raise ValueError(f'`form="{form}"` needs constant σ: pass form="girsanov" or form="euler".')
    raise ValueError(
        '`form="ito"` needs a gradient drift, that is a model with `reversible=True` and a '
        '`log_stationary`: pass form="ito_taylor".'
    )
