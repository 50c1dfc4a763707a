"""Parameters that vary between records, with a normal law in the population.

The entries j of θ that vary are the means of the population. Record r has the parameters

    θ_rj = θ_j + s_j z_rj,    z_rj ~ N(0, 1),    s_j = e^{λ_j},

and θ_r = θ in all other entries. The parameters of the population are φ = (θ, λ). Each iteration
moves φ in two ways, because each way mixes poorly where the other mixes well (Papaspiliopoulos,
Roberts & Sköld 2007):

- with z and the noise of the paths fixed: then all θ_r and all paths change with φ;
- with the θ_r and the paths fixed: then z changes with φ, and the data do not matter.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import block_diag
from jaxtyping import Array, Bool, Float, Int, Key, PyTree

from ..engine.arguments import check_function, evaluated
from ..engine.checks import as_floating, is_traced
from .parameters import Parameters, of_rows

# Log standard deviations have names such as "log_sd(rate)".
LOG_SD = "log_sd"

# Standard deviations of the population start at this fraction of the scale of their prior.
_FIRST_SPREAD = 0.3


class NormalPopulation(eqx.Module):
    """Normal law of parameters that vary between records, with unknown mean and variance.

    Use the logarithms of positive parameters as parameters of the model: they are then log-normal.

    **Arguments:**

    - `per_unit`: a function that selects these parameters from `model.params`, for instance
        `lambda params: params["log_rate"]` or `lambda params: params["B"][0]`. They must be
        unknown. The prior of `gibbs` is then that of their means in the population. Its
        `constraint` applies to the means and to the parameters of each record.
    - `spread`: scale of the half-normal prior of the standard deviations in the population, by
        default 1; a number, or one for each parameter.

    **Raises:** `TypeError` if `per_unit` is no function; `ValueError` for a `spread` that is not
    positive and finite. `gibbs` raises `ValueError` if `per_unit` selects anything but unknown
    parameters, for a `spread` of another shape, or for a single record.

    **Example:**

    ```python
    population = jb.NormalPopulation(lambda params: params["log_rate"], spread=0.5)
    ```

    **Source:** Gelman et al., Bayesian Data Analysis (2013), chapter 5.
    """

    per_unit: Callable[[PyTree], PyTree] = eqx.field(static=True)
    spread: Float[Array, "..."]

    def __init__(self, per_unit: Callable[[PyTree], PyTree], spread: Any = 1.0):
        check_function("per_unit", per_unit, "(params)")
        self.per_unit, self.spread = per_unit, as_floating("spread", spread)
        if not is_traced(self.spread):
            values = np.asarray(self.spread)
            if not np.all((values > 0) & np.isfinite(values)):
                raise ValueError(f"`spread` must be positive and finite; got {spread}.")


class Population(eqx.Module):
    """Unknown parameters φ = (θ, λ), and those of each record.

    Record r has the parameters θ + s z_r in the entries that vary, with z_r ~ N(0, I), λ = log s.
    Without such entries, λ and z are empty and φ = θ.

    - `varies`: indices of the entries of θ that vary.
    - `spread`: scales of the priors of s.
    """

    parameters: Parameters
    log_prior: Callable[[Array], Array]
    varies: tuple[int, ...] = eqx.field(static=True)
    spread: Float[Array, " q"]

    @property
    def names(self) -> tuple[str, ...]:
        """Return the names of the entries of φ."""
        names = self.parameters.names
        return (*names, *(f"{LOG_SD}({names[j]})" for j in self.varies))

    def first_root(self, root: Float[Array, "p p"]) -> Float[Array, "p+q p+q"]:
        """Return S of the first moves of φ, given that of θ."""
        of_spreads = _FIRST_SPREAD * jnp.eye(len(self.varies), dtype=root.dtype)
        return block_diag(root, of_spreads) if self.varies else root

    def check_state(self, state: Any) -> None:
        """Raise `ValueError` if a state has another number of entries that vary.

        `None` is allowed: it stands for a new start.
        """
        if state is not None and state.units.shape[-1] != len(self.varies):
            raise ValueError(
                f"`init` is a state of draws with {state.units.shape[-1]} parameters that vary "
                f"between records, but here {len(self.varies)} vary: pass the `population` of the "
                "earlier draws."
            )

    def split(self, phi: Float[Array, "p+q"]) -> tuple[Float[Array, " p"], Float[Array, " q"]]:
        """Return θ and λ = log s, the logarithms of the standard deviations of the population."""
        p = phi.shape[0] - len(self.varies)
        return phi[:p], phi[p:]

    def first_point(self, theta: Float[Array, "*chains p"]) -> Float[Array, "*chains p+q"]:
        """Return φ at the start: θ, and λ from the scale of the prior."""
        first = jnp.log(_FIRST_SPREAD * self.spread).astype(theta.dtype)
        return jnp.concatenate(
            [theta, jnp.broadcast_to(first, (*theta.shape[:-1], len(first)))], -1
        )

    @property
    def _groups(self) -> Bool[np.ndarray, "G p+q"]:
        """Return the masks of the entries of φ that move together given z, in turns.

        θ moves in every other turn, and each spread alone: a spread near zero has a wide law, and
        moves of other entries would hold it.
        """
        p, q = len(self.parameters.names), len(self.varies)
        each = np.eye(p + q, dtype=bool)
        of_theta = each[:p].any(axis=0)
        return np.stack([mask for spread in each[p:] for mask in (of_theta, spread)] or [of_theta])

    def moves(self, number: Int[Array, ""]) -> Bool[Array, "p+q"]:
        """Return the mask of the entries of φ that move at this turn, given z."""
        groups = jnp.asarray(self._groups)
        return groups[number % len(groups)]

    def full(self, phi: Float[Array, "p+q"]) -> PyTree:
        """Return all parameters of the model, at the means of the population."""
        return self.parameters.full(self.split(phi)[0])

    def of_units(
        self, phi: Float[Array, "p+q"], z: Float[Array, "R q"]
    ) -> Float[Array, " p"] | Float[Array, "R p"]:
        """Return θ_r of each record, or θ if it is the same for all."""
        theta, log_sd = self.split(phi)
        if not self.varies:
            return theta
        at = np.array(self.varies)
        units = jnp.broadcast_to(theta, (len(z), len(theta)))
        return units.at[:, at].add(jnp.exp(log_sd) * z)

    def allowed(self, phi: Float[Array, "p+q"], z: Float[Array, "R q"]) -> Bool[Array, "*R"]:
        """Return whether θ and θ_r satisfy the constraint, for each record if they vary."""
        allowed = self.parameters.allowed(self.split(phi)[0])
        if not self.varies:
            return allowed
        return allowed & of_rows(self.parameters.allowed, self.of_units(phi, z))

    def first_units(
        self, key: Key[Array, ""], phi: Float[Array, "p+q"], num_records: int
    ) -> Float[Array, "R q"]:
        """Sample z of the first θ_r. It is zero where θ_r would violate the constraint."""
        z = jax.random.normal(key, (num_records, len(self.varies)), phi.dtype)
        return jnp.where(self.allowed(phi, z)[:, None], z, 0) if self.varies else z

    def log_density(self, phi: Float[Array, "p+q"]) -> Float[Array, ""]:
        """Return the log prior density of φ, up to a constant."""
        theta, log_sd = self.split(phi)
        value = self.log_prior(theta)
        return value + jnp.sum(self._log_density_of_spread(log_sd)) if self.varies else value

    def _log_density_of_spread(self, log_sd: Float[Array, " q"]) -> Float[Array, " q"]:
        """Return the log density of λ for half-normal s = e^λ."""
        return log_sd - (jnp.exp(log_sd) / self.spread.astype(log_sd.dtype)) ** 2 / 2

    def given_units(
        self, key: Key[Array, ""], phi: Float[Array, "p+q"], z: Float[Array, "R q"]
    ) -> tuple[Float[Array, "p+q"], Float[Array, "R q"]]:
        """Move means and variances of the population given the parameters of the records.

        The proposals have the posterior laws for flat priors of θ and λ: N(mean of θ_r, s²/R) for
        the mean, SS / χ²_R for the variance, with the sum of squares SS. So the acceptance
        probability depends on the priors only.
        """
        mean_key, spread_key, mean_uniform, spread_uniform = jax.random.split(key, 4)
        theta, log_sd = self.split(phi)
        at, (R, q) = np.array(self.varies), z.shape
        # Deviations from the mean, because differences of θ_r and θ may lose digits.
        deviations = jnp.exp(log_sd) * z
        noise = jax.random.normal(mean_key, (q,), z.dtype) / np.sqrt(R).astype(z.dtype)
        shift = jnp.mean(deviations, axis=0) + jnp.exp(log_sd) * noise
        proposed = theta.at[at].add(shift)
        log_ratio = self.log_prior(proposed) - self.log_prior(theta)
        log_ratio = jnp.where(self.parameters.allowed(proposed), log_ratio, -jnp.inf)
        uniform = jax.random.uniform(mean_uniform, dtype=z.dtype)
        accepted = jnp.log(uniform) < log_ratio
        theta = jnp.where(accepted, proposed, theta)
        deviations = deviations - jnp.where(accepted, shift, 0)
        square = jnp.sum(deviations**2, axis=0)
        chi_square = 2 * jax.random.gamma(spread_key, R / 2, (q,), z.dtype)
        proposed_log_sd = jnp.log(square / chi_square) / 2
        density = self._log_density_of_spread
        log_ratio = density(proposed_log_sd) - density(log_sd)
        uniform = jax.random.uniform(spread_uniform, (q,), z.dtype)
        log_sd = jnp.where(jnp.log(uniform) < log_ratio, proposed_log_sd, log_sd)
        return jnp.concatenate([theta, log_sd]), deviations / jnp.exp(log_sd)


def as_population(
    population: NormalPopulation | None,
    parameters: Parameters,
    log_prior: Callable[[Array], Array],
    num_records: int,
) -> Population:
    """Return the unknown parameters of all records.

    **Raises:** `TypeError` and `ValueError` for an invalid `population`.
    """
    if population is None:
        return Population(parameters, log_prior, (), jnp.zeros(0))
    if not isinstance(population, NormalPopulation):
        raise TypeError(f"`population` must be a `NormalPopulation`; got {population!r}.")
    if num_records < 2:
        raise ValueError(
            "`population` is for parameters that vary between records, but there is one record: "
            "pass lists of `times` and `observations`, or omit `population`."
        )
    names = parameters.names
    arrays = evaluated("per_unit", population.per_unit, parameters.names_of_params)
    picked = [str(name) for leaf in jax.tree.leaves(arrays) for name in np.ravel(leaf)]
    if not picked or not set(picked) <= set(names) or len(set(picked)) < len(picked):
        raise ValueError(
            f"`per_unit` must select parameters that are unknown, {', '.join(names)}, each at most "
            f"once; it selected {', '.join(picked) or 'nothing'}."
        )
    varies = tuple(names.index(name) for name in picked)
    if population.spread.shape not in ((), (len(varies),)):
        raise ValueError(
            f"`spread` must be a number or have one entry for each of {', '.join(picked)}; got "
            f"shape {population.spread.shape}."
        )
    spread = jnp.broadcast_to(population.spread, (len(varies),))
    return Population(parameters, log_prior, varies, spread)
