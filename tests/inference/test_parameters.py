"""Which parameters are unknown."""

import jax
import numpy as np
import pytest

import jaxbridge as jb

MODEL = jb.Diffusion(
    lambda x, p: p["rate"] * (p["level"] - x), params={"rate": 1, "level": 2, "s": 0.5}
)
RECORD = (jax.random.key(0), MODEL, [0.0, 1.0, 2.0], [[0.0], [0.5], [0.2]])
SMALL = dict(num_iterations=2, num_steps=2, proposal=jb.Guided())
ONES = {"rate": 1, "level": 1, "s": 1}


def names(**options):
    return jb.gibbs(*RECORD, **SMALL, **options).names


@pytest.mark.slow
def test_integers_are_unknown_where_they_are_named():
    assert names(prior=jb.NormalPrior(ONES, ONES)) == ("level", "rate", "s")
    one = jb.NormalPrior(1.0, 1.0)
    assert names(prior=one, where=lambda p: (p["rate"], p["level"])) == ("rate", "level")
    assert names(prior=one, where=lambda p: p["rate"]) == ("rate",)


def test_integers_that_nobody_names_are_told():
    with pytest.warns(UserWarning, match="integers `level`, `rate` among `params` are held fixed"):
        with pytest.raises(TypeError, match="`prior`"):
            jb.gibbs(*RECORD, **SMALL, prior=3.0)


@pytest.mark.slow
def test_a_score_of_no_bridges_is_unknown():
    """Zero with an error of zero would be trusted."""
    model = jb.ornstein_uhlenbeck([[1.0]])
    score = jb.score(
        jax.random.key(0),
        model,
        [0.0, 0.01, 0.02],
        [[0.0], [30.0], [0.0]],
        where=lambda params: params.B,
        num_bridges=4,
        num_steps=4,
        max_proposals=8,
        proposal=jb.Coupling(0.0),
    )
    assert score.num_missing == 2 and not score.trustworthy
    assert np.isnan(score.gradient).all() and np.isinf(score.standard_error).all()
    assert "no pair met" in score.why()
