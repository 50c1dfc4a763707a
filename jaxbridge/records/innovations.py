"""Paths as smooth functions of parameters and normal noise (section 4 of van der Meulen & Schauer
2017: the noise does not know the parameters).

The path of a record is G_θ(ξ), guided by all that was seen, with ξ ~ N(0, I) under the law of the
guided paths; so (θ, ξ) has the posterior density π(θ) N(ξ; 0, I) w(θ, ξ). Given ξ the path moves
with θ, and θ may be a parameter of σ, of the noise or of the initial law, however small the steps.
"""

import math
import warnings
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PyTree

from ..engine.checks import Numbers, is_traced
from ..engine.compiled import compiled
from ..engine.doors import door
from ..engine.verdict import Fault, Verdict
from ..models.diffusion import Diffusion
from ..schemes import AbstractStepDensity
from .guide_search import GuideCheck, linearised
from .guided_record import guided, path_and_log_weight
from .initial import Initial
from .observation import Observation
from .problem import RecordProblem, as_record_problem
from .start_share import start_share

_NOT_FINITE = (
    "Paths of some noise ξ ~ N(0, I) have no weight: they left the finite numbers or the state "
    "space. A sampler of ξ stops there, and means of weights miss their mass. Take more "
    "`num_steps`: explicit steps explode where they are long for the drift."
)
# So many draws of ξ are tried.
_NUM_TRIED = 10


class Innovations(NamedTuple):
    """Paths of a record as functions of noise ξ, shape (`size`,), from `innovations`. Its methods
    may be given to `jax.jit` and `jax.grad` as they are.

    - `problem`: the model, what was seen of it, and how.
    - `points`: along which it is linearised, shape (M + 1, d).
    - `guide`: diagnostics of the guide along these points.
    """

    problem: RecordProblem
    points: Float[Array, "points d"]
    guide: GuideCheck

    @property
    def size(self) -> int:
        """How many numbers ξ has: d for x_0, and d for each step."""
        return self.points.size

    @property
    def times(self) -> Float[Array | np.ndarray, " points"]:
        """Times of the points of paths, shape (M + 1,); a NumPy array of double precision where
        they are too far from zero for the precision of paths."""
        record = self.problem.record
        return record.clock.exactly(record.grid())

    def path(self, params: PyTree, xi: Float[Array, " size"]) -> Float[Array, "points d"]:
        """The path that this noise makes at these parameters of the model."""
        return self._run(params, xi)[0]

    def log_weight(self, params: PyTree, xi: Float[Array, " size"]) -> Float[Array, ""]:
        """log w, whose mean of w over ξ ~ N(0, I) is the likelihood; -∞ of a path that left the
        state space."""
        return self._run(params, xi)[1]

    def log_density(self, params: PyTree, xi: Float[Array, " size"]) -> Float[Array, ""]:
        """log of the joint density of ξ and of what was seen, given the parameters: with a prior's
        log density it is the target of any sampler."""
        return self.log_weight(params, xi) - (xi @ xi + self.size * math.log(2 * math.pi)) / 2

    def start_share(self) -> Float[Array, ""]:
        """The share of draws of x_0 by normal noise that count, at the parameters of the model: one
        where its law is normal. Near zero the normal law in the place of the stationary one leaves
        out a mode or falls off too fast: then means of w over ξ are not to be trusted, and a
        sampler may not find its way; `log_likelihood` covers that law with several."""
        return start_share(self.problem, self.problem.model, self.points)

    @property
    def verdict(self) -> Verdict:
        """Return the faults at the parameters of the model: a poor guide, and paths without a
        weight for ξ = 0 or one of ten random ξ."""
        params, dtype = self.problem.model.params, self.points.dtype
        keys = jax.random.split(jax.random.key(0), _NUM_TRIED)
        tried = jax.vmap(lambda key: jax.random.normal(key, (self.size,), dtype))(keys)
        tried = jnp.concatenate([jnp.zeros_like(tried[:1]), tried])
        log_weights = jax.vmap(lambda xi: self.log_weight(params, xi))(tried)
        lost = jnp.any(log_weights == -jnp.inf)
        return Verdict((self.guide.fault(), Fault(lost, _NOT_FINITE)))

    @property
    def trustworthy(self) -> Bool[Array, ""]:
        """Return whether no fault of `verdict` is present."""
        return self.verdict.trustworthy

    def why(self) -> str:
        """Return each fault with its remedy, one a line.

        **Raises:** `TypeError` inside `jit`, where the numbers are not known yet.
        """
        return self.verdict.why()

    def _run(self, params: PyTree, xi) -> tuple[Float[Array, "points d"], Float[Array, ""]]:
        return _path_and_log_weight(self.problem, self.points, params, xi)


@compiled
def _path_and_log_weight(problem: RecordProblem, points, params: PyTree, xi):
    model = problem.model.with_params(params)
    guide = guided(problem, model, points)
    path, log_weight = path_and_log_weight(problem, model, guide, xi.reshape(points.shape))
    return path, jnp.where(jnp.isfinite(log_weight), log_weight, -jnp.inf)


@door
def innovations(
    model: Diffusion,
    times: Numbers,
    observations: Numbers,
    *,
    observation: Observation,
    initial: Initial = None,
    num_steps: int | None = None,
    step_size: float | None = None,
    initial_time: Numbers | None = None,
    density: AbstractStepDensity | None = None,
) -> Innovations:
    """The paths of a record as smooth functions of parameters and noise, guided by what was seen.

    **Arguments:**

    - `model`: along its paths at its `params` the guide is linearised, once: what is made at other
        parameters is as exact, but guided best near these.
    - `times`: of the observations, shape (n,), increasing numbers in the model's unit of time.
        Their zero does not matter: differences are taken in double precision. Coefficients that
        depend on time get these times; where single precision cannot resolve them beside a step,
        that is refused. Of traced times neither is possible: subtract a constant from them.
    - `observations`: shape (n, m), or (n,) of one component; NaN or `None` where a component was
        not seen.
    - `observation`: how the state was seen, a `LinearGaussian` or an `ObservationDensity`.
    - `initial`: the law of the state at the first time: a point, shape (d,), a `GaussianLaw`,
        whose covariance is singular where part of the state is known, `Stationary()`, which is the
        default, or a function of params to one of these. Likelihoods from the stationary law rest
        on a `normalised` model. Where that is not normal x_0 is made from noise by the normal law
        with its mean and covariance, and weighed: exact, but see `start_share`.
    - `num_steps`: steps between two times, by default 10; or `step_size`, how long a step may be.
    - `initial_time`: of `initial`, where that is before the first of `times`.
    - `density`: of the steps, by default `ItoTaylorDensity()` for constant σ, else
        `EulerDensity()`, or `HypoellipticDensity()` where σ has fewer columns than rows.

    **Returns:** `Innovations`, differentiable in parameters and noise. Its `why()` names what is
    wrong with the guide; there is a warning where the likelihood at ξ = 0 is zero.

    **Raises:** `ValueError` and `TypeError` for arguments that do not fit.

    **Example:**

    ```python
    seen = jb.LinearGaussian(covariance=0.01)
    paths = jb.innovations(model, times, observations, observation=seen)
    value, slope = jax.value_and_grad(paths.log_density)(model.params, jnp.zeros(paths.size))
    ```
    """
    problem = as_record_problem(
        model,
        times,
        observations,
        observation,
        initial,
        num_steps=num_steps,
        step_size=step_size,
        initial_time=initial_time,
        density=density,
    )
    points, _, check = linearised(problem, model)
    if not is_traced(check) and not check.is_usable:
        warnings.warn(
            "the likelihood at ξ = 0 and the model's parameters is zero, so that no sampler can "
            "start there: see `why()` of the result.",
            stacklevel=3,
        )
    return Innovations(problem, points, check)
