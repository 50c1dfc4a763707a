"""A proposal of another kind is a class in one file: whatever takes a proposal takes it."""

from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxbridge as jb


class Wide(jb.AbstractGuidedProposal):
    """The modified diffusion bridge with a variance that is too large."""

    density: jb.EulerDensity = jb.EulerDensity()
    refinement: ClassVar[float] = 1.0

    def describe(self):
        return "Wide"

    def relative_seconds(self, model, intervals):
        return jnp.ones_like(intervals.duration)

    def guide(self, dynamics, start, end, dt):
        return None

    def step_law(self, step, x, target):
        mean = x + (step.end - x) * (step.dt / step.remaining)
        shrunk = (step.remaining - step.dt) / step.remaining
        return target._replace(mean=mean, covariance=2 * shrunk)


MODEL = jb.ornstein_uhlenbeck([[1.0]])
INTERVAL = ([0.2], [0.5], 0.4)
KEY = jax.random.key(0)


@pytest.mark.slow
def test_densities_and_choices_take_it():
    candidates = [Wide(), jb.ModifiedDiffusionBridge()]
    choice = jb.choose_proposal(KEY, MODEL, *INTERVAL, num_steps=4, candidates=candidates)
    assert "Wide" in str(choice)
    made = [
        jb.transition_log_density(
            KEY, MODEL, *INTERVAL, num_steps=4, num_proposals=4_000, proposal=proposal
        )
        for proposal in candidates
    ]
    ours, theirs = made
    error = np.hypot(ours.standard_error, theirs.standard_error)
    assert abs(ours.value - theirs.value) < 5 * error < 0.2
    assert ours.effective_sample_size < theirs.effective_sample_size


@pytest.mark.slow
@pytest.mark.parametrize("method", ["pseudo_marginal", "crank_nicolson"])
def test_chains_take_it(method):
    chain = jb.sample_exact_bridges(
        KEY, MODEL, *INTERVAL, num_steps=4, num_bridges=4_000, proposal=Wide(), method=method
    )
    # The Euler scheme's own bridge: a Gaussian chain.
    a = 1 - 0.1
    precision = np.diag(np.full(3, 1 + a**2)) - a * (np.eye(3, k=1) + np.eye(3, k=-1))
    mean = np.linalg.solve(precision, [a * 0.2, 0.0, a * 0.5])
    found, error = (
        chain.mean(lambda path: path[1:-1, 0]),
        chain.standard_error(lambda path: path[1:-1, 0]),
    )
    assert np.all(np.abs(found - mean) < 5 * error) and np.all(error < 0.03)


@pytest.mark.slow
def test_gibbs_takes_it():
    times, data = jnp.arange(4.0) / 4, jnp.array([[0.2], [0.1], [0.3], [0.0]])
    prior = jb.NormalPrior(jnp.zeros(1), jnp.eye(1))
    model = jb.Diffusion(lambda x, p: -p * x, params=jnp.ones(1))
    posterior = jb.gibbs(
        KEY, model, times, data, prior=prior, num_iterations=20, num_steps=4, proposal=Wide()
    )
    assert bool(jnp.isfinite(posterior.theta).all())
