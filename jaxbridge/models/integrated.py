"""A diffusion together with its integral over time: a model for observed positions or averages."""

import dataclasses
import functools

import jax.numpy as jnp
from jaxtyping import Array, Float

from ..engine.entry import disable_guards
from .diffusion import Diffusion, check_diffusion, halves


@disable_guards
def integrated(model: Diffusion) -> Diffusion:
    """Return the model of a diffusion X and its integral Z: the state is (Z, X), shape (2d,), with

        dZ = X dt,    dX = α(X) dt + σ(X) dW.

    Use it for two kinds of records:

    - Positions Z, where X is the velocity (for animals Johnson, London, Lea & Durban 2008).
    - Averages of X over intervals, which are differences of Z divided by the length of the
        interval.

    The model is hypoelliptic: noise enters X only. Bridges and transition densities do not apply;
    use `simulate`, or records with an `observation`. Z has no stationary law, so records need
    `initial=`. `params` belong to `model`.

    **Arguments:** `model`, the model of X. If its σ is a constant array, that must not be traced.

    **Raises:** `TypeError` unless `model` is a `Diffusion`, `ValueError` for a traced constant σ.

    **Example:**

    ```python
    velocity = jb.ornstein_uhlenbeck([[1.0]])
    position = jb.LinearGaussian([[1.0, 0.0]], covariance=0.01)
    start = jb.GaussianLaw([0.0, 0.0], [[0.0, 0.0], [0.0, 0.5]])
    jb.integrated(velocity).drift(jnp.array([3.0, 1.0]))  # Array([ 1., -1.], dtype=float32)
    ```
    """
    check_diffusion(model)
    functions = _cached_functions(model.unbound())
    takes_time = model.depends_on_time
    return Diffusion(
        functions.drift_at if takes_time else functions.drift,
        functions.diffusion_at if takes_time else functions.diffusion,
        params=model.params,
        domain=functions.domain if model.state_space() is not None else None,
        prepare=model.preparation,
    )


@dataclasses.dataclass(frozen=True)
class _IntegratedFunctions:
    """Functions of the state (Z, X) and the parameters, built from the model of X."""

    unbound: Diffusion

    def drift(self, x, params):
        return self.drift_at(x, params, None)

    def diffusion(self, x, params):
        return self.diffusion_at(x, params, None)

    def drift_at(self, x, params, time):
        _, velocity = _halves(x)
        drift = self.unbound.with_params(params).drift(velocity, time)
        return jnp.concatenate([velocity, drift])

    def diffusion_at(self, x, params, time):
        _, velocity = _halves(x)
        sigma = self.unbound.with_params(params).diffusion(velocity, time)
        return jnp.concatenate([jnp.zeros_like(sigma), sigma])

    def domain(self, x, params):
        inside = self.unbound.with_params(params).state_space()
        assert inside is not None  # `integrated` uses this function only for a model with a domain
        return inside(_halves(x)[1])  # Z is unrestricted


# Equal models share one object, so that its functions compile once.
_cached_functions = functools.lru_cache(maxsize=256)(_IntegratedFunctions)


def _halves(x: Float[Array, " d"]) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
    """Return Z and X."""
    return halves(x, "n integrals and n values, an even number of coordinates")
