"""The paper's γ-coupling (section 2.1) drives X' by

    dW' = {I - (1-γ)Π} O dW + √(1-γ²) u dU,    Π = uuᵀ,  u ∝ σ(x')⁻¹(x - x'),

and read in the other direction, for the associated diffusion, equation (stjerne-dif),

    dW = Oᵀ [{I - (1-γ)Π} dW' + √(1-γ²) u dU'].
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from ..engine.arguments import check_function, named
from ..engine.captured import Captured
from ..engine.checks import as_floating, is_traced
from ..engine.linalg import dot
from ..models.diffusion import check_value
from ..schemes import AbstractScheme, Euler, Frame, HeunOrEuler
from .base import AbstractCoupling, Rotation
from .meeting import AbstractMeeting, BrownianCrossing, ReflectionPlane, SignTest
from .rotation import published_rotation
from .start_laws import AnyStartLaw, Reversed, Stationary, as_start_law


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
    - `scheme`: by default `HeunOrEuler()`, Heun's scheme for constant σ and Euler's where it
        depends on the state; or `Heun()`, `Euler()`, `Milstein()`, for stiff or superlinear drift
        `SemiImplicit()`, for linear drift `GaussianTransition()`.
    - `rotation`: O(x, x') from the matrices σ(x), σ(x'), where these are full and depend on the
        state. `None` drives the pair through the triangular root of V = σσᵀ, which calls for none;
        with `Heun()` it is `polar_rotation`.
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
    _captured: Captured

    def __init__(
        self,
        gamma: ArrayLike | Callable = 0.0,
        meeting: AbstractMeeting | None = None,
        scheme: AbstractScheme | None = None,
        rotation: Rotation | None = None,
        start_law: Any = None,
    ):
        if callable(gamma):
            check_function("gamma", gamma, "(key)")
        check_function("rotation", rotation, "(sigma, driven_sigma)", optional=True)
        law, gamma = (gamma, jnp.nan) if callable(gamma) else (None, gamma)
        self.gamma = as_floating("gamma", gamma)
        self.meeting = BrownianCrossing() if meeting is None else meeting
        self.scheme = HeunOrEuler() if scheme is None else scheme
        self.start_law = as_start_law(Stationary() if start_law is None else start_law)
        for name, given, kind in [
            ("meeting", self.meeting, AbstractMeeting),
            ("scheme", self.scheme, AbstractScheme),
        ]:
            if not isinstance(given, kind):
                raise TypeError(f"`{name}` must be a `{kind.__name__}`; got {given!r}.")
        self.rotation = rotation
        self._gamma_law = law
        self._captured = Captured(law)
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
        law = self._gamma_law
        draw = named("gamma", self._captured.call)
        gamma = jax.vmap(lambda key: check_value("gamma", draw(law, key), (), self.gamma))(keys)
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


def described(coupling: AbstractCoupling) -> str:
    """A coupling in a few words."""
    words = type(coupling).__name__
    if isinstance(coupling, Coupling) and not is_traced(coupling.gamma):
        words += f"({float(coupling.gamma):.3g})"
    if not isinstance(coupling.start_law, Stationary):
        words += f" from {type(coupling.start_law).__name__}"
    return words


def ingredients(coupling: AbstractCoupling) -> tuple[str, str, float]:
    """Its scheme and its meeting rule, and γ."""
    meeting = coupling.meeting
    radius = meeting.radius if isinstance(meeting, SignTest) else None
    words = type(meeting).__name__ + ("" if radius is None else f"({float(radius):g})")
    gamma = float(coupling.gamma) if isinstance(coupling, Coupling) else np.nan
    return type(coupling.scheme).__name__, words, gamma


def most_accurate(coupling: AbstractCoupling) -> AbstractCoupling:
    """The same with the scheme and the meeting rule that have the smallest step error."""
    return eqx.tree_at(
        lambda c: (c.meeting, c.scheme),
        coupling,
        (BrownianCrossing(), HeunOrEuler()),
        is_leaf=lambda leaf: isinstance(leaf, AbstractMeeting | AbstractScheme),
    )
