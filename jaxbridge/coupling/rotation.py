"""The rotation O(x, x') of a pair (section 2.1): it aligns σ(x')O with σ(x).

Any O is exact if both directions share it. Let σ = L Q, with L lower triangular and Q orthogonal.
The cheapest choice is O(x, x') = Q(x')ᵀQ(x). It is equivalent to L in place of σ, and no rotation
(`driven_through_root`): L(x) tends to L(x') as x tends to x', and linear systems with L need only
substitution.
"""

import equinox as eqx
from jaxtyping import Array, Float

from ..engine.arguments import as_returned, evaluated
from ..engine.checks import Numbers, as_floating, check_precision
from ..engine.linalg import matmul, matvec, polar_factor
from ..models import decisions
from ..models.dynamics import Dynamics
from ..models.sigma import AbstractSigma, Full, Triangular
from .base import AbstractCoupling


def polar_rotation(sigma: Float[Array, "d d"], driven_sigma: Float[Array, "d d"]):
    """Return O(x, x'), the orthogonal matrix closest to σ(x')ᵀσ(x), so that σ(x')O ≈ σ(x).

    `sigma` is σ(x) and `driven_sigma` is σ(x'), both of shape (d, d). The paper prints the
    transpose, which is `published_rotation`.

    **Raises:** `ValueError` for other shapes, `TypeError` for less than single precision.

    **Example:**

    ```python
    coupling = jb.Coupling(0.5, rotation=jb.polar_rotation)
    ```
    """
    sigma, driven_sigma = _as_matrices(sigma, driven_sigma)
    return polar_factor(matmul(driven_sigma.T, sigma))


def no_rotation(sigma: Float[Array, "d d"], driven_sigma: Float[Array, "d d"]):
    """Return `None`, for O = I.

    It is as exact as any other rotation, but σ(x) and σ(x') are not aligned. `sigma` is σ(x) and
    `driven_sigma` is σ(x'), both of shape (d, d).

    **Example:**

    ```python
    coupling = jb.Coupling(0.5, rotation=jb.no_rotation)
    ```
    """
    return None


def published_rotation(sigma: Float[Array, "d d"], driven_sigma: Float[Array, "d d"]):
    """Return the orthogonal factor of σ(x)ᵀσ(x'), as printed in the paper. For comparisons only.

    It is the transpose of the rotation that aligns σ(x) with σ(x'), so it turns the wrong way.
    `sigma` is σ(x) and `driven_sigma` is σ(x'), both of shape (d, d).

    **Raises:** `ValueError` for other shapes, `TypeError` for less than single precision.

    **Example:**

    ```python
    coupling = jb.Coupling(0.5, rotation=jb.published_rotation)
    ```
    """
    sigma, driven_sigma = _as_matrices(sigma, driven_sigma)
    return polar_factor(matmul(sigma.T, driven_sigma))


def _as_matrices(sigma: Numbers, driven_sigma: Numbers) -> tuple[Array, Array]:
    """Return both arguments as square matrices of the same shape.

    **Raises:** `ValueError` for other shapes, `TypeError` for less than single precision.
    """
    first, second = as_floating("sigma", sigma), as_floating("driven_sigma", driven_sigma)
    if first.ndim != 2 or first.shape[0] != first.shape[1] or second.shape != first.shape:
        raise ValueError(
            "`sigma` and `driven_sigma` must both have shape (d, d); got shapes "
            f"{first.shape} and {second.shape}. Pass two square matrices of the same size."
        )
    # The polar factor needs at least single precision.
    check_precision(
        "`sigma` and `driven_sigma`",
        min(first.dtype, second.dtype, key=lambda dtype: dtype.itemsize),
    )
    return first, second


def rotation_between(
    coupling: AbstractCoupling, sigma: AbstractSigma, driven_sigma: AbstractSigma
) -> Float[Array, "d d"] | None:
    """Return O(x, x'), or `None` if the type of σ needs no rotation."""
    if not rotation_effect(coupling, type(sigma)).simulated:
        return None
    # `rotation_effect` excludes all other types of σ: their directions do not vary.
    assert isinstance(sigma, Full | Triangular) and isinstance(driven_sigma, Full | Triangular)
    rotation = polar_rotation if coupling.rotation is None else coupling.rotation
    matrix = evaluated("rotation", rotation, sigma.matrix, driven_sigma.matrix)
    matrix = as_returned("rotation", matrix)
    if matrix.shape != sigma.matrix.shape:
        raise ValueError(
            f"`rotation` must return a matrix of shape {sigma.matrix.shape}; it returned shape "
            f"{matrix.shape}. Return an orthogonal matrix."
        )
    return matrix.astype(sigma.matrix.dtype)


def rotation_effect(coupling: AbstractCoupling, sigma: type[AbstractSigma]) -> decisions.Effect:
    """Return the effect that states whether the pair needs a rotation."""
    rotation = coupling.rotation
    return decisions.rotation(sigma, rotation is not None, rotation is no_rotation)


def root_effect(coupling: AbstractCoupling, sigma: type[AbstractSigma]) -> decisions.Effect:
    """Decide whether the triangular root of V = σσᵀ drives the pair, and state the reason."""
    rotation_given, stratonovich = coupling.rotation is not None, coupling.scheme.stratonovich
    return decisions.triangular_root(sigma, rotation_given, stratonovich)


def driven_through_root(
    coupling: AbstractCoupling, dynamics: Dynamics, like: Float[Array, " d"]
) -> Dynamics:
    """Return dynamics of the same law, with the triangular root L of V = σσᵀ where that helps.

    With σ = L Q the result is the diffusion that Q W drives through L.
    """
    # Abstract evaluation gives the type of σ without any computation.
    if not root_effect(coupling, type(eqx.filter_eval_shape(dynamics.sigma, like))).simulated:
        return dynamics
    # Only V = σσᵀ determines the law, so any root of V gives the same diffusion.
    return dynamics._replace(sigma=lambda x: dynamics.sigma(x).root())


def rotate(rotation: Float[Array, "d d"] | None, dw: Float[Array, " d"]) -> Float[Array, " d"]:
    """Return O w, with `rotation` for O; `None` is the identity."""
    return dw if rotation is None else matvec(rotation, dw)


def rotate_back(rotation: Float[Array, "d d"] | None, dw: Float[Array, " d"]) -> Float[Array, " d"]:
    """Return Oᵀ w, with `rotation` for O; `None` is the identity."""
    return dw if rotation is None else matvec(rotation.T, dw)
