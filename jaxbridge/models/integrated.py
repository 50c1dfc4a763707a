"""A diffusion together with its integral over time."""

import dataclasses
import functools

import jax.numpy as jnp
from jaxtyping import Array, Float

from ..engine.doors import guards_off
from .diffusion import Diffusion, check_diffusion, halves


@guards_off
def integrated(model: Diffusion) -> Diffusion:
    """The diffusion X of a model together with its integral: the state is (Z, X), shape (2d,),

        dZ = X dt,    dX = α(X) dt + σ(X) dW.

    So a record of positions is one of Z, of which X is the velocity (for animals Johnson, London,
    Lea & Durban 2008); and one of means over intervals is of differences of Z. Noise reaches Z by
    way of X only: couplings do not apply, records with an `observation` do. `params` are those of
    the model. There is no stationary law, for Z has none: give `initial=`.

    **Arguments:** `model`, that of X. A constant σ that it was given as an array must be known.

    **Raises:** `TypeError` for what is no model.

    **Example:**

    ```python
    velocity = jb.ornstein_uhlenbeck([[1.0]])
    position = jb.LinearGaussian([[1.0, 0.0]], covariance=0.01)
    start = jb.GaussianLaw([0.0, 0.0], [[0.0, 0.0], [0.0, 0.5]])
    jb.integrated(velocity).drift(jnp.array([3.0, 1.0]))  # Array([ 1., -1.], dtype=float32)
    ```
    """
    check_diffusion(model)
    functions = _functions(model.unbound())
    timed = model.depends_on_time
    return Diffusion(
        functions.drift_at if timed else functions.drift,
        functions.diffusion_at if timed else functions.diffusion,
        params=model.params,
        domain=functions.domain if model.state_space() is not None else None,
        prepare=model.preparation,
    )


@dataclasses.dataclass(frozen=True)
class _Integrated:
    """The functions of (Z, X) and the parameters."""

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
        assert inside is not None  # only then is it asked
        return inside(_halves(x)[1])


# The same object for the same model, so that its functions compile once.
_functions = functools.lru_cache(maxsize=256)(_Integrated)


def _halves(x: Float[Array, " d"]) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
    return halves(x, "an integral and what is integrated, as many coordinates of each")
