"""The γ-coupling of the paper (section 2.1), and descriptions of couplings for tables.

X drives X' by

    dW' = {I - (1-γ)Π} O dW + √(1-γ²) u dU,    Π = uuᵀ,  u ∝ σ(x')⁻¹(x - x').

In the other direction, for the associated diffusion, X' drives X (equation (stjerne-dif)):

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

    A bridge is joined from two paths: X, simulated backwards from the end, and X', simulated
    forwards from the start. γ = -1 is reflection (Lindvall & Rogers 1986). γ = 0 is projection
    (Chen & Li 1989): in one dimension X' is then independent of X, as in Bladt & Sørensen (2014).
    As γ → 1 the two share more of their noise and meet more rarely, but the joined path is closer
    to a bridge.

    **Arguments:**

    - `gamma`: γ in [-1, 1); or a law, a function `key -> γ` that samples a γ for each proposal.
        A value of a law, or a traced one, may be outside [-1, 1). Pairs with such a γ never meet,
        and count in `num_nonfinite`.
    - `meeting`: `BrownianCrossing()`, `SignTest(radius)` or, for γ = -1, `ReflectionPlane()`.
    - `scheme`: by default `HeunOrEuler()`, which is Heun's scheme for constant σ, Euler's for a
        state-dependent σ, and the exact `GaussianTransition()` for linear drift and constant σ in
        one or two dimensions. Others are `Heun()`, `Euler()` and `Milstein()`; `SemiImplicit()` for
        stiff or superlinear drift.
    - `rotation`: for a full state-dependent σ, a function of the matrices σ(x) and σ(x') that
        returns an orthogonal matrix O, such that σ(x')O is close to σ(x). The default `None` drives
        the pair through the triangular root of V = σσᵀ, which needs no rotation; with `Heun()` it
        selects `polar_rotation`.
    - `start_law`: μ, the law of the initial state of the associated diffusion: `Stationary()`,
        `GaussianLaw(mean, covariance)`, or any object with `sample(key, model)` and a normalised
        `log_density(x)`; see `fit_start_law`. Only functions that count hits of bridges use it,
        such as those that weight bridges; `sample_bridges` does not.

    **Raises:** `ValueError` for γ that is not a number in [-1, 1), for `ReflectionPlane` with γ ≠
    -1, or for a `GaussianLaw` without a density; `TypeError` for an invalid meeting rule, scheme,
    rotation or start law.

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
        # With a law γ is NaN until `realise` samples one for each lane.
        law, gamma = (gamma, jnp.nan) if callable(gamma) else (None, gamma)
        self.gamma = as_floating("gamma", gamma)
        self.meeting = BrownianCrossing() if meeting is None else meeting
        self.scheme = HeunOrEuler() if scheme is None else scheme
        self.start_law = as_start_law(Stationary() if start_law is None else start_law)
        for name, value, base_class in [
            ("meeting", self.meeting, AbstractMeeting),
            ("scheme", self.scheme, AbstractScheme),
        ]:
            if not isinstance(value, base_class):
                raise TypeError(
                    f"`{name}` must be of type `{base_class.__name__}`; got {value!r}. Omit it for "
                    "the default."
                )
        self.rotation = rotation
        self._gamma_law = law
        # Traced values in the closure of the law become leaves of the coupling.
        self._captured = Captured(law)
        # Static: the program omits dU only if γ = -1 is known at compile time.
        reflection = False
        if self.gamma.ndim != 0:
            raise ValueError(
                f"`gamma` must be a scalar; got shape {self.gamma.shape}. Use `jax.vmap` for "
                "several values, or pass a function `key -> gamma`."
            )
        if is_traced(self.gamma):
            self.gamma = _in_range(self.gamma)
        elif law is None:
            # The constructor can check concrete values only; `_in_range` handles traced ones.
            if not -1 <= np.asarray(self.gamma) < 1:
                raise ValueError(f"`gamma` must be in [-1, 1); got {gamma}.")
            reflection = bool(np.asarray(self.gamma) == -1)
        self.independent_noise = not reflection
        if isinstance(self.meeting, ReflectionPlane) and not reflection:
            raise ValueError(
                "`ReflectionPlane` is a meeting rule for the reflection coupling only; got "
                f"`gamma={gamma}`. Pass `gamma=-1.0`, or another meeting rule."
            )

    @staticmethod
    def as_published(gamma: ArrayLike) -> "Coupling":
        """Return the coupling with the settings of the paper, for comparisons with it: `Euler()`,
        `SignTest(0.05)`, `published_rotation` and `Reversed()`.

        With these, weights do **not** correct bridges to their exact law.
        """
        return Coupling(gamma, SignTest(0.05), Euler(), published_rotation, Reversed())

    def driven_noise(self, frame, dw, du):
        return self._couple(frame, dw, du)

    def driving_noise(self, frame, driven_dw, du):
        return self._couple(frame, driven_dw, du)

    def gap_variance(self, frame):
        return 2 * (1 - self.gamma)

    def realise(self, keys):
        if self._gamma_law is None:
            return self
        law = self._gamma_law
        draw = named("gamma", self._captured.call)
        gamma = jax.vmap(lambda key: check_value("gamma", draw(law, key), (), self.gamma))(keys)
        return eqx.tree_at(lambda c: c.gamma, self, _in_range(gamma.astype(self.gamma.dtype)))

    def _couple(self, frame: Frame, dw: Float[Array, " d"], du: Float[Array, ""] | None):
        """Return {I - (1-γ) Π} ΔW + √(1-γ²) u ΔU, where Π = u uᵀ projects onto the unit vector u.

        The joint law of both noises is symmetric. So the same map gives the driven noise from the
        driving noise, and the driving from the driven.
        """
        # Only the component along u changes.
        along_u = -(1 - self.gamma) * dot(frame.u, dw)
        if du is not None:
            # 1 - γ² as a product keeps its digits near γ = ±1.
            variance = (1 - self.gamma) * (1 + self.gamma)
            positive = variance > 0  # the square root has no derivative at a traced γ = -1
            along_u += jnp.where(positive, jnp.sqrt(jnp.where(positive, variance, 1)), 0) * du
        return dw + frame.u * along_u


def _in_range(gamma: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Return γ, with NaN where it is outside [-1, 1): such pairs never meet, and count as
    non-finite."""
    return jnp.where((gamma >= -1) & (gamma < 1), gamma, jnp.nan)


def describe_coupling(coupling: AbstractCoupling) -> str:
    """Return a short description of the coupling, such as `Coupling(0.5) from GaussianLaw`."""
    text = type(coupling).__name__
    if isinstance(coupling, Coupling) and not is_traced(coupling.gamma):
        text += f"({float(coupling.gamma):.3g})"
    if not isinstance(coupling.start_law, Stationary):
        text += f" from {type(coupling.start_law).__name__}"
    return text


def ingredients(coupling: AbstractCoupling) -> tuple[str, str, float]:
    """Return the name of the scheme, the name of the meeting rule with its radius, and γ (NaN for
    other couplings)."""
    meeting = coupling.meeting
    radius = meeting.radius if isinstance(meeting, SignTest) else None
    meeting_name = type(meeting).__name__ + ("" if radius is None else f"({float(radius):g})")
    gamma = float(coupling.gamma) if isinstance(coupling, Coupling) else np.nan
    return type(coupling.scheme).__name__, meeting_name, gamma


def most_accurate(coupling: AbstractCoupling) -> AbstractCoupling:
    """Return the coupling with the scheme and the meeting rule of smallest discretisation error."""
    return eqx.tree_at(
        lambda c: (c.meeting, c.scheme),
        coupling,
        (BrownianCrossing(), HeunOrEuler()),
        # Rules and schemes as leaves: they are replaced as a whole, not array by array.
        is_leaf=lambda leaf: isinstance(leaf, AbstractMeeting | AbstractScheme),
    )
