"""Ready models: the hyperbolic diffusion, Langevin diffusions, and the general recipe.

(The Ornstein–Uhlenbeck process, with its closed forms, is in `gaussian`.)
"""

import dataclasses
import math
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import jax.scipy.special as special
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Key, PyTree

from ..engine.checks import Numbers, as_floating, check_count, is_traced
from ..engine.linalg import cholesky, dot, matvec
from .diffusion import Diffusion, weighted_divergence


def stationary_diffusion(
    log_density: Callable,
    V: Callable | None = None,
    Q: Callable | None = None,
    params: PyTree = None,
    *,
    normalised: bool = False,
) -> Diffusion:
    """Every diffusion with a given stationary density ν and diffusion matrix V:

        α = ½ ν⁻¹ div(ν (V + Q)),    σ = the Cholesky factor of V,

    for a skew-symmetric matrix field Q (Ma, Chen & Fox 2015). Its time reversal has -Q in the
    place of Q, so it is reversible if Q = 0.

    **Arguments:** functions `(x, params)` of one point `x` of shape (d,): `log_density`, log ν
    up to a constant; `V`, positive definite, shape (d, d), or (d,) for a diagonal, by default
    the identity; `Q`, shape (d, d), by default zero. `params`, any pytree, is what they receive;
    `normalised` as in `Diffusion`.

    **Raises:** `TypeError` for arguments that are not functions.

    **Example:**

    ```python
    swirl = jnp.array([[0.0, 1.0], [-1.0, 0.0]])
    model = jb.stationary_diffusion(lambda x, p: -x @ x / 2, Q=lambda x, p: swirl)
    ```
    """
    for name, function in [("log_density", log_density), ("V", V), ("Q", Q)]:
        if not (callable(function) or (function is None and name != "log_density")):
            raise TypeError(f"`{name}` must be a function `(x, params)`; got {function!r}.")
    return Diffusion(
        drift=_RecipeDrift(log_density, V, Q, 1),
        diffusion=None if V is None else _Root(V),
        log_stationary=log_density,
        params=params,
        reverse_drift=None if Q is None else _RecipeDrift(log_density, V, Q, -1),
        reversible=Q is None,
        normalised=normalised,
    )


def langevin(
    log_density: Callable, params: PyTree = None, *, normalised: bool = False
) -> Diffusion:
    """The Langevin diffusion `dX = ½ ∇log ν(X) dt + dW`: reversible, with stationary density ν.

    **Arguments:** `log_density`, `(x, params) -> ()`, is log ν up to a constant; `params`, any
    pytree, is what it receives; `normalised` as in `Diffusion`.

    **Example:**

    ```python
    double_well = jb.langevin(lambda x, p: -p * (x @ x - 1) ** 2, params=1.0)
    ```
    """
    return stationary_diffusion(log_density, params=params, normalised=normalised)


def hyperbolic(alpha: Numbers, dim: int) -> Diffusion:
    """The hyperbolic diffusion `dX = -α X / √(1+|X|²) dt + dW` in R^dim: equation
    (hyperbolicsde). Reversible; its log stationary density is the normalised one of equation
    (hypdensity), and its stationary sampler is exact. `params` is α.

    **Arguments:** `alpha`, α > 0, per unit of time; `dim`, the dimension d.

    **Raises:** `ValueError` for α ≤ 0 or dim < 1.

    **Example:**

    ```python
    model = jb.hyperbolic(0.8, dim=2)
    model.drift(jnp.ones(2))
    ```
    """
    dim = check_count("dim", dim)
    alpha = as_floating("alpha", alpha)
    if alpha.shape != () or not (is_traced(alpha) or 0 < np.asarray(alpha) < np.inf):
        raise ValueError(f"`alpha` must be one positive number; got {alpha}.")
    return Diffusion(
        drift=_hyperbolic_drift,
        log_stationary=_hyperbolic_log_stationary,
        params=alpha,
        sample_stationary=_HyperbolicSampler(dim),
        reversible=True,
        normalised=True,
        prepare=_PrepareHyperbolic(dim),
    )


# The callables below are frozen dataclasses, so that models made twice from the same functions
# are equal and compile once.


@dataclasses.dataclass(frozen=True)
class _RecipeDrift:
    """½ ν⁻¹ div(ν (V ± Q))."""

    log_density: Callable
    V: Callable | None
    Q: Callable | None
    sign: int

    def __call__(self, x: Float[Array, " d"], params: PyTree) -> Float[Array, " d"]:
        def product(y, v):
            image = v if self.V is None else _multiply(self.V(y, params), v)
            if self.Q is not None:
                image += self.sign * _multiply(self.Q(y, params), v)
            return image

        varies = not (self.V is None and self.Q is None)
        return weighted_divergence(product, lambda y: self.log_density(y, params), x, varies) / 2


@dataclasses.dataclass(frozen=True)
class _Root:
    """σ with σσᵀ = V."""

    V: Callable

    def __call__(self, x: Float[Array, " d"], params: PyTree) -> Float[Array, "..."]:
        V = jnp.asarray(self.V(x, params))
        return jnp.sqrt(V) if V.ndim == 1 else cholesky(V)


def _multiply(matrix: Array, vector: Float[Array, " d"]) -> Float[Array, " d"]:
    matrix = jnp.asarray(matrix)
    return matrix * vector if matrix.ndim == 1 else matvec(matrix, vector)


class _Hyperbolic(NamedTuple):
    alpha: Float[Array, ""]
    log_normaliser: Float[Array, ""]


@dataclasses.dataclass(frozen=True)
class _PrepareHyperbolic:
    """The normaliser of equation (hypdensity): `2 K_{(d+1)/2}(2α) (π/α)^{(d-1)/2}`."""

    dim: int

    def __call__(self, alpha: Float[Array, ""]) -> _Hyperbolic:
        log_bessel = _log_bessel_k((self.dim + 1) / 2, 2 * alpha)
        power = (self.dim - 1) / 2 * jnp.log(np.pi / alpha)
        return _Hyperbolic(alpha, np.log(2) + log_bessel + power)


def _hyperbolic_drift(x: Float[Array, " d"], p: _Hyperbolic) -> Float[Array, " d"]:
    return -p.alpha * x / jnp.sqrt(1 + dot(x, x))


def _hyperbolic_log_stationary(x: Float[Array, " d"], p: _Hyperbolic) -> Float[Array, ""]:
    return -2 * p.alpha * jnp.sqrt(1 + dot(x, x)) - p.log_normaliser


@dataclasses.dataclass(frozen=True)
class _HyperbolicSampler:
    """Exact draws from the hyperbolic distribution in R^dim.

    With t = √(1+|x|²) - 1 and β = 2α, the density of t is proportional to

        t^a (t+2)^a (1+t) e^{-βt},    a = dim/2 - 1,

    and the direction is uniform. For even dim this is a mixture of gamma laws. For odd dim,
    (t+2)^{a+½} times `√t + √2 ≥ √(t+2) ≥ (1+t)/√(t+2)` gives such a mixture, from which a draw
    is accepted with probability `(1+t) / (√(t+2) (√t+√2))`, never less than 0.43.
    """

    dim: int

    def __call__(self, key: Key[Array, ""], p: _Hyperbolic) -> Float[Array, " d"]:
        key, direction_key = jax.random.split(key)
        beta = 2 * p.alpha
        dtype = jnp.result_type(beta)
        weights, exponents = self._mixture()  # Σ_j w_j t^{e_j} e^{-βt}
        shapes = jnp.asarray(exponents + 1, dtype)
        log_masses = jnp.asarray(np.log(weights), dtype) + special.gammaln(shapes)
        log_masses -= shapes * jnp.log(beta)

        def propose(key):
            component_key, gamma_key, accept_key = jax.random.split(key, 3)
            component = jax.random.categorical(component_key, log_masses)
            t = jax.random.gamma(gamma_key, shapes[component], dtype=dtype) / beta
            bound = jnp.sqrt(t + 2) * (jnp.sqrt(t) + np.sqrt(2).astype(dtype))
            accepted = jax.random.uniform(accept_key, dtype=dtype) * bound < 1 + t
            return t, accepted

        if self.dim % 2 == 0:
            t, _ = propose(key)
        else:
            # After 100 refusals, of probability below 0.57^100, the next is taken as it is.
            def again(state):
                attempt, (_, accepted) = state
                return ~accepted & (attempt < 100)

            def attempt_next(state):
                attempt, _ = state
                return attempt + 1, propose(jax.random.fold_in(key, attempt + 1))

            _, (t, _) = lax.while_loop(again, attempt_next, (0, propose(key)))
        direction = jax.random.normal(direction_key, (self.dim,), dtype)
        return jnp.sqrt(t * (t + 2)) * direction / jnp.linalg.norm(direction)

    def _mixture(self) -> tuple[np.ndarray, np.ndarray]:
        """Weights and powers of t in `t^a (t+2)^a (1+t)`, or in its bound for odd dim."""
        a = self.dim / 2 - 1
        power = int(np.ceil(a))  # (t+2)^power by the binomial theorem
        j = np.arange(power + 1)
        expansion = np.array([math.comb(power, k) for k in j]) * 2.0 ** (power - j)
        lift, factor = (1.0, 1.0) if self.dim % 2 == 0 else (0.5, np.sqrt(2))
        weights = np.concatenate([factor * expansion, expansion])
        return weights, np.concatenate([a + j, a + lift + j])


def _log_bessel_k(order: float, z: Float[Array, ""]) -> Float[Array, ""]:
    """log K_ν(z), from K_ν(z) = ∫_0^∞ exp(-z cosh t) cosh(νt) dt.

    The integrand is even and analytic and decays doubly exponentially, so the trapezoid rule
    is exact to rounding.
    """
    reach = lax.stop_gradient(jnp.arcsinh((order + 40) / z) + 2)
    t = reach * jnp.linspace(0, 1, 257, dtype=jnp.result_type(z))
    weights = jnp.full(t.shape, t[1]).at[0].mul(0.5)
    log_cosh = jnp.logaddexp(order * t, -order * t) - np.log(2)
    return special.logsumexp(log_cosh - z * jnp.cosh(t), b=weights)
