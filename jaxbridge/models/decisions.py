"""Which effects a scene calls for: the one table of decisions.

A model and a coupling are a scene. What its compiled program contains is decided here and
nowhere else, when it is traced: the model asks for the rules of the reversal, the scheme for
that of its drift, the pair for those of its noise and its rotation. (Whether there is a matrix
to solve with follows from the class of σ, which `solves` puts in words.) `coupling.effects` asks
the same rules and prints their answers, so what it says is what is simulated.
"""

from typing import NamedTuple

from .sigma import AbstractSigma, Constant, Diagonal, Full, Identity, Triangular


class Effect(NamedTuple):
    """Whether something is simulated, and why, or why not."""

    simulated: bool
    why: str


class Effects(NamedTuple):
    """The decisions for one scene.

    - `reverse_drift`: α* by automatic differentiation of log ν, in each step of the reversed path.
    - `divergence`: div V in α*.
    - `solves`: elimination with a matrix σ in each step.
    - `triangular_root`: the root of V = σσᵀ in the place of σ, in each step of the pair.
    - `rotation`: O(x, x') in each step of the pair.
    - `independent_noise`: dU, one normal number a step.
    - `crossing_uniforms`: one uniform number a step, for the meeting rule.
    - `corrector`: Heun's second look at the drift, at the point that it predicts.
    - `stratonovich`: the correction of the drift by which Itô's form exceeds Stratonovich's.
    - `stored_times`: whole paths kept, rather than the times asked for.
    - `early_stop`: associated paths looked at on the way, and stopped where all have hit.
    - `noise_by_drift`: noise that the drift leads to the part of the state that σ does not reach,
        within each step of the paths of a record.
    - `time`: coefficients worked out anew for each step of the paths of a record, at its middle.
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
    time: Effect

    def __str__(self) -> str:
        lines = [f"{'effect':<18}  {'':<9}  why"]
        for name, effect in self._asdict().items():
            word = "simulated" if effect.simulated else "left out"
            lines.append(f"{name.replace('_', ' '):<18}  {word:<9}  {effect.why}")
        return "\n".join(lines)


def without_pairs(noise_by_drift: Effect, time: Effect, why: str) -> Effects:
    """The effects of a model to which couplings do not apply, for this reason."""
    nothing = Effect(False, f"no coupling applies: {why}")
    of_records = {"noise_by_drift": noise_by_drift, "time": time}
    return Effects(**{name: of_records.get(name, nothing) for name in Effects._fields})


def noise_by_drift(invertible: bool) -> Effect:
    """∫ (δ - s) ∇α σ dW in the part of the state that σ does not reach."""
    if invertible:
        return Effect(False, "σ reaches the whole state")
    return Effect(True, "σ has fewer columns than rows: noise comes to the rest by the drift")


def time(depends_on_time: bool) -> Effect:
    """α(x, t) and σ(x, t)."""
    if not depends_on_time:
        return Effect(False, "no coefficient depends on time")
    return Effect(True, "the drift or σ takes a third argument, the time")


def reverse_drift(reversible: bool, given: bool) -> Effect:
    """α* by automatic differentiation."""
    if reversible:
        return Effect(False, "the model is declared reversible: α* = α")
    if given:
        return Effect(False, "the model brings its `reverse_drift`")
    return Effect(True, "α* = -α + V ∇log ν + div V, from `log_stationary`")


def divergence(reverse_drift: Effect, sigma_varies: bool) -> Effect:
    """div V."""
    if not reverse_drift.simulated:
        return Effect(False, "α* needs no derivative")
    if not sigma_varies:
        return Effect(False, "σ does not depend on the state: div V = 0")
    return Effect(True, "σ depends on the state")


def solves(sigma: type[AbstractSigma]) -> Effect:
    """σ⁻¹ v by elimination."""
    reasons = {
        Identity: "σ is the identity",
        Constant: "σ is constant: inverted once, before the steps",
        Diagonal: "σ is diagonal: a division",
        Triangular: "its root is triangular: one substitution",
    }
    if sigma is Full:
        return Effect(True, "σ is a full matrix that depends on the state")
    return Effect(False, reasons[sigma])


def triangular_root(sigma: type[AbstractSigma], rotation_given: bool, stratonovich: bool) -> Effect:
    """L of σ = L Q, L Lᵀ = V."""
    if sigma is not Full:
        return Effect(False, "σ is no full matrix that depends on the state, or triangular already")
    if rotation_given:
        return Effect(False, "the coupling turns σ(x) itself, by its `rotation`")
    if stratonovich:
        return Effect(False, "the scheme differentiates σ(x) itself")
    return Effect(True, "V = σσᵀ is all that counts, and its root solves without elimination")


def rotation(sigma: type[AbstractSigma], rotation_given: bool, left_out: bool) -> Effect:
    """O(x, x')."""
    if sigma not in (Full, Triangular):
        return Effect(False, "σ is no matrix that depends on the state: O = I")
    if left_out:
        return Effect(False, "the coupling's choice, `no_rotation`")
    if sigma is Triangular and not rotation_given:
        return Effect(False, "triangular roots of V = σσᵀ do not turn: O = I")
    return Effect(True, "so that σ(x')O points where σ(x) does")


def independent_noise(has_own: bool) -> Effect:
    """dU."""
    if has_own:
        return Effect(True, "the pair shares only a part of its noise along u")
    return Effect(False, "the noise of one path is a function of the other's")


def crossing_uniforms(draws: bool) -> Effect:
    """The meeting rule's own randomness."""
    if draws:
        return Effect(True, "whether the gap closed inside a step is drawn")
    return Effect(False, "the meeting rule looks at the grid points only")


def corrector(sigma_varies: bool) -> Effect:
    """α at the predicted point, where the scheme is left to the scene."""
    if sigma_varies:
        return Effect(False, "σ depends on the state: it would not raise the order")
    return Effect(True, "σ is constant: it raises the weak order from 1 to 2")


def stratonovich(asked_for: bool, sigma_varies: bool) -> Effect:
    """½ Σ_jk ∂_kσ_ij σ_kj."""
    if not asked_for:
        return Effect(False, "the scheme works with Itô's form")
    if not sigma_varies:
        return Effect(False, "σ does not depend on the state: both forms are one")
    return Effect(True, "the scheme works with Stratonovich's form")


def stored_times(num_stored: int | None) -> Effect:
    """The joined path at every step."""
    if num_stored is None:
        return Effect(True, "the whole path was asked for")
    return Effect(False, f"only {num_stored} times were asked for")


def early_stop(num_chunks: int) -> Effect:
    """Looking on the way whether all associated paths have hit."""
    if num_chunks == 1:
        return Effect(False, "the noise of the path is one chunk, drawn at once")
    return Effect(True, f"after each of {num_chunks} chunks of noise")
