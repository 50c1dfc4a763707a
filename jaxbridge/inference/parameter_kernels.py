"""Markov kernels for the parameters given the paths: one step on θ.

*Exact draw.* Let the prior be normal and the log-likelihood ℓ quadratic in θ, which holds if the
drift is linear in θ. Then θ given the paths is normal,

    N(θ_0 + P⁻¹ g, P⁻¹),    g = ∇(ℓ + log π)(θ_0),    P = -∇²(ℓ + log π),

with derivatives by automatic differentiation at any θ_0. The kernel repeats the draw until it
satisfies the constraint.

*Metropolis–Hastings.* Otherwise the proposals are normal and would be exact for a quadratic,

    θ' ~ N(θ + (1 - √(1-τ²)) G⁻¹ g, τ² G⁻¹),    G = ∫ Jᵀ J dt + (prior precision),  J = ∂_θ σ⁻¹α,

with the gradient g and the information G of the paths at θ. The factor τ is random: 1 (a Newton
step) or smaller. With τ = 1 and constant G the proposal is the exact draw and always accepted.
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

# Draws from a normal law until one satisfies the constraint: if none does, θ stays, which leaves
# the law invariant too.
_MOST_DRAWS = 100
# Steps of Metropolis–Hastings, by chance one of these.
_SCALES = (1.0, 0.3)


class ParameterStep(NamedTuple):
    """θ after a step, and whether it moved."""

    theta: Float[Array, " p"]
    accepted: Bool[Array, ""]


class CompleteData(NamedTuple):
    """What a step of θ is made from: the augmented observations, and the prior."""

    parameters: Parameters
    augmentation: Augmentation
    paths: Paths
    log_prior: Callable[[Array], Array]

    def log_likelihood(self, theta: Float[Array, " p"]) -> Float[Array, ""]:
        return self.augmentation.log_likelihood(self.parameters.bind(theta), self.paths)

    def log_posterior_inside(self, theta: Float[Array, " p"]) -> Float[Array, ""]:
        """log of likelihood times prior, as if there were no constraint."""
        return self.log_likelihood(theta) + self.log_prior(theta)

    def log_posterior(self, theta: Float[Array, " p"]) -> Float[Array, ""]:
        """-inf where the constraint is not satisfied."""
        inside = self.parameters.allowed(theta)
        return jnp.where(inside, self.log_posterior_inside(theta), -jnp.inf)

    def information(self, theta: Float[Array, " p"]) -> Float[Array, "p p"]:
        """G(θ), with the prior's precision where it is normal."""
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
    """A Markov kernel on θ, given the paths."""

    @abstractmethod
    def step(
        self, key: Key[Array, ""], theta: Float[Array, " p"], data: CompleteData
    ) -> ParameterStep:
        """One step from θ."""


class NormalDraw(AbstractParameterKernel):
    """θ from its normal law given the paths."""

    def step(self, key, theta, data):
        # Forward over reverse where there are many parameters.
        gradient = (jax.jacfwd if len(theta) < 3 else jax.grad)(data.log_posterior_inside)
        root = any_cholesky(-jax.jacfwd(gradient)(theta))
        mean = theta + _solve_root(root, gradient(theta))

        def draw(carry):
            i, _, _ = carry
            noise = jax.random.normal(jax.random.fold_in(key, i), theta.shape, theta.dtype)
            drawn = mean + any_solve(root.T, noise)
            return i + 1, drawn, data.parameters.allowed(drawn)

        def missed(carry):
            i, _, ok = carry
            return (i < _MOST_DRAWS) & ~ok

        _, drawn, ok = lax.while_loop(missed, draw, (jnp.int32(0), theta, jnp.asarray(False)))
        return ParameterStep(jnp.where(ok, drawn, theta), ok)


class NewtonStep(AbstractParameterKernel):
    """Metropolis–Hastings with proposals from the gradient and the information at θ."""

    def step(self, key, theta, data):
        scale_key, noise_key, accept_key = jax.random.split(key, 3)
        tau = jax.random.choice(scale_key, jnp.asarray(_SCALES, theta.dtype))

        def evaluate(theta):
            """The log density at θ, and mean and root of the proposals from it."""
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
        log_ratio = other_value - value + log_density(theta, other_mean, other_root)
        log_ratio -= log_density(proposed, mean, root)
        # A comparison with NaN is false, and refuses.
        accepted = ok & (jnp.log(jax.random.uniform(accept_key, dtype=theta.dtype)) < log_ratio)
        return ParameterStep(jnp.where(accepted, proposed, theta), accepted)


class GivenKernel(AbstractParameterKernel):
    """A kernel of the user's, as BlackJAX makes them from a log density: `init(position)` and
    `step(key, state) -> (state, info)`, on the unknown parameters."""

    build: Callable[[Callable], Any] = eqx.field(static=True)

    def step(self, key, theta, data):
        def log_density(params):
            return data.log_posterior(data.parameters.vector(params))

        def step(key, params):
            kernel = self.build(log_density)
            if not all(callable(getattr(kernel, part, None)) for part in ("init", "step")):
                raise TypeError(
                    "`parameter_kernel` must return a kernel with functions `init(position)` and "
                    f"`step(key, state)`, as in BlackJAX; it returned {shown(kernel)}."
                )
            state, _ = kernel.step(key, kernel.init(params))
            return data.parameters.vector(state.position)

        moved = evaluated("parameter_kernel", step, key, data.parameters.select(theta))
        if moved.shape != theta.shape:
            raise ValueError(
                "`parameter_kernel` must preserve the structure of the unknown parameters; it "
                f"returned {moved.size} numbers instead of {theta.size}."
            )
        ok = data.parameters.allowed(moved)
        moved = jnp.where(ok, moved, theta)
        return ParameterStep(moved, jnp.any(moved != theta))


def check_kernel(kernel: Any) -> None:
    """Raise `TypeError` for anything but a function, or `None`."""
    check_function("parameter_kernel", kernel, "(log_density)", optional=True)


def choose_kernel(
    kernel: Callable[[Callable], Any] | None, is_quadratic: bool, log_prior: Callable
) -> AbstractParameterKernel:
    """The user's, if there is one; else the exact draw where it is to be had."""
    if kernel is not None:
        return GivenKernel(kernel)
    exact = is_quadratic and isinstance(log_prior, NormalDensity)
    return NormalDraw() if exact else NewtonStep()


def _solve_root(root: Float[Array, "p p"], right: Float[Array, " p"]) -> Float[Array, " p"]:
    """(L Lᵀ)⁻¹ v."""
    return any_solve(root.T, any_solve(root, right))
