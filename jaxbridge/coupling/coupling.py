"""Couplings: how the noise of one copy of the diffusion is made from that of the other.

The paper's γ-coupling (section 2.1) drives X' by

    dW' = {I - (1-γ)Π} O dW + √(1-γ²) u dU,    Π = uuᵀ,  u ∝ σ(x')⁻¹(x - x'),

and read in the other direction, for the associated diffusion, equation (stjerne-dif),

    dW = Oᵀ [{I - (1-γ)Π} dW' + √(1-γ²) u dU'].

u is built with σ(x') in both directions, x' being the state of X', and in discrete time from the
gap when the noise of the step sets in (`meeting`, `see`). The rotation O(x, x')
belongs to the pair, not to the coupling's geometry: a coupling sees the noise of X after O
has turned it, so one O serves both directions.
"""

from abc import abstractmethod
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Key

from ..engine.checks import as_floating, is_traced
from ..engine.linalg import dot, matmul, matvec, polar_factor
from ..models import decisions
from ..models.diffusion import Dynamics
from ..models.sigma import AbstractSigma, Full
from ..schemes.base import AbstractScheme
from ..schemes.euler import Euler
from ..schemes.frame import Frame, frame
from ..schemes.heun import Heun
from .meeting import AbstractMeeting, BrownianCrossing, ReflectionPlane, SignTest
from .start_laws import AnyStartLaw, Reversed, Stationary, as_start_law

Rotation = Callable[[Float[Array, "d d"], Float[Array, "d d"]], Float[Array, "d d"] | None]


def polar_rotation(sigma: Float[Array, "d d"], driven_sigma: Float[Array, "d d"]):
    """O(x, x'), the orthogonal matrix closest to σ(x')ᵀσ(x), so that σ(x')O ≈ σ(x).

    `sigma` is σ(x), `driven_sigma` σ(x'), shape (d, d). The paper prints its transpose,
    `published_rotation`.

    **Example:**

    ```python
    coupling = jb.Coupling(0.5, rotation=jb.polar_rotation)
    ```
    """
    return polar_factor(matmul(driven_sigma.T, sigma))


def no_rotation(sigma: Float[Array, "d d"], driven_sigma: Float[Array, "d d"]):
    """O = I: as exact as any other rotation, but σ(x) and σ(x') may point elsewhere.

    `sigma` is σ(x), `driven_sigma` σ(x'), shape (d, d).

    **Example:**

    ```python
    coupling = jb.Coupling(0.5, rotation=jb.no_rotation)
    ```
    """
    return None


def published_rotation(sigma: Float[Array, "d d"], driven_sigma: Float[Array, "d d"]):
    """The orthogonal factor of σ(x)ᵀσ(x') as printed in the paper: the transpose of the
    rotation that aligns the two, so it turns the wrong way. For comparisons.

    `sigma` is σ(x), `driven_sigma` σ(x'), shape (d, d).

    **Example:**

    ```python
    coupling = jb.Coupling(0.5, rotation=jb.published_rotation)
    ```
    """
    return polar_factor(matmul(sigma.T, driven_sigma))


class AbstractCoupling(eqx.Module):
    """A coupling is two maps of noise increments, and how the pair is stepped and joined.

    Both maps act on one point: `dw`, shape (d,), is the noise of X, already turned by O;
    `driven_dw` that of X'; `du` an independent N(0, δ) increment, or `None` where
    `independent_noise` is false, in which case none is drawn. Each map must turn N(0, δ I)
    noise into N(0, δ I) noise, and the two must be the two conditional laws of one joint law.

    Fields are arrays, or static: bridges carry their coupling with them out of `jit`.

    Write another coupling by subclassing. Synchronous up to a distance, then reflection:

    ```python
    import equinox as eqx
    import jax.numpy as jnp
    import jaxbridge as jb

    class SynchronousThenReflection(jb.AbstractCoupling):
        distance: float = 1.0
        meeting: jb.AbstractMeeting = jb.BrownianCrossing()
        scheme: jb.AbstractScheme = jb.Heun()
        start_law: jb.Stationary = jb.Stationary()
        rotation: object = eqx.field(default=None, static=True)
        independent_noise = False

        def driven_noise(self, frame, dw, du):
            mirrored = dw - 2 * frame.u * (frame.u @ dw)
            return jnp.where(frame.gap > self.distance, dw, mirrored)

        def driving_noise(self, frame, driven_dw, du):
            return self.driven_noise(frame, driven_dw, du)  # its own inverse

        def gap_variance(self, frame):
            return jnp.where(frame.gap > self.distance, 0.0, 4.0)

        def realise(self, keys):
            return self
    ```
    """

    meeting: eqx.AbstractVar[AbstractMeeting]
    scheme: eqx.AbstractVar[AbstractScheme]
    start_law: eqx.AbstractVar[AnyStartLaw]
    rotation: eqx.AbstractVar[Rotation | None]
    independent_noise: eqx.AbstractVar[bool]

    @abstractmethod
    def driven_noise(
        self, frame: Frame, dw: Float[Array, " d"], du: Float[Array, ""] | None
    ) -> Float[Array, " d"]:
        """ΔW' of the driven X', from ΔW."""

    @abstractmethod
    def driving_noise(
        self, frame: Frame, driven_dw: Float[Array, " d"], du: Float[Array, ""] | None
    ) -> Float[Array, " d"]:
        """ΔW of X, from ΔW': the same joint law read in the other direction."""

    @abstractmethod
    def gap_variance(self, frame: Frame) -> Float[Array, ""]:
        """The variance per unit of time of `uᵀ(dW - dW')`."""

    @abstractmethod
    def realise(self, keys: Key[Array, " lanes"]) -> "AbstractCoupling":
        """The coupling of each of many proposals: arrays drawn at random get a trailing axis
        of lanes. A coupling without randomness of its own returns itself."""


def see(
    coupling: AbstractCoupling,
    scheme: AbstractScheme,
    dynamics: Dynamics,
    x: Float[Array, " d"],
    driven: Float[Array, " d"],
    dt: Float[Array, ""],
) -> Frame:
    """How the pair lies at the beginning of a step, as the meeting rule wants it seen; `scheme` is
    the coupling's, fitted to the step."""
    if coupling.meeting.looks_ahead:
        return scheme.frame(dynamics, x, driven, dt)
    return frame(dynamics.sigma(driven), x, driven)


class Coupling(AbstractCoupling):
    """The γ-coupling of section 2.1 of the paper.

    γ = -1 is reflection (Lindvall & Rogers 1986), γ = 0 projection (Chen & Li 1989), which in
    one dimension makes X' independent of X: the method of Bladt & Sørensen (2014). As γ → 1
    the two share more of their noise and meet more rarely, but a joined path is closer to a
    bridge.

    **Arguments:**

    - `gamma`: γ in [-1, 1); or a law, a function `key -> γ`, from which each proposal draws
        its own. Pairs whose γ is out of that range, which only a law or a traced value can be,
        never meet, and are counted in `num_nonfinite`.
    - `meeting`: `BrownianCrossing()`, `SignTest(radius)` or, for γ = -1, `ReflectionPlane()`.
    - `scheme`: `Heun()`, `Euler()`, `Milstein()`, for stiff or superlinear drift
        `SemiImplicit()`, for linear drift `GaussianTransition()`.
    - `rotation`: O(x, x') from the matrices σ(x), σ(x'); `None` is `polar_rotation` where σ is
        a full matrix that depends on the state, and nothing elsewhere.
    - `start_law`: μ, where the associated diffusion starts, which only what corrects bridges to
        their exact law makes use of: `Stationary()`, `GaussianLaw(mean, covariance)`, or any
        object with `sample(key, model)` and a normalised `log_density(x)`; see `fit_start_law`.

    **Raises:** `ValueError` for γ outside [-1, 1) or `ReflectionPlane` with γ ≠ -1; `TypeError`
    for a meeting rule, a scheme or a start law that is none.

    **Example:**

    ```python
    coupling = jb.Coupling(0.5, scheme=jb.Euler())
    bridges = jb.sample_bridges(key, model, start, end, 1.0, num_bridges=100, coupling=coupling)
    ```
    """

    gamma: Float[Array, "..."]
    meeting: AbstractMeeting
    scheme: AbstractScheme
    start_law: AnyStartLaw
    rotation: Rotation | None = eqx.field(static=True)
    independent_noise: bool = eqx.field(static=True)
    _gamma_law: Callable | None = eqx.field(static=True)

    def __init__(
        self,
        gamma: ArrayLike | Callable = 0.0,
        meeting: AbstractMeeting | None = None,
        scheme: AbstractScheme | None = None,
        rotation: Rotation | None = None,
        start_law: Any = None,
    ):
        law, gamma = (gamma, jnp.nan) if callable(gamma) else (None, gamma)
        self.gamma = as_floating("gamma", gamma)
        self.meeting = BrownianCrossing() if meeting is None else meeting
        self.scheme = Heun() if scheme is None else scheme
        self.start_law = as_start_law(Stationary() if start_law is None else start_law)
        for name, given, kind in [
            ("meeting", self.meeting, AbstractMeeting),
            ("scheme", self.scheme, AbstractScheme),
        ]:
            if not isinstance(given, kind):
                raise TypeError(f"`{name}` must be a `{kind.__name__}`; got {given!r}.")
        self.rotation = rotation
        self._gamma_law = law
        reflection = False
        if self.gamma.ndim != 0:
            raise ValueError(
                f"`gamma` must be a scalar, got shape {self.gamma.shape}; use `jax.vmap` "
                "for several values, or pass a function `key -> gamma`."
            )
        if is_traced(self.gamma):
            self.gamma = _in_range(self.gamma)
        elif law is None:
            if not -1 <= np.asarray(self.gamma) < 1:
                raise ValueError(f"`gamma` must be in [-1, 1), got {gamma}.")
            reflection = bool(np.asarray(self.gamma) == -1)
        self.independent_noise = not reflection
        if isinstance(self.meeting, ReflectionPlane) and not reflection:
            raise ValueError(
                "`ReflectionPlane` decides meetings of the reflection coupling only: use "
                f"`gamma=-1.0` (got {gamma}) or another meeting rule."
            )

    @staticmethod
    def as_published(gamma: ArrayLike) -> "Coupling":
        """The paper's own settings: Euler, the sign test with radius 0.05, the printed O and the
        printed start law, with which bridges are **not** corrected to their exact law."""
        return Coupling(gamma, SignTest(0.05), Euler(), published_rotation, Reversed())

    def driven_noise(self, frame, dw, du):
        return self._turn(frame, dw, du)

    def driving_noise(self, frame, driven_dw, du):
        return self._turn(frame, driven_dw, du)

    def gap_variance(self, frame):
        return 2 * (1 - self.gamma)

    def realise(self, keys):
        if self._gamma_law is None:
            return self
        gamma = jax.vmap(self._gamma_law)(keys)
        return eqx.tree_at(lambda c: c.gamma, self, _in_range(gamma.astype(self.gamma.dtype)))

    def _turn(self, frame: Frame, dw: Float[Array, " d"], du: Float[Array, ""] | None):
        """{I - (1-γ)Π} w + √(1-γ²) u ΔU: symmetric, so it serves both directions."""
        along = -(1 - self.gamma) * dot(frame.u, dw)
        if du is not None:
            own = (1 - self.gamma) * (1 + self.gamma)
            positive = own > 0  # at a traced γ = -1 the root has no derivative
            along += jnp.where(positive, jnp.sqrt(jnp.where(positive, own, 1)), 0) * du
        return dw + frame.u * along


def _in_range(gamma: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """NaN where γ is not in [-1, 1): such pairs never meet, and are counted as not finite."""
    return jnp.where((gamma >= -1) & (gamma < 1), gamma, jnp.nan)


def rotation_between(
    coupling: AbstractCoupling, sigma: AbstractSigma, driven_sigma: AbstractSigma
) -> Float[Array, "d d"] | None:
    """O(x, x'), or `None` where σ calls for no rotation."""
    if not rotation_effect(coupling, type(sigma), type(driven_sigma)).simulated:
        return None
    assert isinstance(sigma, Full) and isinstance(driven_sigma, Full)
    rotation = polar_rotation if coupling.rotation is None else coupling.rotation
    return rotation(sigma.matrix, driven_sigma.matrix)


def rotation_effect(
    coupling: AbstractCoupling, sigma: type[AbstractSigma], driven_sigma: type[AbstractSigma]
) -> decisions.Effect:
    """Whether the pair calls for a rotation."""
    return decisions.rotation(sigma, driven_sigma, coupling.rotation is no_rotation)


def check_coupling(coupling) -> None:
    """Raise `TypeError` for anything but a coupling."""
    if not isinstance(coupling, AbstractCoupling):
        raise TypeError(f"`coupling` must be a `Coupling`; got {coupling!r}.")


def rotate(rotation: Float[Array, "d d"] | None, dw: Float[Array, " d"]) -> Float[Array, " d"]:
    """O w."""
    return dw if rotation is None else matvec(rotation, dw)


def rotate_back(rotation: Float[Array, "d d"] | None, dw: Float[Array, " d"]) -> Float[Array, " d"]:
    """Oᵀ w."""
    return dw if rotation is None else matvec(rotation.T, dw)
