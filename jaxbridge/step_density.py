"""The density of one step, from x to x' in δ: what a path's weight is made of.

The Euler scheme's is N(x'; x + α(x) δ, V(x) δ), with an error that adds up to O(δ) along a path.
For constant σ more is known. In the coordinates of the noise, β = σ⁻¹α and Δw = σ⁻¹(x' - x), the
step's density relative to that of σW is, by Girsanov's theorem in Stratonovich form, the mean
over Brownian bridges from x to x' of

    exp[∫ β · ∘dw - ½ ∫ (|β|² + div β) dt].

The trapezoid rule for ∫ β · ∘dw is too large by β''[Δw, Δw, Δw]/12, in the mean over steps by
δ/4 times the increment of div β, which with the trapezoid rule for the other integral leaves
½ div β(x') δ. Further, ∫ β · ∘dw has a part that the end points do not determine unless β is a
gradient: by Lévy's area formula, with Ω the antisymmetric part of ∇β, its exponential has a mean
of exp[δ²|Ω|²/12 + δ|ΩΔw|²/6] to leading order. What is left adds up to O(δ²). This is a density
up to terms of higher order only.
"""

from abc import abstractmethod
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from .diffusion import Dynamics
from .linalg import dot, matvec, total


class AbstractStepDensity(eqx.Module):
    """The density of a step, relative to that of the Euler scheme."""

    @abstractmethod
    def look(self, dynamics: Dynamics, x: Float[Array, " d"]) -> PyTree:
        """What must be known at each point of a path, once."""

    @abstractmethod
    def log_ratio(
        self,
        dynamics: Dynamics,
        x: Float[Array, " d"],
        x_next: Float[Array, " d"],
        seen: PyTree,
        seen_next: PyTree,
        dt: Float[Array, ""],
    ) -> Float[Array, ""]:
        """log [p(x'|x) / N(x'; x + α(x) δ, V(x) δ)], with what was seen at both points."""


class EulerDensity(AbstractStepDensity):
    """The transition density of the Euler scheme itself, for any σ: O(δ) along a path.

    **Example:**

    ```python
    proposal = jb.ModifiedDiffusionBridge(density=jb.EulerDensity())  # the default
    ```
    """

    def look(self, dynamics, x):
        return None

    def log_ratio(self, dynamics, x, x_next, seen, seen_next, dt):
        return jnp.zeros((), x.dtype)


class _Field(NamedTuple):
    """β, its divergence, and Ω, at one point; no Ω in one dimension."""

    beta: Float[Array, " d"]
    divergence: Float[Array, ""]
    curl: Float[Array, "d d"] | None


class TrapezoidDensity(AbstractStepDensity):
    """The trapezoid rule in Girsanov's theorem, for constant σ: O(δ²) along a path.

    It calls for the drift's derivatives at each point, by autodiff.

    **Raises:** `ValueError`, when it is used, for a σ that depends on the state.

    **Example:**

    ```python
    proposal = jb.Guided(density=jb.TrapezoidDensity())
    ```
    """

    def look(self, dynamics, x):
        if dynamics.sigma_varies:
            raise ValueError(
                "`TrapezoidDensity` is for constant σ, but this one depends on the state: choose "
                "`EulerDensity()`."
            )
        sigma, d = dynamics.sigma(x), x.shape[0]

        def beta(y):
            return sigma.solve(dynamics.drift(y))

        # Derivatives in the coordinates of the noise: columns of ∇β σ.
        along = [sigma.mv(jnp.asarray(direction, x.dtype)) for direction in np.eye(d)]
        value, slope = jax.linearize(beta, x)
        columns = [slope(direction) for direction in along]
        divergence = total(jnp.stack([columns[i][i] for i in range(d)]))
        curl = None
        if d > 1:
            jacobian = jnp.stack(columns, axis=1)
            curl = (jacobian - jacobian.T) / 2
        return _Field(value, divergence, curl)

    def log_ratio(self, dynamics, x, x_next, seen, seen_next, dt):
        change = seen_next.beta - seen.beta
        dw = dynamics.sigma(x).solve(x_next - x)
        noise = dw - dt * (seen.beta + seen_next.beta) / 2
        ratio = dot(change, noise) / 2 - dt * seen_next.divergence / 2
        if seen.curl is not None:
            turned, square = matvec(seen.curl, dw), total((seen.curl**2).ravel())
            ratio += dt**2 * square / 12 + dt * dot(turned, turned) / 6
        return ratio
