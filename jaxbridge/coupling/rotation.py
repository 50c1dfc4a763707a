"""The rotation O(x, x') of a pair (section 2.1): it turns the noise of X so that σ(x')O points
where σ(x) does.

Any O that both directions share is exact. With σ = L Q, L lower triangular and Q orthogonal, that
which costs least is O(x, x') = Q(x')ᵀQ(x): then W̃ = Q W drives X through L, which tends to L(x')
where x tends to x', and L solves by substitution (`driven_through_root`).
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
    """O(x, x'), the orthogonal matrix closest to σ(x')ᵀσ(x), so that σ(x')O ≈ σ(x).

    `sigma` is σ(x), `driven_sigma` σ(x'), shape (d, d). The paper prints its transpose,
    `published_rotation`.

    **Example:**

    ```python
    coupling = jb.Coupling(0.5, rotation=jb.polar_rotation)
    ```
    """
    sigma, driven_sigma = _as_matrices(sigma, driven_sigma)
    return polar_factor(matmul(driven_sigma.T, sigma))


def no_rotation(sigma: Float[Array, "d d"], driven_sigma: Float[Array, "d d"]):
    """O = I: as exact as any other rotation, but σ(x) and σ(x') may point elsewhere.

    `sigma` is σ(x), `driven_sigma` σ(x'), shape (d, d).

    **Example:**

    ```python
    coupling = jb.Coupling(0.5, rotation=jb.no_rotation)
    ```
    """
    return None


def published_rotation(sigma: Float[Array, "d d"], driven_sigma: Float[Array, "d d"]):
    """The orthogonal factor of σ(x)ᵀσ(x') as printed in the paper: the transpose of the
    rotation that aligns the two, so it turns the wrong way. For comparisons.

    `sigma` is σ(x), `driven_sigma` σ(x'), shape (d, d).

    **Example:**

    ```python
    coupling = jb.Coupling(0.5, rotation=jb.published_rotation)
    ```
    """
    sigma, driven_sigma = _as_matrices(sigma, driven_sigma)
    return polar_factor(matmul(sigma.T, driven_sigma))


def _as_matrices(sigma: Numbers, driven_sigma: Numbers) -> tuple[Array, Array]:
    """Return both as square matrices of one shape.

    **Raises:** `ValueError` for other shapes.
    """
    first, second = as_floating("sigma", sigma), as_floating("driven_sigma", driven_sigma)
    if first.ndim != 2 or first.shape[0] != first.shape[1] or second.shape != first.shape:
        raise ValueError(
            "`sigma` and `driven_sigma` must have one shape, (d, d); got shapes "
            f"{first.shape} and {second.shape}."
        )
    check_precision(
        "`sigma` and `driven_sigma`",
        min(first.dtype, second.dtype, key=lambda dtype: dtype.itemsize),
    )
    return first, second


def rotation_between(
    coupling: AbstractCoupling, sigma: AbstractSigma, driven_sigma: AbstractSigma
) -> Float[Array, "d d"] | None:
    """O(x, x'), or `None` where σ calls for no rotation."""
    if not rotation_effect(coupling, type(sigma)).simulated:
        return None
    assert isinstance(sigma, Full | Triangular) and isinstance(driven_sigma, Full | Triangular)
    rotation = polar_rotation if coupling.rotation is None else coupling.rotation
    matrix = evaluated("rotation", rotation, sigma.matrix, driven_sigma.matrix)
    matrix = as_returned("rotation", matrix)
    if matrix.shape != sigma.matrix.shape:
        raise ValueError(
            f"`rotation` must return a matrix of shape {sigma.matrix.shape}; it returned shape "
            f"{matrix.shape}."
        )
    return matrix.astype(sigma.matrix.dtype)


def rotation_effect(coupling: AbstractCoupling, sigma: type[AbstractSigma]) -> decisions.Effect:
    """Whether the pair calls for a rotation."""
    rotation = coupling.rotation
    return decisions.rotation(sigma, rotation is not None, rotation is no_rotation)


def root_effect(coupling: AbstractCoupling, sigma: type[AbstractSigma]) -> decisions.Effect:
    """Whether the pair is driven through the triangular root of V."""
    rotation_given, stratonovich = coupling.rotation is not None, coupling.scheme.stratonovich
    return decisions.triangular_root(sigma, rotation_given, stratonovich)


def driven_through_root(
    coupling: AbstractCoupling, dynamics: Dynamics, like: Float[Array, " d"]
) -> Dynamics:
    """The same diffusion as the pair sees it: with σ = L Q driven by Q W through L, where that is
    called for."""
    if not root_effect(coupling, type(eqx.filter_eval_shape(dynamics.sigma, like))).simulated:
        return dynamics
    return dynamics._replace(sigma=lambda x: dynamics.sigma(x).root())


def rotate(rotation: Float[Array, "d d"] | None, dw: Float[Array, " d"]) -> Float[Array, " d"]:
    """O w."""
    return dw if rotation is None else matvec(rotation, dw)


def rotate_back(rotation: Float[Array, "d d"] | None, dw: Float[Array, " d"]) -> Float[Array, " d"]:
    """Oᵀ w."""
    return dw if rotation is None else matvec(rotation.T, dw)
