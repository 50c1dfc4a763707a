"""The hyperbolic diffusion (section 3.2 of the paper), with its exact stationary density and
sampler."""

import dataclasses
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import jax.scipy.special as special
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Key

from ..engine.checks import Numbers, as_floating, check_count, is_traced
from ..engine.entry import public_entry
from ..engine.linalg import dot
from .diffusion import Diffusion, check_dimension


@public_entry
def hyperbolic(alpha: Numbers, dim: int) -> Diffusion:
    """Return the hyperbolic diffusion `dX = -α X / √(1+|X|²) dt + dW` in R^dim: equation
    (hyperbolicsde).

    It is reversible. Its log stationary density is normalised, equation (hypdensity), and its
    stationary sampler is exact. `params` is α.

    **Arguments:** `alpha`, α > 0, per unit of time, shape (); `dim`, the dimension d ≥ 1.

    **Raises:** `ValueError` for α that is not one positive finite number, and for dim < 1;
    `TypeError` for a `dim` that is not an integer.

    **Example:**

    ```python
    model = jb.hyperbolic(0.8, dim=2)
    model.drift(jnp.ones(2))
    ```
    """
    dim = check_count("dim", dim)
    alpha = as_floating("alpha", alpha)
    if alpha.shape != () or not (is_traced(alpha) or 0 < np.asarray(alpha) < np.inf):
        raise ValueError(f"`alpha` must be one positive number, shape (); got {alpha}.")
    return Diffusion(
        drift=_HyperbolicDrift(dim),
        log_stationary=_hyperbolic_log_stationary,
        params=alpha,
        sample_stationary=_HyperbolicSampler(dim),
        reversible=True,
        normalised=True,
        prepare=_PrepareHyperbolic(dim),
    )


class _PreparedHyperbolic(NamedTuple):
    """The parameter, with the logarithm of the normaliser of the stationary density."""

    alpha: Float[Array, ""]
    log_normaliser: Float[Array, ""]


@dataclasses.dataclass(frozen=True)
class _PrepareHyperbolic:
    """Computation of the normaliser of (hypdensity): `2 K_{(d+1)/2}(2α) (π/α)^{(d-1)/2}`."""

    dim: int

    def __call__(self, alpha: Float[Array, ""]) -> _PreparedHyperbolic:
        log_bessel = _log_bessel_k((self.dim + 1) / 2, 2 * alpha)
        power = (self.dim - 1) / 2 * jnp.log(np.pi / alpha)
        return _PreparedHyperbolic(alpha, math.log(2) + log_bessel + power)


@dataclasses.dataclass(frozen=True)
class _HyperbolicDrift:
    """The drift of equation (hyperbolicsde), for points of dimension `dim`."""

    dim: int

    def __call__(self, x: Float[Array, " d"], p: _PreparedHyperbolic) -> Float[Array, " d"]:
        check_dimension(x, self.dim)  # the normaliser holds for this dimension only
        return -p.alpha * x / jnp.sqrt(1 + dot(x, x))


def _hyperbolic_log_stationary(x: Float[Array, " d"], p: _PreparedHyperbolic) -> Float[Array, ""]:
    return -2 * p.alpha * jnp.sqrt(1 + dot(x, x)) - p.log_normaliser


@dataclasses.dataclass(frozen=True)
class _HyperbolicSampler:
    """Exact sampler of the hyperbolic distribution in R^dim.

    Let t = √(1+|x|²) - 1 and β = 2α. The direction of x is uniform, and the density of t is
    proportional to

        t^a (t+2)^a (1+t) e^{-βt},    a = dim/2 - 1.

    - For even dim this is a mixture of gamma laws.
    - For odd dim it becomes one if its upper bound √(t+2) (√t+√2) replaces the factor 1+t.
        Rejection sampling then accepts with probability `(1+t) / (√(t+2) (√t+√2))`, which is at
        least 0.43.
    """

    dim: int

    def __call__(self, key: Key[Array, ""], p: _PreparedHyperbolic) -> Float[Array, " d"]:
        key, direction_key = jax.random.split(key)
        beta = 2 * p.alpha
        dtype = jnp.result_type(beta)
        weights, exponents = self._mixture()  # Σ_j w_j t^{e_j} e^{-βt}
        shapes = jnp.asarray(exponents + 1, dtype)
        # ∫ t^e e^{-βt} dt = Γ(e+1) / β^{e+1}
        log_masses = jnp.asarray(np.log(weights), dtype) + special.gammaln(shapes)
        log_masses -= shapes * jnp.log(beta)

        def propose(key):
            component_key, gamma_key, accept_key = jax.random.split(key, 3)
            component = jax.random.categorical(component_key, log_masses)
            t = jax.random.gamma(gamma_key, shapes[component], dtype=dtype) / beta
            # An upper bound of 1 + t, as √t + √2 ≥ √(t+2) ≥ (1+t)/√(t+2).
            envelope = jnp.sqrt(t + 2) * (jnp.sqrt(t) + np.sqrt(2).astype(dtype))
            accepted = jax.random.uniform(accept_key, dtype=dtype) * envelope < 1 + t
            return t, accepted

        if self.dim % 2 == 0:
            t, _ = propose(key)  # the mixture is exact: no rejection
        else:
            # A bounded loop: it accepts the attempt after 100 rejections, whose probability is
            # below 0.57^100.
            def is_rejected(state):
                attempt, (_, accepted) = state
                return ~accepted & (attempt < 100)

            def attempt_next(state):
                attempt, _ = state
                return attempt + 1, propose(jax.random.fold_in(key, attempt + 1))

            _, (t, _) = lax.while_loop(is_rejected, attempt_next, (0, propose(key)))
        # |x|² = t (t + 2)
        direction = jax.random.normal(direction_key, (self.dim,), dtype)
        return jnp.sqrt(t * (t + 2)) * direction / jnp.linalg.norm(direction)

    def _mixture(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the weights w_j and exponents e_j of Σ_j w_j t^{e_j}.

        The sum is the density of t without its exponential; for odd dim, the upper bound of it.
        """
        a = self.dim / 2 - 1
        power = int(np.ceil(a))  # expand (t+2)^power by the binomial theorem
        j = np.arange(power + 1)
        expansion = np.array([math.comb(power, k) for k in j]) * 2.0 ** (power - j)
        extra_power, factor = (1.0, 1.0) if self.dim % 2 == 0 else (0.5, math.sqrt(2))
        weights = np.concatenate([factor * expansion, expansion])
        return weights, np.concatenate([a + j, a + extra_power + j])


def _log_bessel_k(order: float, z: Float[Array, ""]) -> Float[Array, ""]:
    """Return log K_ν(z) for ν = `order`, from K_ν(z) = ∫_0^∞ exp(-z cosh t) cosh(νt) dt.

    The integrand is even and analytic and decays doubly exponentially. So the trapezoid rule is
    exact up to rounding.
    """
    # Beyond the cutoff the integrand is negligible. The integral does not depend on it.
    cutoff = lax.stop_gradient(jnp.arcsinh((order + 40) / z) + 2)
    t = cutoff * jnp.linspace(0, 1, 257, dtype=jnp.result_type(z))
    # Trapezoid rule: half a weight at zero. The other end contributes nothing.
    weights = jnp.full(t.shape, t[1]).at[0].mul(0.5)
    # In logarithms, because exp(-z cosh t) underflows for large z.
    log_cosh = jnp.logaddexp(order * t, -order * t) - math.log(2)
    return special.logsumexp(log_cosh - z * jnp.cosh(t), b=weights)
