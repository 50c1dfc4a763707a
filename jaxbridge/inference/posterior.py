"""Posterior draws: diagnostics, and the parts that `gibbs` and `pmmh` share.

The shared parts are the start, the continuation and the parallel run of chains.
"""

import dataclasses
from abc import abstractmethod
from collections.abc import Callable
from typing import Any, ClassVar, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int, Key, Num, PyTree

from ..engine.checks import check_count, is_traced
from ..engine.compiled import compiled_sooner
from ..engine.diagnostics import effective_size_of_chains, r_hat_of_chains
from ..engine.labelled import named_leaves
from ..engine.verdict import AbstractResult, Fault, Verdict
from ..schemes import LEAST_UNCERTAINTY, StepError, dominates, step_faults, unknown_where
from .parameters import Parameters, init_vectors, of_rows
from .population import LOG_SD, Population
from .summary import PosteriorSummary

# The discretisation error is computed for at least so many draws (if there are as many), and for
# fewer than twice as many: enough for a covariance. For all draws it would take a large part of the
# run time.
_STEP_ERRORS = 256
# No covariance is estimated from fewer draws, nor if steps are too long for the drift in a larger
# share of the draws.
_FEWEST, _MOST_INFINITE = 10, 0.1
# Largest R̂ of chains that agree, and smallest effective sample size with a reliable error.
_MOST_R_HAT, _FEWEST_EFFECTIVE = 1.1, 25
_APART = (
    "Chains, or halves of a chain, disagree (R̂ above 1.1 for some parameter): they have not "
    "converged. Use more `num_iterations` (and `num_warmup`, where chains have a warm-up), or "
    "start from likelier parameters by `init=`."
)
_FEW = (
    "The effective sample size of some parameter is below 25: its mean and its error are "
    "unreliable. Use more `num_iterations`."
)
# At a lower acceptance rate the walk is not adapted, or the estimates are too noisy.
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


# Combines the values of two parts of a run; the number is the fraction of draws in the second part.
Combination = Callable[[Any, Any, float], Any]
_Posterior = TypeVar("_Posterior", bound="AbstractPosterior")


class AbstractPosterior(AbstractResult):
    """Posterior draws with their Monte Carlo and discretisation errors.

    Base class of the results of `gibbs` and `pmmh`, for annotations and `isinstance`. Without
    `num_chains` arrays have no axis of chains.

    - `params`: draws of all parameters of the model, a pytree with leading axes (chains, n).
    - `theta`: draws of the unknown parameters as vectors, shape (chains, n, p).
    - `names`: names of the p entries of θ.
    - `log_step_error`: estimated discretisation error of the log-likelihood at each draw, shape
        (chains, n). NaN at draws where it was not computed.
    - `sigma_varies`: whether σ depends on the state.
    - `state`: last state of the chains, to continue the run.
    """

    params: eqx.AbstractVar[PyTree]
    theta: eqx.AbstractVar[Float[Array, "*chains n p"]]
    names: eqx.AbstractVar[tuple[str, ...]]
    log_step_error: eqx.AbstractVar[Float[Array, "*chains n"]]
    sigma_varies: eqx.AbstractVar[bool]

    state: eqx.AbstractVar[Any]
    # Fields without a value for each draw, with the functions by which `joined` combines them.
    _combinations: ClassVar[dict[str, Combination]]
    # Arguments, beside `init`, of a call that continues the draws.
    _continued_with: ClassVar[dict[str, Any]]

    @property
    @abstractmethod
    def _stuck(self) -> Bool[Array, "*chains"] | bool:
        """Return whether a path that is sampled together with θ never moved."""

    @property
    @abstractmethod
    def _faults(self) -> tuple[Fault, ...]:
        """Return the faults that only this kind of sampler has."""

    @property
    def verdict(self) -> Verdict:
        """Return the faults of the draws, each with a remedy.

        - a parameter or block that never moved;
        - chains that disagree, or few effective draws;
        - faults of the sampler;
        - a discretisation error that is unknown or too uncertain, or that dominates and exceeds
            0.05 posterior standard deviations;
        - draws that are not finite.
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
        """Return the effective sample size of each unknown parameter, from all chains, shape (p,).

        It is small if chains disagree. It is zero if the parameter, or a path drawn with it, never
        moved in some chain. Chains of fewer than four draws count as one draw each.
        """
        return jnp.where(self._moved, effective_size_of_chains(self._chains), 0)

    @property
    def _moved(self) -> Bool[Array, " p"]:
        """Return whether each parameter, and the paths sampled with it, moved in all chains."""
        has_moved = jnp.all(jnp.any(self._chains != self._chains[:, :1], axis=1), axis=0)
        return has_moved & ~jnp.any(jnp.asarray(self._stuck))

    @property
    def r_hat(self) -> Float[Array, " p"]:
        """Return R̂ of each unknown parameter, from the halves of all chains, shape (p,).

        NaN for a parameter that never moved, and for fewer than four draws.
        """
        return r_hat_of_chains(self._chains)

    @property
    def step_error(self) -> Float[Array, " p"]:
        """Return the estimated discretisation bias of the posterior means, shape (p,).

        The bias is the estimate minus its limit. To first order it is the covariance of θ and
        `log_step_error`. It is NaN if `log_step_error` is known for fewer than ten draws, as with a
        single step. It is also NaN, with an infinite uncertainty, if `log_step_error` is infinite
        in more than a tenth of the draws for which it was computed. (Steps are then too long for
        the drift.)
        """
        return self._step_error.value

    @property
    def step_uncertainty(self) -> Float[Array, " p"]:
        """Return the standard error of `step_error`, shape (p,).

        It is at least a quarter of `step_error`, because only the leading term is estimated. For a
        state-dependent σ it is at least `step_error` itself: for Euler steps the estimate from half
        as many steps may be too large by a factor of two or three.
        """
        value, noise = self._step_error
        # The estimate may be too large by its own size, or omits terms of higher order.
        return jnp.hypot(noise, (1 if self.sigma_varies else LEAST_UNCERTAINTY) * value)

    @property
    def standard_error(self) -> Float[Array, " p"]:
        """Return the Monte Carlo error of each unknown parameter's posterior mean, shape (p,).

        It is infinite if the parameter, or a path drawn with it, never moved in some chain.
        """
        draws = self.theta.reshape(-1, self.theta.shape[-1])
        errors = jnp.std(draws, axis=0) / jnp.sqrt(self.effective_sample_size)
        return jnp.where(self._moved, errors, jnp.inf)

    @property
    def step_error_dominates(self) -> Bool[Array, " p"]:
        """Return whether the discretisation error exceeds the Monte Carlo error, or may do so.

        Shape (p,). If true, use more steps; if only the estimate of the error is uncertain, more
        iterations help, too (`why()`).
        """
        # `step_uncertainty` may be as large as the error itself, and would hide it.
        return dominates(self._step_error, self.standard_error)

    @property
    def _step_error(self) -> StepError:
        computed = jnp.isfinite(self.log_step_error)
        number = jnp.sum(computed)
        error = jnp.where(computed, self.log_step_error, 0)
        error = jnp.where(computed, error - jnp.sum(error) / number.astype(error.dtype), 0)
        deviation = self.theta - jnp.mean(self.theta, axis=tuple(range(self.theta.ndim - 1)))
        products = (deviation * error[..., None]).reshape(-1, self.theta.shape[-1])
        count = jnp.maximum(number, 1).astype(products.dtype)
        mean = jnp.sum(products, axis=0) / count
        deviations = jnp.where(computed.reshape(-1, 1), products - mean, 0)
        variance = jnp.sum(deviations**2, axis=0) / count
        # These draws are evenly spaced, so they depend on each other only if they are more than
        # the effective sample size of θ.
        spread = jnp.sqrt(variance / jnp.minimum(self.effective_sample_size, count))
        too_few = number < _FEWEST
        error = StepError(jnp.where(too_few, jnp.nan, mean), jnp.where(too_few, jnp.nan, spread))
        infinite = jnp.sum(jnp.isinf(self.log_step_error)).astype(products.dtype)
        return unknown_where(
            infinite > _MOST_INFINITE * (infinite + number.astype(infinite.dtype)), error
        )

    @property
    def continuation(self) -> dict[str, Any]:
        """Return arguments that continue this run.

        Merge them into the arguments of this run, some of which they replace, and pass the same
        `key`. The new draws use the random numbers after those of this run.

        **Example:**

        ```python
        part = jb.gibbs(key, model, times, observations, **options)
        later = jb.gibbs(key, model, times, observations, **options | part.continuation)
        posterior = part.joined(later)
        ```
        """
        return {"init": self.state, "num_chains": None, **self._continued_with}

    def joined(self: _Posterior, later: _Posterior) -> _Posterior:
        """Return the draws of this part of a run and of the part that continues it.

        Diagnostics and errors are then those of all draws.

        **Raises:** `TypeError` for a posterior of another sampler, `ValueError` for one with other
        parameters or chains.
        """
        if type(later) is not type(self):
            raise TypeError(
                f"`later` must be a {type(self).__name__}, like this part; got {later!r}."
            )
        if later.names != self.names or later.theta.shape[:-2] != self.theta.shape[:-2]:
            raise ValueError(
                f"`later` must have the parameters {self.names} and chains of shape "
                f"{self.theta.shape[:-2]}, as this part; got {later.names} and "
                f"{later.theta.shape[:-2]}. Pass the draws of a call with `**part.continuation`."
            )
        axis, num_draws = self.theta.ndim - 2, [part.theta.shape[-2] for part in (self, later)]
        share = num_draws[1] / sum(num_draws)
        joined = lambda a, b: jnp.concatenate([a, b], axis) if eqx.is_array(a) else b
        fields = {}
        for field in dataclasses.fields(self):
            parts = getattr(self, field.name), getattr(later, field.name)
            combine = self._combinations.get(field.name)
            fields[field.name] = (
                jax.tree.map(joined, *parts) if combine is None else combine(*parts, share)
            )
        return type(self)(**fields)

    def summary(self) -> PosteriorSummary:
        """Return a table of the posterior, which prints as text; not inside `jit`.

        It has means, standard deviations, quantiles (2.5, 50 and 97.5 %), errors, R̂, effective
        sample sizes and the
        verdict. `print(posterior)` shows it, too.

        **Raises:** `TypeError` inside `jit` or `vmap`, where no numbers exist.

        **Example:**

        ```python
        print(posterior.summary())
        posterior.summary().mean  # a NumPy array
        ```
        """
        if is_traced(self.theta):
            raise TypeError(
                "`summary` needs numbers, which do not exist inside `jit` or `vmap`: return the "
                "posterior, and call `summary` outside."
            )
        num_chains, num_draws, p = self._chains.shape
        draws = np.asarray(self._chains, float).reshape(-1, p)
        low, median, high = np.quantile(draws, [0.025, 0.5, 0.975], axis=0)
        as_float = lambda column: np.asarray(column, float)
        chains = "1 chain" if num_chains == 1 else f"{num_chains} chains"
        return PosteriorSummary(
            title=f"{type(self).__name__}: {chains} of {num_draws:,} draws",
            names=self.names,
            mean=draws.mean(axis=0),
            sd=draws.std(axis=0),
            low=low,
            median=median,
            high=high,
            standard_error=as_float(self.standard_error),
            step_error=as_float(self.step_error),
            r_hat=as_float(self.r_hat),
            effective_sample_size=as_float(self.effective_sample_size),
            verdict=self.why(),
        )

    def __str__(self) -> str:
        """Return the table of `summary` as text."""
        return repr(self) if is_traced(self.theta) else str(self.summary())

    def _repr_html_(self) -> str:
        """Return the table of `summary` as HTML, which notebooks show."""
        return self.summary()._repr_html_()

    def to_arviz(self) -> Any:
        """Return the draws as ArviZ's `InferenceData` (`DataTree` since its version 1).

        The group `posterior` contains the parameters. With a `population` it also contains those of
        each record ("unit_params.rate") and the log standard deviations ("log_sd(rate)"). The group
        `sample_stats` contains the other values of each draw, for instance whether moves were
        accepted. There `log_likelihood` of `pmmh` has the name `log_likelihood_estimate`, because
        ArviZ expects one log-likelihood for each observation. With `save_states` of `gibbs` the
        group `log_likelihood` contains these for `arviz.loo`, with the record and the index of the
        time of each: log densities given θ and the states at the times before and after. The group
        `posterior` contains the states. This needs the package ArviZ.

        **Example:**

        ```python
        arviz.plot_trace(posterior.to_arviz())
        ```
        """
        import arviz

        def of_chains(leaf):
            return jax.device_get(leaf if self.theta.ndim == 3 else leaf[None])

        leaves = named_leaves(self.params)
        leaves |= named_leaves(getattr(self, "unit_params", None), "unit_params")
        posterior = {name or "theta": of_chains(leaf) for name, leaf in leaves.items()}
        # Entries of θ without a parameter of the model.
        of_entries = jnp.moveaxis(self._chains, -1, 0)
        for name, draws in zip(self.names, of_entries, strict=True):
            if name.startswith(f"{LOG_SD}("):
                posterior[name] = jax.device_get(draws)
        others = ("params", "theta", "unit_params", "states", "log_densities", *self._combinations)
        names = [field.name for field in dataclasses.fields(self) if field.name not in others]
        stats = {name: getattr(self, name) for name in names}
        stats = {name: of_chains(value) for name, value in stats.items() if eqx.is_array(value)}
        if "log_likelihood" in stats:  # a group of ArviZ, with a value for each observation
            stats["log_likelihood_estimate"] = stats.pop("log_likelihood")
        groups: dict[str, Any] = {"posterior": posterior, "sample_stats": stats}
        states, logs = (getattr(self, name, None) for name in ("states", "log_densities"))
        labels: dict[str, Any] = {}
        if states is not None:
            posterior["states"], logs = of_chains(states), of_chains(logs)
            seen = ~np.all(np.isnan(logs), axis=(0, 1))  # (records, times)
            groups["log_likelihood"] = {"observations": logs[..., seen]}
            readings = [f"record {i}, time {k}" for i, k in np.argwhere(seen)]
            labels = {"coords": {"reading": readings}, "dims": {"observations": ["reading"]}}
        # Version 1 changed the arguments of `from_dict`.
        is_new = int(arviz.__version__.split(".")[0]) >= 1
        from_dict: Any = arviz.from_dict
        return from_dict(groups, **labels) if is_new else from_dict(**groups, **labels)


def last(first: Any, second: Any, share: float) -> Any:
    """Return the value of the second part of a run."""
    return second


def total(first: Any, second: Any, share: float) -> Any:
    """Return the sum of the counts of both parts of a run."""
    return first + second


def average(first: Any, second: Any, share: float) -> Any:
    """Return the mean over both parts of a run.

    `share` is the fraction of draws in the second part. `None` stays `None`.
    """
    return None if first is None else (1 - share) * first + share * second


def refused_moves(accepted: Num[Array, "*chains n"]) -> Fault:
    """Return the fault of a random walk whose acceptance rate is below 5 %.

    `accepted` are fractions of accepted moves, or whether a single move was accepted.
    """
    return Fault(jnp.any(jnp.mean(accepted, axis=-1) < _LEAST_ACCEPTED), _REFUSED)


def check_likelihood_was_found(never: Bool[Array, "*chains"]) -> None:
    """Raise `ValueError` if a chain never reached a positive likelihood.

    `never` is true for such chains. Under `jit` the draws are flagged instead.
    """
    if not is_traced(never) and (stuck := np.flatnonzero(np.asarray(never))).size:
        raise ValueError(
            f"the estimated likelihood at the start parameters is zero, and none of the moves "
            f"found a positive one (chain {stuck[0]} of {never.size}). Start from likelier "
            "parameters by `init=` or the model's `params`, use more `num_steps`, or allow for "
            "outliers in the noise of the observations."
        )


def starting_points(
    parameters: Parameters,
    theta: Float[Array, " p"],
    init: PyTree,
    num_chains: int | None,
    log_prior: Callable[[Array], Array],
    state_type: type,
    num_others: int = 0,
) -> tuple[Float[Array, "*chains p"], Any]:
    """Return θ of each chain, and the state to continue if `init` is one, else `None`.

    `num_others` is the number of further entries that follow θ in a state.

    **Raises:** `ValueError` for an `init` that does not fit the parameters or chains, violates the
    constraint, or has a prior density that is not finite and positive.
    """
    chains = () if num_chains is None else (check_count("num_chains", num_chains),)
    state = init if isinstance(init, state_type) else None
    if state is not None:
        p, theta = theta.shape[0], state.theta
        if theta.shape[-1] != p + num_others:
            raise ValueError(
                f"`init` is the state of a run with {theta.shape[-1]} unknown parameters, but this "
                f"call has {p + num_others}. Pass the same `where` as before (and, in `gibbs`, the "
                "same `population`)."
            )
        theta = theta[..., :p]
        if theta.shape[:-1] != chains and num_chains is not None:
            raise ValueError(
                f"`init` is the state of chains of shape {theta.shape[:-1]}, but `num_chains` is "
                f"{num_chains}: omit `num_chains` to continue all chains of the state."
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
    """Raise `ValueError` for a `covariance` together with a state to continue."""
    if state is not None and covariance is not None:
        raise ValueError(
            "`covariance` is for a new start, but `init` is the state of earlier chains, which "
            "contains their covariance. Omit `covariance`."
        )


def first_chain(values: Float[Array, "..."], num_axes: int = 1) -> Float[Array, "..."]:
    """Return the values of the first chain, such as θ, at which proposals are selected.

    The values of one chain have `num_axes` axes; those of several chains have one more.
    """
    return values if values.ndim == num_axes else values[0]


def over_chains(function: Callable, key: Key[Array, ""], state: PyTree) -> Any:
    """Return `function(key, state)` of each chain, with separate keys for several chains.

    The first leaf of the state must be θ.
    """
    theta = _theta_of(state)
    if theta.ndim == 1:
        return function(key, state)
    keys = jax.random.split(key, len(theta))
    return jax.vmap(lambda *chain: function(*chain))(keys, state)


def thinned_step_errors(
    function: Callable[[PyTree], Float[Array, "*chains"]],
    state: PyTree,
    number: Int[Array, ""],
    num_draws: int,
) -> Float[Array, "*chains"]:
    """Return `function(state)` if the draw with this number is selected, else NaN.

    Of `num_draws` draws 256 to 511 are selected, evenly spaced, or all if there are fewer than 512.
    `number` counts the draws from zero. It is negative in the warm-up, where none is selected.
    The first leaf of the state must be θ.
    """
    every = max(1, num_draws // _STEP_ERRORS)
    theta = _theta_of(state)
    none = jnp.full(theta.shape[:-1], jnp.nan, theta.dtype)
    is_selected = (number >= 0) & (number % every == every - 1)
    # `cond` computes the function for the selected draws only.
    return lax.cond(is_selected, function, lambda _: none, state)


def _theta_of(state: PyTree) -> Float[Array, "*chains p"]:
    """Return θ, the first leaf of the state."""
    return jax.tree.leaves(state)[0]


@compiled_sooner
def first_states(start: Callable, key: Key[Array, ""], state: PyTree) -> Any:
    """Return the first states of the chains, from key number 0; iterations use other numbers."""
    return over_chains(start, jax.random.fold_in(key, 0), state)


def posterior_fields(
    parameters: Parameters | Population, theta: Float[Array, "n *chains p"], *values: PyTree
) -> tuple[dict[str, Any], PyTree]:
    """Return the fields `params`, `theta` and `names` of a posterior, and the other values.

    All arrays get the leading axes (*chains, n).
    """
    full = eqx.filter_vmap(parameters.full)  # parameters may contain objects that are no arrays
    if theta.ndim == 3:
        full = eqx.filter_vmap(full)
        # Loops put draws before chains.
        theta, values = jax.tree.map(lambda leaf: jnp.moveaxis(leaf, 0, 1), (theta, values))
    return {"params": full(theta), "theta": theta, "names": parameters.names}, values


def sum_counts(infos: PyTree) -> PyTree:
    """Return the counts, summed over the first axis."""
    return jax.tree.map(lambda leaf: jnp.sum(leaf, axis=0, dtype=jnp.int32), infos)
