"""Rules that select the effects which a compiled program simulates.

The effects depend on the model and the coupling. While a program is traced, the model, the scheme
and the coupled pair apply these rules and no others. `coupling.effects` returns the same decisions,
so its table describes the program exactly. Exception: the class of σ determines whether a step
solves a linear system; `solves` only describes this.
"""

from typing import NamedTuple

from .sigma import AbstractSigma, Constant, Diagonal, Full, Identity, Triangular


class Effect(NamedTuple):
    """Decision about one effect: whether it is simulated, and the reason."""

    simulated: bool
    why: str


class Effects(NamedTuple):
    """Decisions about all effects for one model and coupling, from `effects`. Prints as a table.

    - `reverse_drift`: α* by automatic differentiation of log ν, in each step of the reversed path.
    - `divergence`: div V in α*.
    - `solves`: Gaussian elimination with the matrix σ, in each step.
    - `triangular_root`: the triangular root of V = σσᵀ instead of σ, in each step of the pair.
    - `rotation`: the orthogonal matrix O(x, x'), in each step of the pair.
    - `independent_noise`: dU, one normal number per step.
    - `crossing_uniforms`: one uniform number per step, for the meeting rule.
    - `corrector`: Heun's second evaluation of the drift, at the predicted point.
    - `stratonovich`: the difference between the Itô drift and the Stratonovich drift.
    - `stored_times`: storage of all grid points, not only of the requested times.
    - `early_stop`: a loop over associated paths that stops once all of them have hit.

    The other effects are those of guided paths:

    - `noise_by_drift`: noise that the drift carries, within a step, to coordinates that σ does not
        reach.
    - `quadratic_noise`: the part of a step that is quadratic in its noise, by derivatives of V.
    - `exact_steps`: steps by the exponential of the drift matrix, without discretisation error.
        (`path_log_likelihood` has an error of its own.)
    - `time`: coefficients evaluated at the middle of each step, for records.
    """

    reverse_drift: Effect
    divergence: Effect
    solves: Effect
    triangular_root: Effect
    rotation: Effect
    independent_noise: Effect
    crossing_uniforms: Effect
    corrector: Effect
    stratonovich: Effect
    stored_times: Effect
    early_stop: Effect
    noise_by_drift: Effect
    quadratic_noise: Effect
    exact_steps: Effect
    time: Effect

    def __str__(self) -> str:
        """Return a table with one row per effect."""
        lines = [f"{'effect':<18}  {'':<9}  why"]
        for name, effect in self._asdict().items():
            word = "simulated" if effect.simulated else "left out"
            lines.append(f"{name.replace('_', ' '):<18}  {word:<9}  {effect.why}")
        return "\n".join(lines)


def without_pairs(of_guided_paths: dict[str, Effect], why: str) -> Effects:
    """Return the effects for a model to which couplings do not apply, for the reason `why`."""
    no_pair = Effect(False, f"no coupling applies: {why}")
    return Effects(**{name: of_guided_paths.get(name, no_pair) for name in Effects._fields})


def noise_by_drift(invertible: bool) -> Effect:
    """Decide whether to simulate ∫ (δ - s) ∇α σ dW, the noise that the drift carries."""
    if invertible:
        return Effect(False, "σ reaches all coordinates")
    return Effect(True, "σ has fewer columns than rows: the drift transports the noise")


# Quadratic steps take time and memory of order d⁴ and d³. Up to so many dimensions their accuracy
# is worth that.
_LARGEST_QUADRATIC = 10


def quadratic_noise(invertible: bool, sigma_varies: bool, d: int) -> Effect:
    """Decide whether steps of guided paths are quadratic in their noise (`QuadraticDensity`)."""
    if not sigma_varies:
        return Effect(False, "σ does not depend on the state: steps of weak order 2 are normal")
    if not invertible:
        return Effect(False, "σ has fewer columns than rows: the steps are normal")
    if d > _LARGEST_QUADRATIC:
        return Effect(False, f"more than {_LARGEST_QUADRATIC} dimensions: Euler steps are cheaper")
    return Effect(True, "σ depends on the state; not where given paths determine their noise")


def exact_steps(linear: bool) -> Effect:
    """Decide whether steps are exact transitions (`LinearDensity`, `GaussianTransition`)."""
    if not linear:
        return Effect(False, "the drift is not linear, σ varies, or a coefficient depends on time")
    return Effect(True, "the drift is linear and σ constant, so transitions are known")


def time(depends_on_time: bool) -> Effect:
    """Decide whether to evaluate α(x, t) and σ(x, t) anew for each step."""
    if not depends_on_time:
        return Effect(False, "no coefficient depends on time")
    return Effect(True, "the drift or σ takes the time as a third argument")


def reverse_drift(reversible: bool, has_reverse_drift: bool) -> Effect:
    """Decide whether to derive α* by automatic differentiation."""
    if reversible:
        return Effect(False, "the model is declared reversible: α* = α")
    if has_reverse_drift:
        return Effect(False, "the model has a `reverse_drift`")
    return Effect(True, "α* = -α + V ∇log ν + div V, from `log_stationary`")


def divergence(reverse_drift: Effect, sigma_varies: bool) -> Effect:
    """Decide whether to compute div V."""
    if not reverse_drift.simulated:
        return Effect(False, "α* needs no derivatives")
    if not sigma_varies:
        return Effect(False, "σ does not depend on the state: div V = 0")
    return Effect(True, "σ depends on the state")


def solves(sigma: type[AbstractSigma]) -> Effect:
    """Describe whether σ⁻¹ v needs elimination with a matrix."""
    # No entry for `Tall`: couplings do not apply to it.
    reasons = {
        Identity: "σ is the identity",
        Constant: "σ is constant: one inversion before all steps",
        Diagonal: "σ is diagonal: a division per coordinate",
        Triangular: "the root of V = σσᵀ is triangular: one substitution",
    }
    if sigma is Full:
        return Effect(True, "σ is a full matrix that depends on the state")
    return Effect(False, reasons[sigma])


def triangular_root(sigma: type[AbstractSigma], rotation_given: bool, stratonovich: bool) -> Effect:
    """Decide whether to replace σ = L Q by its triangular factor L, L Lᵀ = V."""
    if sigma is not Full:
        return Effect(False, "σ is constant, diagonal or triangular")
    if rotation_given:
        return Effect(False, "the `rotation` of the coupling acts on σ(x) itself")
    if stratonovich:
        return Effect(False, "the scheme differentiates σ(x) itself")
    return Effect(True, "the law depends on V = σσᵀ only, and its root needs no elimination")


def rotation(sigma: type[AbstractSigma], rotation_given: bool, is_disabled: bool) -> Effect:
    """Decide whether to compute the orthogonal matrix O(x, x')."""
    if sigma not in (Full, Triangular):
        return Effect(False, "σ is constant or diagonal: O = I")
    if is_disabled:
        return Effect(False, "the coupling has `rotation=no_rotation`")
    if sigma is Triangular and not rotation_given:
        return Effect(False, "triangular roots of V = σσᵀ do not rotate: O = I")
    return Effect(True, "aligns σ(x')O with σ(x)")


def independent_noise(has_independent_noise: bool) -> Effect:
    """Decide whether to draw dU, the part of the noise along u that the paths do not share."""
    if has_independent_noise:
        return Effect(True, "the paths share only a part of their noise along u")
    return Effect(False, "the noise of one path determines the noise of the other")


def crossing_uniforms(draws_uniform: bool) -> Effect:
    """Decide whether the meeting rule draws uniform numbers."""
    if draws_uniform:
        return Effect(True, "the meeting rule draws whether the paths meet inside a step")
    return Effect(False, "the meeting rule uses the grid points only")


def corrector(sigma_varies: bool, linear: bool) -> Effect:
    """Decide whether `HeunOrEuler` evaluates α at the predicted point too."""
    if linear:
        return Effect(False, "the drift is linear and σ constant: steps are exact transitions")
    if sigma_varies:
        return Effect(False, "σ depends on the state: the corrector would not raise the weak order")
    return Effect(True, "σ is constant: the corrector raises the weak order from 1 to 2")


def stratonovich(uses_stratonovich: bool, sigma_varies: bool) -> Effect:
    """Decide whether to compute the Itô correction ½ Σ_jk ∂_kσ_ij σ_kj."""
    if not uses_stratonovich:
        return Effect(False, "the scheme uses the Itô drift")
    if not sigma_varies:
        return Effect(False, "σ does not depend on the state: both drifts are equal")
    return Effect(True, "the scheme uses the Stratonovich drift")


def stored_times(num_stored: int | None) -> Effect:
    """Decide whether to store the joined path at every step."""
    if num_stored is None:
        return Effect(True, "the result contains all grid points")
    return Effect(False, f"only {num_stored} times are requested")


def early_stop(num_chunks: int) -> Effect:
    """Decide whether to stop as soon as all associated paths have hit."""
    if num_chunks == 1:
        return Effect(False, "one chunk holds the noise of the path")
    return Effect(True, f"a check after each of {num_chunks} chunks of noise")
