"""Where the associated diffusion starts (section 2.3 of the paper, corrected).

Take X with X_0 ~ ν, X' from a driven by X, and exchange the two where they meet: by the strong
Markov property (Z, Y) has the law of (X', X). So Y, the diffusion associated with Z, starts
from the stationary density ν, independently of Z, and the proposals have the density
`f_br(z) π_ν(z) / π` with π_ν(z) the probability that it hits z. (The paper starts it from
p*_T(b, ·), the law of X_0 given X_T = b; but what is conditioned on is Z_T = b, and Z does not
depend on X_0.)

Another start law μ is exact too if it is paid for. With x_0 the time-0 value of the reversed
path in the proposal, which has the density p*_T(b, ·) = ν(·) p_T(·, b) / ν(b),

    E[1{met} · ν(b)/ν(x_0) · μ(x_0) / π_μ(Z) · h(Z)] = p_T(a, b) E_bridge[h].

It needs μ = 0 wherever ν = 0, π_μ > 0 and, for a finite variance, about ∫ μ²/ν < ∞.
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
from ..engine.keys import folded
from ..engine.noise import noisy_scan
from ..models.diffusion import Diffusion, check_value
from ..models.dynamics import Dynamics
from ..models.gaussian_law import GaussianLaw
from ..schemes import AbstractScheme, steps_in_lanes

# No run that replaces a sampler of ν takes more steps than this.
MOST_STEPS = 2**18


@runtime_checkable
class StartLaw(Protocol):
    """Any law with a sampler and a normalised density; `GaussianLaw` is one.

    Make it an `equinox.Module` with arrays as its fields. Any other object serves too, but is
    read once, when a program is compiled for it: later changes of its attributes are not seen.
    """

    def sample(self, key: Key[Array, ""], model: Diffusion) -> Float[Array, " d"]:
        """One draw, shape (d,)."""
        ...

    def log_density(self, x: Float[Array, " d"]) -> Float[Array, ""]:
        """The log density at a point, shape (d,)."""
        ...


class Stationary(eqx.Module):
    """The stationary density ν: the corrected theorem's own start law, and the best one where
    the end points are likely.

    Draws come from the model's sampler. For a model without one, but with a density, weights and
    chains start from 512 draws, smoothed: a law with a density of its own, near ν, with which
    bridges are as exact. It is in their `proposal`.

    With a `burn_in`, and where ν itself is called for, as in `hitting_counts`, such a model is run:
    the reversed diffusion starts at b and is taken after so many units of time, afresh for every
    draw. By default that time is measured, as `measure_burn_in` does, and infinite where none was
    found. A run takes no more than 2¹⁸ steps; where it should have taken more what was counted or
    weighed is marked as `truncated`. What the start weighs after the run is less than 1e-5 for a
    diffusion that forgets exponentially fast, but may be 2e-3 for one with heavy tails.

    **Raises:** `ValueError` for a `burn_in` that is not a positive time, shape ().

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
            raise ValueError(f"`burn_in` must be a positive time, shape (); got {burn_in}.")


class Reversed(eqx.Module):
    """p*_T(b, ·), the law of the time-reversed diffusion from b after the whole duration, as
    the paper prints it. It does **not** give the exact law: for comparisons only.

    **Example:**

    ```python
    coupling = jb.Coupling(0.5, start_law=jb.Reversed())
    ```
    """


class _Identity:
    """An object that equals itself only."""

    def __init__(self, value: Any):
        self.value = value

    def __eq__(self, other):
        return isinstance(other, _Identity) and other.value is self.value

    def __hash__(self):
        return id(self.value)


class Opaque(eqx.Module):
    """A start law that is not made of arrays, kept out of the sight of JAX: what it does is
    read once, when a program is compiled for it."""

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
    """A method of an object, equal for the same object."""

    law: _Identity
    name: str

    def __call__(self, *args):
        return getattr(self.law.value, self.name)(*args)


AnyStartLaw = Stationary | Reversed | StartLaw


def as_start_law(law: Any) -> AnyStartLaw:
    """The law itself, if it is one, as a pytree of arrays."""
    if isinstance(law, type):
        raise TypeError(f"`start_law` must be an object, not a class: write `{law.__name__}(...)`.")
    if not isinstance(law, Stationary | Reversed | StartLaw):
        raise TypeError(
            "`start_law` must be `Stationary()`, `GaussianLaw(mean, covariance)`, `Reversed()`, or "
            f"an object with `sample(key, model)` and `log_density(x)`; got {law!r}."
        )
    if isinstance(law, GaussianLaw) and not is_traced(law):
        matrix = np.asarray(law.covariance, float)
        if not (np.all(np.isfinite(law.mean)) and np.linalg.eigvalsh(matrix).min() > 0):
            raise ValueError(
                "`start_law` must have a finite mean and a positive definite covariance; got "
                f"{law.mean} and {law.covariance}."
            )
    if not all(eqx.is_array_like(leaf) for leaf in jax.tree.leaves(law)):
        return Opaque(law)
    return jax.tree.map(jnp.asarray, law)  # numbers are traced, so that they may change


def log_ratio(law: AnyStartLaw, model: Diffusion, x: Float[Array, " d"]) -> Float[Array, ""]:
    """log (μ/ν)(x), up to the constant of ν; zero for `Stationary`, and taken to be zero for
    `Reversed`, as printed."""
    if isinstance(law, Stationary | Reversed):
        return jnp.zeros((), x.dtype)
    log_density = check_value("log_density", cast_floats(law, x.dtype).log_density(x), (), x)
    return log_density - model.log_stationary(x)


def needs_burn_in(law: AnyStartLaw, model: Diffusion) -> bool:
    """Whether ν must be sampled by a run whose length is not known."""
    return isinstance(law, Stationary) and law.burn_in is None and not model.has_sampler


def run_is_cut(
    law: AnyStartLaw, model: Diffusion, dt: Float[Array, " lanes"], num_steps: int
) -> Bool[Array, " lanes"]:
    """Where the run that replaces a sampler of ν would have to be longer than it may be, so that
    its end does not have the law ν: always if the burn-in is infinite, for it is not known."""
    if not isinstance(law, Stationary) or law.burn_in is None or model.has_sampler:
        return jnp.zeros(dt.shape, bool)
    longest = (MOST_STEPS // num_steps) * num_steps * dt
    return ~(law.burn_in.astype(dt.dtype) <= longest * (1 + 1e-4))  # of rounding


def draw_starts(
    law: AnyStartLaw,
    model: Diffusion,
    scheme: AbstractScheme,
    keys: Key[Array, " lanes"],
    end: Float[Array, "d lanes"],
    dt: Float[Array, " lanes"],
    num_steps: int,
) -> Float[Array, "d lanes"]:
    """A draw from the law in each lane."""
    if isinstance(law, Stationary) and not model.has_sampler:
        assert law.burn_in is not None
        repeats = jnp.ceil(law.burn_in.astype(dt.dtype) / (num_steps * dt))
        repeats = jnp.minimum(repeats, MOST_STEPS // num_steps).astype(jnp.int32)
        return run_for(model.backward(end[:, 0]), scheme, keys, end, dt, num_steps, repeats)
    if isinstance(law, Reversed):
        once = jnp.ones(dt.shape, jnp.int32)
        return run_for(model.backward(end[:, 0]), scheme, keys, end, dt, num_steps, once)
    if isinstance(law, Stationary):
        draws = jax.vmap(model.sample_stationary)(keys)
    else:
        draws = jax.vmap(lambda key: evaluated("start_law", law.sample, key, model))(keys)
    if draws.shape[1:] != end.shape[:1]:
        raise ValueError(
            f"`start_law` must give points of shape {end.shape[:1]}, as the end points are; it "
            f"gave {draws.shape[1:]}."
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
    """The state after `repeats` times `num_steps` steps, in each lane."""
    step = steps_in_lanes(scheme, dynamics, x[:, 0], dt)

    def once(repeat, x):
        end, _ = noisy_scan(
            lambda x, inputs: (step(x, inputs[0]), None),
            x,
            folded(keys, repeat),
            lambda key, k: jax.random.normal(key, (k, x.shape[0]), x.dtype),
            None,
            num_steps,
        )
        return jnp.where(repeat < repeats, end, x)

    return lax.fori_loop(0, jnp.max(repeats), once, x)
