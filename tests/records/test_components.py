"""Observation models of independent components: densities by SciPy, guides by quadrature, and
likelihoods by a grid."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from grid_filter import grid_filter
from scipy import stats

import jaxbridge as jb
from jaxbridge.records.observations import Row


def at_zero(y):
    """One observation, at time zero, in today's default precision."""
    return Row(jnp.asarray(y, float), jnp.zeros(()))


def negative_binomial(y, mean, r=4.0):
    return stats.nbinom.logpmf(y, r, r / (r + mean))


def rounded(y, eta, s=0.3, width=1.0):
    law = stats.norm(eta, s)
    inside = law.cdf(y + width / 2) - law.cdf(y - width / 2)
    return np.log(np.maximum(inside, 1e-300))


def censored(y, eta, s=0.4):
    law = stats.norm(eta, s)
    return np.select([y <= -1, y >= 2], [law.logcdf(-1), law.logsf(2)], law.logpdf(y))


def log_normal(y, median, s=0.3):
    return stats.lognorm.logpdf(y, s, scale=median)


# Name: model, log density of (y, η), observations to try.
MODELS = {
    "Poisson": (jb.PoissonCounts(), lambda y, e: stats.poisson.logpmf(y, np.exp(e)), [0, 1, 7, 60]),
    "Poisson, identity": (
        jb.PoissonCounts(link="identity"),
        lambda y, e: stats.poisson.logpmf(y, e),
        [0, 3, 40],
    ),
    "negative binomial": (
        jb.NegativeBinomialCounts(size=4.0),
        lambda y, e: negative_binomial(y, np.exp(e)),
        [0, 1, 7, 60],
    ),
    "negative binomial, identity": (
        jb.NegativeBinomialCounts(size=4.0, link="identity"),
        negative_binomial,
        [0, 3, 40],
    ),
    "Student": (
        jb.StudentT(scale=0.5, df=3.0),
        lambda y, e: stats.t.logpdf(y, 3, e, 0.5),
        [-1.0, 0.4, 30.0],
    ),
    "log-normal": (
        jb.LogNormal(scale=0.3),
        lambda y, e: log_normal(y, np.exp(e)),
        [0.2, 1.0, 9.0],
    ),
    "log-normal, identity": (jb.LogNormal(scale=0.3, link="identity"), log_normal, [0.2, 1.0, 9.0]),
    "rounded": (jb.Rounded(scale=0.3, width=1.0), rounded, [-2.0, 0.0, 1.0]),
    "censored": (jb.Censored(scale=0.4, lower=-1.0, upper=2.0), censored, [-1.0, 0.3, 2.0]),
}


@pytest.mark.parametrize("name", MODELS)
def test_guide_and_correction_are_the_density(name, x64):
    """Each reading alone, of the first coordinate of two, with an offset for the second."""
    model, log_density, readings = MODELS[name]
    for y in readings:
        row = at_zero([y])
        for eta in (0.3, 1.4, 3.0):
            x = jnp.array([eta])
            made = model.correction(row, x, None)
            (scalar,) = zip(*model.scalars(row, None, 1), strict=True)
            _, value, variance, seen = scalar
            guide = stats.norm.logpdf(float(value), eta, float(variance) ** 0.5) if seen else 0.0
            exact = log_density(y, eta)
            np.testing.assert_allclose(float(made) + guide, exact, rtol=1e-6, atol=1e-6)


def moments(log_density, low, high):
    """Mean and variance of the law with this log density, up to a constant."""
    nodes = np.linspace(low, high, 200_001)
    weights = np.exp(log_density(nodes) - log_density(nodes).max())
    mean = nodes @ weights / weights.sum()
    return mean, ((nodes - mean) ** 2) @ weights / weights.sum()


@pytest.mark.parametrize(
    "name, y, log_prior, low, high",
    [
        ("Poisson", 7, lambda e: e / 2, -20, 8),
        ("Poisson", 0, lambda e: e / 2, -80, 8),
        # The density of η for which μ / (μ + r) is Beta(y + ½, r), over the likelihood.
        ("negative binomial", 7, lambda e: e / 2 - np.log(4 + np.exp(e)) / 2, -20, 30),
        ("log-normal", 9.0, lambda e: 0 * e, -5, 8),
        ("log-normal, identity", 9.0, lambda e: -np.log(e), 1e-3, 60),
        ("rounded", 1.0, lambda e: 0 * e, -5, 8),
        ("censored", 0.3, lambda e: 0 * e, -5, 8),
    ],
)
def test_guides_are_moments_given_the_reading(name, y, log_prior, low, high, x64):
    model, log_density, _ = MODELS[name]
    made = model.guide(jnp.array([float(y)]), None, jnp.zeros(()))
    exact = moments(lambda e: log_density(y, e) + log_prior(e), low, high)
    np.testing.assert_allclose(np.ravel(made), exact, rtol=2e-4)


def test_the_guide_of_student_noise_has_its_variance(x64):
    variance = lambda df: jb.StudentT(scale=0.5, df=df).guide(jnp.zeros(1), None, jnp.zeros(()))[1]
    for df in (3.0, 7.0):
        np.testing.assert_allclose(variance(df), stats.t.var(df, scale=0.5), rtol=1e-6)
    np.testing.assert_allclose(variance(1.0), 5 * 0.25)


@pytest.mark.parametrize(
    "model, y, eta, law",
    [
        (jb.PoissonCounts(), 2e5, np.log(2e5) + 2e-3, lambda e: stats.poisson(np.exp(e))),
        (jb.PoissonCounts(link="identity"), 2e5, 2.01e5, stats.poisson),
        (
            jb.NegativeBinomialCounts(size=1e6),
            3.0,
            1.0,
            lambda e: stats.nbinom(1e6, 1e6 / (1e6 + np.exp(e))),
        ),
        (jb.NegativeBinomialCounts(size=np.inf), 3.0, 1.0, lambda e: stats.poisson(np.exp(e))),
        (
            jb.NegativeBinomialCounts(size=0.5),
            0.0,
            9.0,
            lambda e: stats.nbinom(0.5, 0.5 / (0.5 + np.exp(e))),
        ),
        (
            jb.NegativeBinomialCounts(size=2.0),
            9e4,
            11.0,
            lambda e: stats.nbinom(2, 2 / (2 + np.exp(e))),
        ),
        (jb.StudentT(scale=0.5, df=1e5), 0.7, 0.2, lambda e: stats.t(1e5, e, 0.5)),
        (jb.StudentT(scale=0.5, df=np.inf), 0.7, 0.2, lambda e: stats.norm(e, 0.5)),
    ],
)
def test_no_digits_are_lost_in_single_precision(model, y, eta, law):
    """The large terms of log Γ cancel."""
    y, eta = jnp.array([y], jnp.float32), jnp.array([eta], jnp.float32)
    made = model.log_density(y, eta, None, jnp.zeros(()))
    rounded, y = law(float(eta[0])), float(y[0])
    exact = (rounded.logpmf if hasattr(rounded.dist, "pmf") else rounded.logpdf)(y)
    np.testing.assert_allclose(made[0], exact, atol=3e-3)


@pytest.mark.parametrize("size", [0.5, 4.0])
def test_counts_far_from_their_mean_have_finite_derivatives(size):
    model = jb.NegativeBinomialCounts(size=size)
    of = lambda eta, y: model.log_density(jnp.array([y]), eta, None, jnp.zeros(()))[0]
    for y in (0.0, 2.0):
        for eta in (-100.0, 100.0):
            assert np.isfinite(of(jnp.array([eta]), y))
            assert np.isfinite(jax.grad(of)(jnp.array([eta]), y)).all()


def test_limits_that_are_not_there_have_finite_derivatives():
    for limits in ({"lower": 0.0}, {"upper": 0.0}):
        model = jb.Censored(scale=0.5, **limits)
        of = lambda x, y, model=model: model.correction(at_zero([y]), x, None)
        for y in (-0.1, 0.0, 0.1):
            assert np.isfinite(jax.grad(of)(jnp.array([0.3]), y)).all()
    with pytest.raises(ValueError, match="`lower` must be below"):
        jb.Censored(scale=0.5, lower=2.0, upper=1.0)
    with pytest.raises(ValueError, match="`offset` must be a number"):
        jb.PoissonCounts(offset=np.nan)


def test_missing_components_and_offsets():
    """A missing component has no scalar and no part in the correction, and its gradient is zero."""
    model = jb.PoissonCounts([[1.0, 0.0], [0.5, 1.0]], offset=lambda p: jnp.stack([p, 0.0]))
    x, p = jnp.array([0.2, -0.4]), jnp.asarray(0.7)
    total = lambda y, x, p: model.correction(at_zero(y), x, p)
    one = jb.PoissonCounts([[1.0, 0.0]], offset=0.7)
    alone = one.correction(at_zero([3.0]), x, None)
    np.testing.assert_allclose(total([3.0, np.nan], x, p), alone, rtol=1e-6)
    np.testing.assert_array_equal(model.scalars(at_zero([3.0, np.nan]), p, 2).seen, [1, 0])
    gradient = jax.grad(total, argnums=1)(jnp.array([np.nan, np.nan]), x, p)
    np.testing.assert_array_equal(gradient, 0)


NODES = np.linspace(-4, 6, 801)


def record_of(name, rng):
    """Readings of dX = -(X - 1) dt + dW, X_0 = 1, and log g at the nodes."""
    model, log_density, _ = MODELS[name]
    x, readings = 1.0, []
    draw = {
        "Poisson": lambda x: rng.poisson(np.exp(x)),
        "negative binomial": lambda x: rng.negative_binomial(4, 4 / (4 + np.exp(x))),
        "Student": lambda x: x + 0.5 * rng.standard_t(3),
        "log-normal": lambda x: np.exp(x + 0.3 * rng.normal()),
        "rounded": lambda x: np.round(x + 0.3 * rng.normal()),
        "censored": lambda x: np.clip(x + 0.4 * rng.normal(), -1, 2),
    }[name]
    for k in range(13):
        if k:
            x = 1 + (x - 1) * np.exp(-0.5) + np.sqrt((1 - np.exp(-1)) / 2) * rng.normal()
        readings.append(float(draw(x)))
    readings = np.array(readings)
    logs = np.stack([log_density(y, NODES) for y in readings])
    readings[5], logs[5] = np.nan, 0.0
    return model, readings, logs


@pytest.mark.slow
@pytest.mark.parametrize("name", ["negative binomial", "censored"])
def test_likelihood_is_that_of_the_grid(name):
    observation, readings, logs = record_of(name, np.random.default_rng(3))
    initial = np.exp(-((NODES - 1) ** 2))  # the stationary law, N(1, 1/2)
    exact = grid_filter(
        lambda x: 1 - x, lambda x: np.ones_like(x), NODES, initial, np.full(12, 0.5), logs
    )
    model = jb.ornstein_uhlenbeck([[1.0]], [1.0], [[1.0]])
    made = jb.log_likelihood(
        jax.random.key(0), model, 0.5 * np.arange(13), readings, observation=observation,
        num_steps=2, num_particles=200,
    )  # fmt: skip
    assert abs(made.value - exact.log_likelihood) < 5 * made.standard_error + 0.01
    assert made.standard_error < 0.05 and made.trustworthy, made.why()


class Binary(jb.AbstractComponents):
    """A model that is added in one place: 0 or 1, with the logit η of the probability of 1."""

    matrix: jax.Array | None = None
    offset: jb.Quantity = jb.Quantity("offset", 0.0)

    @property
    def quantities(self):
        return (self.offset,)

    def log_density(self, y, eta, params, time):
        return y * eta - jnp.logaddexp(0.0, eta)

    def guide(self, y, params, time):
        return 2 * y - 1, jnp.full_like(y, 4.0)

    def draw(self, key, eta, params, time):
        return jax.random.bernoulli(key, jax.nn.sigmoid(eta)).astype(eta.dtype)

    def check_data(self, data):
        if not np.all(np.isin(data, (0, 1))):
            raise ValueError("`observations` must be 0 or 1.")


@pytest.mark.slow
def test_a_model_of_ones_own():
    readings = np.array([1.0, 1, 0, 1, 0, 0, 1])
    logs = readings[:, None] * NODES - np.logaddexp(0, NODES)
    initial = np.exp(-((NODES - 1) ** 2))
    exact = grid_filter(
        lambda x: 1 - x, lambda x: np.ones_like(x), NODES, initial, np.full(6, 0.5), logs
    )
    model = jb.ornstein_uhlenbeck([[1.0]], [1.0], [[1.0]])
    call = lambda values: jb.log_likelihood(
        jax.random.key(0), model, 0.5 * np.arange(7), values, observation=Binary(), num_steps=2
    )
    made = call(readings)
    assert abs(made.value - exact.log_likelihood) < 5 * made.standard_error + 0.01
    with pytest.raises(ValueError, match="0 or 1"):
        call(readings + 1)
