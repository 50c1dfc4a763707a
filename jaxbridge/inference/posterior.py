"""Posterior draws: diagnostics, and the parts that `gibbs` and `pmmh` share.

The shared parts are the start, the continuation and the parallel run of chains.
"""

from abc import abstractmethod
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int, Key, PyTree

from ..engine.checks import check_count, is_traced
from ..engine.compiled import compiled_sooner
from ..engine.diagnostics import effective_size_of_chains, potential_scale_reduction
from ..engine.verdict import AbstractResult, Fault, Verdict
from ..schemes import StepError, dominates, step_faults, unknown_where
from .parameters import Parameters, init_vectors, of_rows

# Of about so many of the draws the step error is worked out: as many as tell a covariance, for it
# takes a good part of the time of an iteration.
_STEP_ERRORS = 256
# Of fewer draws a covariance tells nothing; nor if steps are too long for the drift in a larger
# share of them.
_FEWEST, _MOST_INFINITE = 10, 0.1
# Limits of chains that agree, and of draws that are worth an error.
_MOST_R_HAT, _FEWEST_EFFECTIVE = 1.1, 25
_APART = (
    "Chains, or halves of a chain, disagree (R̂ above 1.1 for some parameter): they have not "
    "converged. Use more `num_iterations` and `num_warmup`, or start from likelier parameters by "
    "`init=`."
)
_FEW = (
    "The effective sample size of some parameter is below 25: its mean and its error are "
    "unreliable. Use more `num_iterations`."
)
# A walk that is refused more often is not adapted, or estimates are too noisy.
_LEAST_ACCEPTED = 0.05
_REFUSED = (
    "Some chain accepted less than 5 % of the proposed parameters: it moves slowly, so errors may "
    "be too small. Use more `num_warmup`, start from likelier parameters by "
    "`init=`, or pass the first `covariance` of the moves."
)
_STUCK = (
    "A parameter, or a block of the path, never moved. Use more `num_iterations`, or start from "
    "likelier parameters by `init=`."
)


class AbstractPosterior(AbstractResult):
    """Base class of posterior draws, with their Monte Carlo and discretisation errors."""

    params: eqx.AbstractVar[PyTree]
    theta: eqx.AbstractVar[Float[Array, "*chains n p"]]
    names: eqx.AbstractVar[tuple[str, ...]]
    log_step_error: eqx.AbstractVar[Float[Array, "*chains n"]]
    sigma_varies: eqx.AbstractVar[bool]

    @property
    @abstractmethod
    def _stuck(self) -> Bool[Array, "*chains"] | bool:
        """Whether a path that is drawn with them never moved."""

    @property
    @abstractmethod
    def _faults(self) -> tuple[Fault, ...]:
        """Return the faults that only this kind of sampler has."""

    @property
    def verdict(self) -> Verdict:
        """The faults of the draws, each with a remedy.

        They are: a parameter or block that never moved, chains that disagree, few effective draws,
        those of the sampler, and a discretisation error that dominates and exceeds 0.05 posterior
        standard deviations.
        """
        sd = jnp.std(self.theta, axis=tuple(range(self.theta.ndim - 1)))
        steps = step_faults(self._step_error, self.standard_error, sd)
        return Verdict(
            (
                Fault(jnp.any(jnp.isinf(self.standard_error)), _STUCK),
                Fault(~jnp.all(self.r_hat < _MOST_R_HAT), _APART),
                Fault(~jnp.all(self.effective_sample_size >= _FEWEST_EFFECTIVE), _FEW),
                *self._faults,
                *(fault.in_any() for fault in steps),
            )
        ).with_finite(self.theta)

    @property
    def _chains(self) -> Float[Array, "chains n p"]:
        return self.theta if self.theta.ndim == 3 else self.theta[None]

    @property
    def effective_sample_size(self) -> Float[Array, " p"]:
        """Effective sample size of each unknown parameter, from all chains, shape (p,).

        It is small if chains disagree. It is zero if the parameter, or a path drawn with it, never
        moved in some chain.
        """
        return jnp.where(self._moved, effective_size_of_chains(self._chains), 0)

    @property
    def _moved(self) -> Bool[Array, " p"]:
        """Whether each parameter moved in all chains, and all that is drawn with it."""
        moved = jnp.all(jnp.any(self._chains != self._chains[:, :1], axis=1), axis=0)
        return moved & ~jnp.any(jnp.asarray(self._stuck))

    @property
    def r_hat(self) -> Float[Array, " p"]:
        """R̂ of each unknown parameter, from the halves of all chains, shape (p,)."""
        return potential_scale_reduction(self._chains)

    @property
    def step_error(self) -> Float[Array, " p"]:
        """Estimated discretisation bias of the posterior means (estimate minus limit), shape (p,).

        To first order it is the covariance of θ and `log_step_error`. NaN if that is not available,
        for instance with one step. It is also NaN, with an infinite uncertainty, if the steps are
        too long for the drift (`log_step_error` is infinite) in more than a tenth of the draws.
        """
        return self._step_error.value

    @property
    def step_uncertainty(self) -> Float[Array, " p"]:
        """Standard error of `step_error`, shape (p,).

        For a state-dependent σ it is at least `step_error` itself. There the estimate from half as
        many steps may be too large by a factor of two or three.
        """
        value, noise = self._step_error
        return jnp.hypot(noise, value) if self.sigma_varies else noise

    @property
    def standard_error(self) -> Float[Array, " p"]:
        """Monte Carlo error of the posterior mean of each unknown parameter, shape (p,).

        It is infinite if the parameter, or a path drawn with it, never moved in some chain.
        """
        draws = self.theta.reshape(-1, self.theta.shape[-1])
        made = jnp.std(draws, axis=0) / jnp.sqrt(self.effective_sample_size)
        return jnp.where(self._moved, made, jnp.inf)

    @property
    def step_error_dominates(self) -> Bool[Array, " p"]:
        """Whether the discretisation error exceeds the Monte Carlo error, or may do so; shape (p,).

        Then more steps help, and more iterations do not.
        """
        # Not by `step_uncertainty`: beside a doubt of its own size no error would be seen.
        return dominates(self._step_error, self.standard_error)

    @property
    def _step_error(self) -> StepError:
        known = jnp.isfinite(self.log_step_error)
        number = jnp.sum(known)
        error = jnp.where(known, self.log_step_error, 0)
        error = jnp.where(known, error - jnp.sum(error) / number.astype(error.dtype), 0)
        deviation = self.theta - jnp.mean(self.theta, axis=tuple(range(self.theta.ndim - 1)))
        products = (deviation * error[..., None]).reshape(-1, self.theta.shape[-1])
        count = jnp.maximum(number, 1).astype(products.dtype)
        mean = jnp.sum(products, axis=0) / count
        each = jnp.where(known.reshape(-1, 1), products - mean, 0)
        # Draws that follow each other are not independent, and no more so than those of θ.
        share = self.effective_sample_size / error.size
        spread = jnp.sqrt(jnp.sum(each**2, axis=0) / jnp.minimum(count * share, count)) / jnp.sqrt(
            count
        )
        few = number < _FEWEST
        error = StepError(jnp.where(few, jnp.nan, mean), jnp.where(few, jnp.nan, spread))
        infinite = jnp.sum(jnp.isinf(self.log_step_error)).astype(products.dtype)
        return unknown_where(
            infinite > _MOST_INFINITE * (infinite + number.astype(infinite.dtype)), error
        )

    def to_arviz(self) -> Any:
        """Return the draws as ArviZ's `InferenceData` (`DataTree` since its version 1).

        This needs the package ArviZ.
        """
        import arviz

        def of_chains(leaf):
            return jax.device_get(leaf if self.theta.ndim == 3 else leaf[None])

        leaves = jax.tree_util.tree_leaves_with_path(self.params)
        posterior = {
            jax.tree_util.keystr(path, simple=True, separator=".") or "theta": of_chains(leaf)
            for path, leaf in leaves
            if eqx.is_array(leaf)
        }
        if int(arviz.__version__.split(".")[0]) >= 1:
            return arviz.from_dict({"posterior": posterior})
        return arviz.from_dict(posterior=posterior)


def refused_moves(accepted: Bool[Array, "*chains n"]) -> Fault:
    """Return the fault of a random walk of which hardly any move is accepted."""
    return Fault(jnp.any(jnp.mean(accepted, axis=-1) < _LEAST_ACCEPTED), _REFUSED)


def check_likelihood_was_found(never: Bool[Array, "*chains"]) -> None:
    """Raise `ValueError` where a chain `never` came to parameters and paths whose likelihood is
    finite; under `jit` the draws are flagged instead."""
    if not is_traced(never) and (stuck := np.flatnonzero(np.asarray(never))).size:
        raise ValueError(
            f"the likelihood at the start parameters is zero, also with paths guided by all "
            f"observations, and none of the moves found a positive one (chain {stuck[0]} of "
            f"{never.size}). Start from likelier parameters by `init=` or the model's `params`, "
            "use more `num_steps`, or allow for outliers in the noise of the observations."
        )


def starting_points(
    parameters: Parameters,
    theta: Float[Array, " p"],
    init: PyTree,
    num_chains: int | None,
    log_prior: Callable[[Array], Array],
    state_type: type,
) -> tuple[Float[Array, "*chains p"], Any]:
    """θ of each chain, and the state to go on from, if `init` is one."""
    chains = () if num_chains is None else (check_count("num_chains", num_chains),)
    state = init if isinstance(init, state_type) else None
    if state is not None:
        p, theta = theta.shape[0], state.theta
        if theta.shape[-1] != p:
            raise ValueError(
                f"`init` is a state of {theta.shape[-1]} unknown parameters, but there are {p}: "
                "pass the `where` of the earlier draws."
            )
        if theta.shape[:-1] != chains and num_chains is not None:
            raise ValueError(
                f"`init` is a state of chains {theta.shape[:-1]}, but `num_chains` is "
                f"{num_chains}: omit `num_chains`."
            )
    elif init is not None:
        theta = init_vectors(parameters, init, chains).astype(theta.dtype)
    if theta.ndim == 1:
        theta = jnp.broadcast_to(theta, (*chains, *theta.shape))
    parameters.check_allowed(theta)
    values = of_rows(log_prior, theta)
    if not is_traced(values) and not np.all(good := np.isfinite(np.asarray(values))):
        i = int(np.argmin(good))
        row = theta.reshape(-1, theta.shape[-1])[i]
        raise ValueError(
            f"`prior` is {values[i]} at the start parameters {parameters.select(row)}: pass start "
            "parameters with a positive prior density as `init`."
        )
    return theta, state


def check_covariance_is_used(covariance: Any, state: Any) -> None:
    """Raise `ValueError` for a `covariance` beside a state to go on from."""
    if state is not None and covariance is not None:
        raise ValueError(
            "`covariance` is for a new start: omit it, because a state as `init` has its own."
        )


def first_chain(theta: Float[Array, "*chains p"]) -> Float[Array, " p"]:
    """θ of the first chain, at which proposals are chosen."""
    return theta.reshape(-1, theta.shape[-1])[0]


def over_chains(function: Callable, key: Key[Array, ""], state: PyTree) -> Any:
    """`function(key, state)` of each chain, with keys of their own if there are several; θ is the
    first leaf of the state."""
    theta = jax.tree.leaves(state)[0]
    if theta.ndim == 1:
        return function(key, state)
    keys = jax.random.split(key, len(theta))
    return jax.vmap(lambda *each: function(*each))(keys, state)


def step_errors_of_some(
    function: Callable[[PyTree], Float[Array, "*chains"]],
    state: PyTree,
    number: Int[Array, ""],
    num_draws: int,
) -> Float[Array, "*chains"]:
    """`function(state)` of some of so many draws, with numbers from zero on; NaN of the others."""
    every = max(1, num_draws // _STEP_ERRORS)
    shape = jax.eval_shape(function, state)
    called_for = (number >= 0) & (number % every == every - 1)
    return lax.cond(called_for, function, lambda _: jnp.full_like(shape, jnp.nan), state)


@compiled_sooner
def first_states(start: Callable, key: Key[Array, ""], state: PyTree) -> Any:
    """The states that chains start from: key number 0 is theirs, and iterations have the others."""
    return over_chains(start, jax.random.fold_in(key, 0), state)


def drawn(
    parameters: Parameters, theta: Float[Array, "n *chains p"], *others: PyTree
) -> tuple[dict[str, Any], PyTree]:
    """The fields of a posterior that θ makes, and what else was kept of each draw, with axes
    (*chains, n) in front."""
    full = eqx.filter_vmap(parameters.full)  # parameters may be other things than numbers
    if theta.ndim == 3:
        full = eqx.filter_vmap(full)
        theta, others = jax.tree.map(lambda leaf: jnp.moveaxis(leaf, 0, 1), (theta, others))
    return {"params": full(theta), "theta": theta, "names": parameters.names}, others


def summed(infos: PyTree) -> PyTree:
    """What was counted, over the first axis."""
    return jax.tree.map(lambda leaf: jnp.sum(leaf, axis=0, dtype=jnp.int32), infos)
