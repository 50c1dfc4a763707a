"""Paths as smooth functions of parameters and normal noise.

The method is that of section 4 of van der Meulen & Schauer (2017). The path of a record is G_θ(ξ),
guided by all observations, with ξ ~ N(0, I) under the law of the guided paths. Hence (θ, ξ) has the
posterior density π(θ) N(ξ; 0, I) w(θ, ξ). The law of ξ does not depend on θ, and given ξ the path
changes with θ. So θ may contain parameters of σ, of the noise and of the initial law, for every
step size.
"""

import math
import warnings
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PyTree

from ..engine.checks import Numbers, is_traced
from ..engine.compiled import compiled
from ..engine.entry import public_entry
from ..engine.verdict import Fault, Verdict
from ..models.diffusion import Diffusion
from ..models.jumps import JumpsLike
from ..schemes import AbstractStepDensity
from .guide_search import GuideCheck
from .guided_record import guided, path_and_log_weight
from .initial import Initial
from .observations import AbstractObservation
from .several import Records, as_record_problems, linearisations
from .start_share import start_share

_NOT_FINITE = (
    "Paths of some noise ξ ~ N(0, I) have weight zero, because they diverged or left the state "
    "space. A sampler of ξ stops there, and means of weights are too small. Use more `num_steps`: "
    "explicit steps diverge if they are too long for the drift."
)
# Number of random ξ that `verdict` tries.
_NUM_TRIED = 10


class Innovations(NamedTuple):
    """Paths of one or several records as functions of noise ξ, from `innovations`.

    ξ has shape (`size`,): the noise of one record after the other, each as long as that of the
    longest. Methods may be passed directly to `jax.jit` and `jax.grad`.

    - `records`: the model, its records and the observation model.
    - `points`: the path of the linearisation of each record on the grid of all steps, shape
        (R, points, d).
    - `guide`: diagnostics of the guide along this path, of each record.
    """

    records: Records
    points: Float[Array, "R points d"]
    guide: GuideCheck

    @property
    def size(self) -> int:
        """Return the number of entries of ξ: d for x_0 and d for each step of each record."""
        return self.points.size

    @property
    def times(self) -> Any:
        """Return the times of the points of paths, shape (M + 1,); a list for a list of records.

        They are a NumPy array of double precision if the precision of paths cannot resolve them.
        """

        def of_record(number):
            record = self.records.problem(number).record
            return record.clock.exactly(record.grid()[record.stored])

        return self._of_each(of_record)

    def path(self, params: PyTree, xi: Float[Array, " size"]) -> Any:
        """Return the path of the noise `xi` at the parameters `params`.

        It has one point for each of `times`, shape (len(times), d). For several records it is a
        list of paths.
        """
        paths, stored = self._run(params, xi)[0], self.records.stacked.record.stored
        return self._of_each(lambda i: paths[i, stored[: self.records.num_points(i)]])

    def log_weight(self, params: PyTree, xi: Float[Array, " size"]) -> Float[Array, ""]:
        """Return log w(θ, ξ), summed over records.

        It is -inf if a path diverges or leaves the state space. The mean of w over ξ ~ N(0, I) is
        the likelihood.
        """
        return self._run(params, xi)[1]

    def log_density(self, params: PyTree, xi: Float[Array, " size"]) -> Float[Array, ""]:
        """Return the joint log density of ξ and the observations, given the parameters.

        The sum with a log prior is a target for any sampler.
        """
        return self.log_weight(params, xi) - (xi @ xi + self.size * math.log(2 * math.pi)) / 2

    def start_share(self) -> Float[Array, "*R"]:
        """Return the effective fraction of the draws of x_0 by normal noise, at `model.params`.

        A list of records has one entry per record. The fraction is 1 if the initial law is normal
        or a point. Near 0 the normal law in place of the stationary law misses a mode or has too
        light tails. Then means of w over ξ are unreliable, and a sampler may miss a mode.
        `log_likelihood` uses a mixture of normal laws instead.
        """
        model = self.records.stacked.model
        share = lambda problem, points: start_share(problem, model, points)
        return _unlisted(self.records, self.records.each(share, self.points))

    @property
    def verdict(self) -> Verdict:
        """Return the faults at the parameters of the model, each with a remedy.

        They are: a poor guide, and paths of weight zero for ξ = 0 or for one of ten random ξ.
        """
        params, dtype = self.records.stacked.model.params, self.points.dtype
        keys = jax.random.split(jax.random.key(0), _NUM_TRIED)
        tried = jax.vmap(lambda key: jax.random.normal(key, (self.size,), dtype))(keys)
        tried = jnp.concatenate([jnp.zeros_like(tried[:1]), tried])
        log_weights = jax.vmap(lambda xi: self.log_weight(params, xi))(tried)
        lost = jnp.any(log_weights == -jnp.inf)
        return Verdict((self.guide.fault(), Fault(lost, _NOT_FINITE)))

    @property
    def trustworthy(self) -> Bool[Array, ""]:
        """Return whether `verdict` has no fault."""
        return self.verdict.trustworthy

    def why(self) -> str:
        """Return the faults with their remedies, one per line; "No fault was found." without any.

        **Raises:** `TypeError` inside `jit`, because it needs concrete numbers.
        """
        return self.verdict.why()

    def _run(self, params: PyTree, xi) -> tuple[Float[Array, "R points d"], Float[Array, ""]]:
        return _paths_and_log_weight(self.records, self.points, params, xi)

    def _of_each(self, function: Callable[[int], Any]) -> Any:
        """Return `function(number)` of a record, or a list for a list of records."""
        values = list(map(function, range(self.records.number)))
        return values if self.records.are_listed else values[0]


@compiled
def _paths_and_log_weight(records: Records, points, params: PyTree, xi):
    model = records.stacked.model.with_params(params)

    def of_record(problem, points, xi):
        return path_and_log_weight(problem, model, guided(problem, model, points), xi)

    paths, log_weights = records.each(of_record, points, xi.reshape(points.shape))
    log_weight = jnp.sum(log_weights)
    # A path that diverged or left the state space has a weight that is not finite.
    return paths, jnp.where(jnp.isfinite(log_weight), log_weight, -jnp.inf)


def _unlisted(records: Records, tree: PyTree) -> PyTree:
    """Remove the leading axis, unless the records are a list."""
    return tree if records.are_listed else jax.tree.map(lambda leaf: leaf[0], tree)


@public_entry
def innovations(
    model: Diffusion,
    times: Numbers,
    observations: Numbers,
    *,
    observation: AbstractObservation,
    initial: Initial = None,
    num_steps: int | None = None,
    step_size: float | None = None,
    initial_time: Numbers | None = None,
    jumps: JumpsLike = None,
    density: AbstractStepDensity | None = None,
) -> Innovations:
    """Return the paths of one or several records as smooth functions of parameters and noise.

    The paths are guided by all observations. Use them with any sampler or optimiser.

    **Arguments:**

    - `model`: the diffusion. The guide is linearised once, at its `params`. Results at other
        parameters are exact, too, but the guide is best near these.
    - `times`: times of the observations, shape (n,), increasing, in the model's unit of time.
        - The origin of time does not matter, because differences are computed in double precision.
        - Time-dependent coefficients receive these times. Times so large that their precision
          cannot resolve a step then raise `ValueError`.
        - Traced times have neither this precision nor this check: subtract a constant from them.
    - `observations`: shape (n, m), or (n,) for one component. NaN or `None` marks a missing value.
    - Pass several independent records as lists of `times` and `observations`, or with a leading
        axis. They are lanes of one program.
    - `observation`: observation model, for instance a `LinearGaussian`, `PoissonCounts` or an
        `ObservationDensity`.
    - `initial`: law of the state at the first time, or a function of `params` that returns it:
        - a point, shape (d,);
        - a `GaussianLaw`, whose covariance may be singular if part of the state is known;
        - `Stationary()`, the default. Likelihoods then need a `normalised` model. If the stationary
          law is not normal, x_0 is drawn from the normal law with its mean and covariance, and
          weighted. This is exact, but check `start_share`.
    - `num_steps`, `step_size`: pass one of the two, the number of steps between two times, by
        default 10, or the maximum step size.
    - `initial_time`: time of `initial`, if it is before the first of `times`.
    - `jumps`: known jumps of the state, such as doses, as a `Jumps`; for several records also a
        list with one entry per record. An observation at the time of a jump is taken before it. A
        jump between two times splits the interval, and each part has `num_steps` steps.
    - `density`: step density. The default depends on the model:
        - linear drift and constant σ, not time-dependent: exact steps;
        - other models with constant σ: `ItoTaylorDensity()`;
        - σ with fewer columns than rows, state-dependent: `HypoellipticDensity()`;
        - invertible, state-dependent σ: steps of weak order 2, quadratic in the noise; above ten
          dimensions `EulerDensity()`. Quadratic steps that end at observations are split, so `size`
          is larger: 10 steps become 14, and 1 becomes 4. Paths still have the points of the 10.

    **Returns:** `Innovations`, differentiable in parameters and noise. Its `why()` reports faults
    of the guide. There is a warning if the likelihood at ξ = 0 is zero.

    **Raises:** `ValueError` and `TypeError` for invalid arguments.

    **Example:**

    ```python
    gaussian = jb.LinearGaussian(covariance=0.01)
    paths = jb.innovations(model, times, observations, observation=gaussian)
    value, slope = jax.value_and_grad(paths.log_density)(model.params, jnp.zeros(paths.size))
    ```
    """
    records = as_record_problems(
        model,
        times,
        observations,
        observation,
        initial,
        num_steps=num_steps,
        step_size=step_size,
        initial_time=initial_time,
        jumps=jumps,
        density=density,
    )
    points, check = linearisations(records, model)
    if not is_traced(check) and not np.all(check.is_usable):
        warnings.warn(
            "the likelihood at ξ = 0 and the model's parameters is zero, so no sampler can start "
            "there: see `why()` of the result.",
            stacklevel=3,  # the caller of the decorated function
        )
    return Innovations(records, points, _unlisted(records, check))
