"""Markov kernels for the parameters given the paths: one step on θ.

*Exact draw.* Let the prior be normal and the log-likelihood ℓ quadratic in θ, which holds if the
drift is linear in θ. Then θ given the paths is normal,

    N(θ_0 + P⁻¹ g, P⁻¹),    g = ∇(ℓ + log π)(θ_0),    P = -∇²(ℓ + log π),

with derivatives by automatic differentiation at any θ_0. The kernel repeats the draw until it
satisfies the constraint, at most 100 times.

*Metropolis–Hastings.* In all other cases the kernel proposes a normal draw,

    θ' ~ N(θ + (1 - √(1-τ²)) G⁻¹ g, τ² G⁻¹),    G = ∫ Jᵀ J dt + (prior precision),  J = ∂_θ σ⁻¹α.

Here g is the gradient of ℓ + log π at θ, and G the information of the paths. The factor τ is
random: 1 (a Newton step) or 0.3. If ℓ + log π is quadratic with the Hessian -G, the proposal with
τ = 1 is the exact draw, and is always accepted.
"""

from abc import abstractmethod
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Key

from ..engine.arguments import check_function, evaluated, shown
from ..engine.lanes import over_lanes
from ..engine.linalg import any_cholesky, any_solve, dot, matvec
from .augmentation import Augmentation, Paths
from .parameters import Parameters
from .priors import NormalDensity

# Maximum number of normal draws until one satisfies the constraint. If none does, θ stays, which
# leaves the law invariant, too.
_MOST_DRAWS = 100
# Values of τ, with equal probabilities.
_SCALES = (1.0, 0.3)


class ParameterStep(NamedTuple):
    """θ after a step, and whether it moved."""

    theta: Float[Array, " p"]
    accepted: Bool[Array, ""]


class CompleteData(NamedTuple):
    """Complete data and prior, which define the law of θ given the paths."""

    parameters: Parameters
    augmentation: Augmentation
    paths: Paths
    log_prior: Callable[[Array], Array]

    def log_likelihood(self, theta: Float[Array, " p"]) -> Float[Array, ""]:
        return self.augmentation.log_likelihood(self.parameters.bind(theta), self.paths)

    def log_posterior_inside(self, theta: Float[Array, " p"]) -> Float[Array, ""]:
        """Return the log of likelihood times prior, without the constraint."""
        return self.log_likelihood(theta) + self.log_prior(theta)

    def log_posterior(self, theta: Float[Array, " p"]) -> Float[Array, ""]:
        """Return the log of likelihood times prior; -inf where the constraint is violated."""
        inside = self.parameters.allowed(theta)
        return jnp.where(inside, self.log_posterior_inside(theta), -jnp.inf)

    def information(self, theta: Float[Array, " p"]) -> Float[Array, "p p"]:
        """Return G(θ), with the precision of the prior if it is normal."""
        # A sum over the steps replaces the integral over time.
        points, steps = self.augmentation.points(self.paths)

        def of_point(x, dt):
            def beta(theta):
                dynamics = self.parameters.bind(theta).prepared().forward(x)
                return dynamics.sigma(x).solve(dynamics.drift(x))

            J = jax.jacfwd(beta)(theta)
            return dt * sum(row[:, None] * row for row in J)

        G = jnp.sum(over_lanes(-1, -1)(of_point)(points.T, steps), axis=-1)
        if isinstance(self.log_prior, NormalDensity):
            G = G + self.log_prior.precision
        return G


class AbstractParameterKernel(eqx.Module):
    """Base class of Markov kernels on θ, given the paths."""

    @abstractmethod
    def step(
        self, key: Key[Array, ""], theta: Float[Array, " p"], data: CompleteData
    ) -> ParameterStep:
        """Run one step of the kernel from θ; return the new θ and whether it moved."""


class NormalDraw(AbstractParameterKernel):
    """Exact draw of θ from its normal law given the paths, within the constraint."""

    def step(self, key, theta, data):
        # Forward mode is cheaper for one or two parameters, forward over reverse for more.
        gradient = (jax.jacfwd if len(theta) < 3 else jax.grad)(data.log_posterior_inside)
        # The Hessian of a quadratic is constant, so any θ will do.
        root = any_cholesky(-jax.jacfwd(gradient)(theta))
        mean = theta + _solve_root(root, gradient(theta))

        def draw(carry):
            i, _, _ = carry
            noise = jax.random.normal(jax.random.fold_in(key, i), theta.shape, theta.dtype)
            proposed = mean + any_solve(root.T, noise)
            return i + 1, proposed, data.parameters.allowed(proposed)

        def missed(carry):
            i, _, ok = carry
            return (i < _MOST_DRAWS) & ~ok

        _, proposed, ok = lax.while_loop(missed, draw, (jnp.int32(0), theta, jnp.asarray(False)))
        return ParameterStep(jnp.where(ok, proposed, theta), ok)


class NewtonStep(AbstractParameterKernel):
    """Metropolis–Hastings with proposals from the gradient and the information at θ."""

    def step(self, key, theta, data):
        scale_key, noise_key, accept_key = jax.random.split(key, 3)
        tau = jax.random.choice(scale_key, jnp.asarray(_SCALES, theta.dtype))

        def evaluate(theta):
            """Return the log density at θ, and the mean and precision root of proposals from θ."""
            value, gradient = jax.value_and_grad(data.log_posterior_inside)(theta)
            root = any_cholesky(data.information(theta))
            mean = theta + (1 - jnp.sqrt((1 - tau) * (1 + tau))) * _solve_root(root, gradient)
            return value, mean, root

        def log_density(place, mean, root):
            noise = matvec(root.T, place - mean) / tau
            return jnp.sum(jnp.log(jnp.diagonal(root))) - dot(noise, noise) / 2

        value, mean, root = evaluate(theta)
        noise = jax.random.normal(noise_key, theta.shape, theta.dtype)
        proposed = mean + tau * any_solve(root.T, noise)
        ok = data.parameters.allowed(proposed)
        proposed = jnp.where(ok, proposed, theta)
        other_value, other_mean, other_root = evaluate(proposed)
        # The proposal depends on θ, so the ratio contains both proposal densities.
        log_ratio = other_value - value + log_density(theta, other_mean, other_root)
        log_ratio -= log_density(proposed, mean, root)
        # A comparison with NaN is false, so a NaN ratio rejects.
        accepted = ok & (jnp.log(jax.random.uniform(accept_key, dtype=theta.dtype)) < log_ratio)
        return ParameterStep(jnp.where(accepted, proposed, theta), accepted)


class GivenKernel(AbstractParameterKernel):
    """Kernel of the user on the unknown parameters, with the interface of BlackJAX.

    `build(log_density)` returns it, with `init(position)` and `step(key, state) -> (state, info)`.
    """

    build: Callable[[Callable], Any] = eqx.field(static=True)

    def step(self, key, theta, data):
        def log_density(params):
            return data.log_posterior(data.parameters.vector(params))

        def step(key, params):
            kernel = self.build(log_density)
            # A kernel may be any object with these two functions.
            if not all(callable(getattr(kernel, part, None)) for part in ("init", "step")):
                raise TypeError(
                    "`parameter_kernel` must return a kernel with functions `init(position)` and "
                    f"`step(key, state)`, as in BlackJAX; it returned {shown(kernel)}."
                )
            state, _ = kernel.step(key, kernel.init(params))
            return data.parameters.vector(state.position)

        new_theta = evaluated("parameter_kernel", step, key, data.parameters.select(theta))
        if new_theta.shape != theta.shape:
            raise ValueError(
                "`parameter_kernel` must preserve the structure of the unknown parameters; it "
                f"returned {new_theta.size} numbers instead of {theta.size}."
            )
        ok = data.parameters.allowed(new_theta)
        new_theta = jnp.where(ok, new_theta, theta)
        return ParameterStep(new_theta, jnp.any(new_theta != theta))


def check_kernel(kernel: Any) -> None:
    """Raise `TypeError` unless the kernel is a function or `None`."""
    check_function("parameter_kernel", kernel, "(log_density)", optional=True)


def choose_kernel(
    kernel: Callable[[Callable], Any] | None, is_quadratic: bool, log_prior: Callable
) -> AbstractParameterKernel:
    """Return the kernel of the user if there is one, else the exact draw if it is available.

    The exact draw needs a quadratic log-likelihood and a normal prior. Otherwise θ moves by
    Metropolis–Hastings.
    """
    if kernel is not None:
        return GivenKernel(kernel)
    exact = is_quadratic and isinstance(log_prior, NormalDensity)
    return NormalDraw() if exact else NewtonStep()


def _solve_root(root: Float[Array, "p p"], right: Float[Array, " p"]) -> Float[Array, " p"]:
    """Return (L Lᵀ)⁻¹ v for the root L."""
    return any_solve(root.T, any_solve(root, right))
