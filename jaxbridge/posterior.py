"""Draws from a posterior, and how far to trust them."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from .diagnostics import effective_sample_size, potential_scale_reduction


class AbstractPosterior(eqx.Module):
    """Draws of unknown parameters; arrays have a leading axis of chains if there are several."""

    params: eqx.AbstractVar[PyTree]
    theta: eqx.AbstractVar[Float[Array, "*chains n p"]]
    names: eqx.AbstractVar[tuple[str, ...]]

    @property
    def _chains(self) -> Float[Array, "chains n p"]:
        return self.theta if self.theta.ndim == 3 else self.theta[None]

    @property
    def effective_sample_size(self) -> Float[Array, " p"]:
        """Of each unknown parameter, summed over the chains: to be trusted where `r_hat` says that
        they agree."""
        return jnp.sum(jax.vmap(effective_sample_size)(self._chains), axis=0)

    @property
    def r_hat(self) -> Float[Array, " p"]:
        """R̂ of each unknown parameter, from the halves of all chains."""
        return potential_scale_reduction(self._chains)

    def to_arviz(self) -> Any:
        """As ArviZ's `InferenceData` (a `DataTree` since its version 1). Needs ArviZ."""
        import arviz

        def of_chains(leaf):
            return jax.device_get(leaf if self.theta.ndim == 3 else leaf[None])

        leaves = jax.tree_util.tree_leaves_with_path(self.params)
        posterior = {
            jax.tree_util.keystr(path, simple=True, separator=".") or "theta": of_chains(leaf)
            for path, leaf in leaves
        }
        if int(arviz.__version__.split(".")[0]) >= 1:
            return arviz.from_dict({"posterior": posterior})
        return arviz.from_dict(posterior=posterior)
