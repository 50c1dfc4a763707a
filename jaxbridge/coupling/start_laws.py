"""Start laws: the law of the initial state of the associated diffusion (section 2.3, corrected).

Take X with X_0 ~ ν, and X' from a driven by X. Exchange the two where they meet. By the strong
Markov property the exchanged pair (Z, Y) has the law of (X', X). So Y, the diffusion associated
with Z, starts from the stationary density ν, independently of Z. The proposals have the density
`f_br(z) π_ν(z) / π`, where π_ν(z) is the probability that Y hits z.

The paper starts Y from p*_T(b, ·), the law of X_0 given X_T = b. But the condition is Z_T = b, and
Z does not depend on X_0.

Another start law μ is exact too, with a factor in the weight. Let x_0 be the value of the reversed
path at time 0 in the proposal. Its density is p*_T(b, ·) = ν(·) p_T(·, b) / ν(b). Then

    E[1{met} · ν(b)/ν(x_0) · μ(x_0) / π_μ(Z) · h(Z)] = p_T(a, b) E_bridge[h].

Conditions: μ = 0 wherever ν = 0, and π_μ > 0. A finite variance needs about ∫ μ²/ν < ∞.
"""

from typing import Any, NamedTuple, Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int, Key

from ..engine.arguments import evaluated
from ..engine.captured import Captured
from ..engine.checks import Numbers, as_floating, cast_floats, is_traced
from ..engine.keys import fold_in_each
from ..engine.noise import noisy_scan
from ..models.diffusion import Diffusion, check_value
from ..models.dynamics import Dynamics
from ..models.gaussian_law import GaussianLaw
from ..schemes import AbstractScheme, steps_in_lanes

# Bound on the steps of a run that replaces a sampler of ν.
MOST_STEPS = 2**18


@runtime_checkable
class StartLaw(Protocol):
    """Interface of start laws: a sampler and a normalised density; `GaussianLaw` has both.

    Use an `equinox.Module` with arrays as fields. Any other object works too, but compilation reads
    it once: later changes of its attributes have no effect.
    """

    def sample(self, key: Key[Array, ""], model: Diffusion) -> Float[Array, " d"]:
        """Return one draw, shape (d,). `model` is the diffusion, for laws that depend on it."""
        ...

    def log_density(self, x: Float[Array, " d"]) -> Float[Array, ""]:
        """Return the log density at one point, shape (d,)."""
        ...


class Stationary(eqx.Module):
    """The stationary density ν as start law: the law of the corrected theorem.

    It is the best start law for likely end points. The way to sample from ν depends on the model:

    - A model with a sampler of ν: draws come from the sampler.
    - A model with a density but without sampler, and no `burn_in`: weights and chains replace ν by
        a start law fitted to 512 draws. This law has a density of its own, near ν, and the bridges
        are as exact. The `proposal` of a result contains it. Kernels such as `pseudo_marginal` need
        a `burn_in` instead.
    - Other models without sampler; also if `burn_in` is set, or if ν itself is needed, as in
        `hitting_counts`: each draw is the end of a new run of the reversed diffusion, from b and of
        length `burn_in`.

    By default the burn-in is measured as in `measure_burn_in`, and is infinite if no time is found.
    A run takes at most 2¹⁸ steps. If a run for each draw would be shorter than the burn-in, results
    are marked as `truncated`. The remaining distance to ν, in total variation, is about 1e-5 under
    exponential mixing, but may be 2e-3 for heavy-tailed laws.

    **Arguments:**

    - `burn_in`: length of a run in units of time, shape (), or `None` (default).

    **Raises:** `ValueError` for a `burn_in` that is not a positive finite time, shape ().

    **Example:**

    ```python
    coupling = jb.Coupling(0.5, start_law=jb.Stationary(burn_in=20.0))
    ```
    """

    burn_in: Float[Array, ""] | None = None

    def __init__(self, burn_in: Numbers | None = None):
        self.burn_in = None if burn_in is None else as_floating("burn_in", burn_in)
        if burn_in is None or is_traced(self.burn_in):
            return
        value = np.asarray(self.burn_in)
        if value.shape != () or not value > 0 or not np.isfinite(value):
            raise ValueError(f"`burn_in` must be a positive finite time, shape (); got {burn_in}.")


class Reversed(eqx.Module):
    """The start law p*_T(b, ·) as printed in the paper. For comparisons only.

    It is the law of the time-reversed diffusion, started at b, after the whole duration. Weights
    with this start law do **not** give the exact law.

    **Example:**

    ```python
    coupling = jb.Coupling(0.5, start_law=jb.Reversed())
    ```
    """


class _Identity:
    """Wrapper that compares an object by identity."""

    def __init__(self, value: Any):
        self.value = value

    def __eq__(self, other):
        return isinstance(other, _Identity) and other.value is self.value

    def __hash__(self):
        return id(self.value)


class Opaque(eqx.Module):
    """Wrapper for a start law with fields that are not arrays.

    The law is static for JAX: changes after compilation have no effect.
    """

    _sample: "_Method" = eqx.field(static=True)
    _log_density: "_Method" = eqx.field(static=True)
    _captured: Captured

    def __init__(self, law: Any):
        self._sample = _Method(_Identity(law), "sample")
        self._log_density = _Method(_Identity(law), "log_density")
        self._captured = Captured(self._sample, self._log_density)

    def sample(self, key, model):
        return self._captured.call(self._sample, key, model)

    def log_density(self, x):
        return self._captured.call(self._log_density, x)


class _Method(NamedTuple):
    """A method of an object, equal to the same method of the same object."""

    law: _Identity
    name: str

    def __call__(self, *args):
        return getattr(self.law.value, self.name)(*args)


AnyStartLaw = Stationary | Reversed | StartLaw


def as_start_law(law: Any) -> AnyStartLaw:
    """Check a start law. Return it as a pytree of arrays.

    **Raises:** `TypeError` if `law` is not a start law; `ValueError` for a `GaussianLaw` without a
    finite mean and a positive definite covariance.
    """
    if isinstance(law, type):
        raise TypeError(
            f"`start_law` must be an object, not a class; got {law!r}. Pass `{law.__name__}(...)`."
        )
    if not isinstance(law, Stationary | Reversed | StartLaw):
        raise TypeError(
            "`start_law` must be `Stationary()`, `GaussianLaw(mean, covariance)`, `Reversed()`, or "
            f"an object with `sample(key, model)` and `log_density(x)`; got {law!r}."
        )
    # `GaussianLaw` accepts degenerate laws, which have no density.
    if isinstance(law, GaussianLaw) and not is_traced(law):
        matrix = np.asarray(law.covariance, float)
        if not (np.all(np.isfinite(law.mean)) and np.linalg.eigvalsh(matrix).min() > 0):
            raise ValueError(
                "`start_law` must have a finite mean and a positive definite covariance; got "
                f"{law.mean} and {law.covariance}."
            )
    if not all(eqx.is_array_like(leaf) for leaf in jax.tree.leaves(law)):
        return Opaque(law)
    # As arrays, numbers may change without a new compilation.
    return jax.tree.map(jnp.asarray, law)


def log_ratio(law: AnyStartLaw, model: Diffusion, x: Float[Array, " d"]) -> Float[Array, ""]:
    """Return log (μ/ν)(x), shape (), up to the constant of ν.

    It is zero for `Stationary`. For `Reversed` it is set to zero, as in the paper's algorithm.
    """
    if isinstance(law, Stationary | Reversed):
        return jnp.zeros((), x.dtype)
    log_density = check_value("log_density", cast_floats(law, x.dtype).log_density(x), (), x)
    return log_density - model.log_stationary(x)


def needs_burn_in(law: AnyStartLaw, model: Diffusion) -> bool:
    """Return whether the burn-in must be measured.

    It must for `Stationary()` without `burn_in`, if the model has no sampler of ν.
    """
    return isinstance(law, Stationary) and law.burn_in is None and not model.has_sampler


def run_is_cut(
    law: AnyStartLaw, model: Diffusion, dt: Float[Array, " lanes"], num_steps: int
) -> Bool[Array, " lanes"]:
    """Return, for each lane, whether the run that replaces a sampler of ν ends before the burn-in.

    Then the end of the run does not have the law ν. The result is true for an infinite burn-in,
    which stands for an unknown one.
    """
    if not isinstance(law, Stationary) or law.burn_in is None or model.has_sampler:
        return jnp.zeros(dt.shape, bool)
    # Runs consist of whole repeats of `num_steps` steps.
    longest = (MOST_STEPS // num_steps) * num_steps * dt
    return ~(law.burn_in.astype(dt.dtype) <= longest * (1 + 1e-4))  # allow for rounding


def draw_starts(
    law: AnyStartLaw,
    model: Diffusion,
    scheme: AbstractScheme,
    keys: Key[Array, " lanes"],
    end: Float[Array, "d lanes"],
    dt: Float[Array, " lanes"],
    num_steps: int,
) -> Float[Array, "d lanes"]:
    """Sample one start from the law in each lane."""
    if isinstance(law, Stationary) and not model.has_sampler:
        # `with_burn_in` has set it before any program starts.
        assert law.burn_in is not None
        repeats = jnp.ceil(law.burn_in.astype(dt.dtype) / (num_steps * dt))
        repeats = jnp.minimum(repeats, MOST_STEPS // num_steps).astype(jnp.int32)
        return run_for(model.backward(end[:, 0]), scheme, keys, end, dt, num_steps, repeats)
    if isinstance(law, Reversed):
        one_run = jnp.ones(dt.shape, jnp.int32)
        return run_for(model.backward(end[:, 0]), scheme, keys, end, dt, num_steps, one_run)
    if isinstance(law, Stationary):
        draws = jax.vmap(model.sample_stationary)(keys)
    else:
        draws = jax.vmap(lambda key: evaluated("start_law", law.sample, key, model))(keys)
    if draws.shape[1:] != end.shape[:1]:
        raise ValueError(
            f"`start_law` must give points of shape {end.shape[:1]}, the shape of the end points; "
            f"got points of shape {draws.shape[1:]}. Pass a start law of the same dimension."
        )
    return draws.T.astype(end.dtype)


def run_for(
    dynamics: Dynamics,
    scheme: AbstractScheme,
    keys: Key[Array, " lanes"],
    x: Float[Array, "d lanes"],
    dt: Float[Array, " lanes"],
    num_steps: int,
    repeats: Int[Array, " lanes"],
) -> Float[Array, "d lanes"]:
    """Simulate `repeats` times `num_steps` steps in each lane. Return the last states."""
    step = steps_in_lanes(scheme, dynamics, x[:, 0], dt)

    def run_once(repeat, x):
        end, _ = noisy_scan(
            lambda x, inputs: (step(x, inputs[0]), None),
            x,
            fold_in_each(keys, repeat),
            lambda key, k: jax.random.normal(key, (k, x.shape[0]), x.dtype),
            None,
            num_steps,
        )
        return jnp.where(repeat < repeats, end, x)  # lanes with fewer repeats stop here

    return lax.fori_loop(0, jnp.max(repeats), run_once, x)
