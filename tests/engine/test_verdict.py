"""Verdicts name each fault that is present, and only these."""

import inspect

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxbridge as jb
from jaxbridge.engine.verdict import (
    AbstractResult,
    Fault,
    Verdict,
    heavy_tails,
    heavy_tails_in_sum,
    lost_paths,
    missing_bridges,
    throw_where_untrustworthy,
)


class _Result(AbstractResult):
    value: jax.Array
    few: jax.Array

    @property
    def verdict(self):
        return Verdict((Fault(self.few, "Too few."), Fault(self.value < 0, "Negative.")))


def test_one_result():
    good, bad = _Result(jnp.array(1.0), jnp.array(False)), _Result(jnp.array(-1.0), jnp.array(True))
    assert good.trustworthy and good.why() == "No fault was found."
    assert not bad.trustworthy and bad.why() == "Too few.\nNegative."


def test_of_several_intervals_it_says_which():
    result = _Result(jnp.array([1.0, -1.0, -2.0]), jnp.array(False))
    assert result.trustworthy.tolist() == [True, False, False]
    assert result.why() == "In 2 of 3 (first [1]): Negative."


def test_inside_jit():
    result = _Result(jnp.array(-1.0), jnp.array(False))
    assert not eqx.filter_jit(lambda result: result.trustworthy)(result)
    with pytest.raises(TypeError, match="return the result"):
        eqx.filter_jit(lambda result: result.why())(result)


def test_throwing_says_the_first_fault():
    result = _Result(jnp.array(-1.0), jnp.array(False))
    with pytest.raises(Exception, match="Negative"):
        throw_where_untrustworthy(result, "value", jnp.ones(2))
    with pytest.raises(Exception, match="parameters of the model are not finite"):
        throw_where_untrustworthy(result, "value", jnp.array(jnp.nan))
    good = _Result(jnp.array(1.0), jnp.array(False))
    assert throw_where_untrustworthy(good, "value", jnp.ones(2)).value == 1


def present(faults):
    return (~Verdict(faults).trustworthy).tolist()


def test_heavy_tails():
    k = jnp.array([0.2, 0.9, 0.2, jnp.nan])
    assert present(heavy_tails(k, jnp.array([99.0, 99.0, 4.0, 99.0]))) == [0, 1, 1, 1]
    assert present(heavy_tails(k)) == [0, 1, 0, 1]


def test_heavy_tails_beside_the_effective_share():
    """Nearly equal weights may have a larger k̂ than others, very unequal ones a smaller."""
    k, number = jnp.array([0.65, 0.65, 0.8, 0.8, 1.1]), jnp.full(5, 1000)
    size = jnp.array([190.0, 210.0, 790.0, 810.0, 990.0])
    assert present(heavy_tails(k, size, number)) == [1, 0, 1, 0, 1]


def test_heavy_tails_are_reported_with_their_numbers():
    """The case, the shape, its bound and the sizes; of several intervals those of the first."""
    shape, size, number = jnp.array(0.66), jnp.array(644.0), jnp.array(300_000)
    why = Verdict(heavy_tails(shape, size, number)).why()
    numbers = "k̂ is 0.66, and its bound 0.60 for these weights; the effective sample size is"
    assert "k̂ is above its bound" in why and why.endswith(f"Here {numbers} 644 of 300,000.")
    assert "below 20" in Verdict(heavy_tails(shape, jnp.array(3.0), number)).why()
    assert Verdict(heavy_tails(shape, size, jnp.array(1000))).why() == "No fault was found."
    several = Verdict(heavy_tails(jnp.array([0.2, 0.9]), jnp.array([50.0, 1644.0]))).why()
    assert several.startswith("In 1 of 2 (first [1]): ") and "\n" not in several
    assert several.endswith(
        "In [1], k̂ is 0.90, and its bound 0.70 for these weights; the effective sample size is "
        "1,644."
    )


def test_missing_bridges_name_the_argument_of_the_caller():
    for argument in ("num_proposals", "max_proposals"):
        why = Verdict((missing_bridges(jnp.array(True), True, argument),)).why()
        assert f"`{argument}`" in why and "Guided(np.zeros((d, d)))" in why
    failed = Verdict((missing_bridges(jnp.array(True), coupled=False),)).why()
    assert "proposals" not in failed


def test_fault_in_any_entry_has_the_numbers_of_the_first():
    values = (jnp.array([[1.0, 2.0], [3.0, 4.0]]),)
    fault = Fault(jnp.array([[False, False], [True, True]]), "Large.", "it is {:.0f}", values)
    assert Verdict((fault.in_any(),)).why() == "Large. Here it is 3."
    assert Verdict((fault,)).why() == "In 2 of 4 (first [1, 0]): Large. In [1, 0], it is 3."


def test_heavy_tails_in_a_sum_are_counted():
    """Of 100 intervals two may look so by chance, unless few paths have all the weight of one."""
    k, size, number = jnp.full(100, 0.2), jnp.full(100, 99.0), jnp.full(100, 200)
    assert not heavy_tails_in_sum(k.at[:2].set(0.9), size, number).present
    assert heavy_tails_in_sum(k.at[:3].set(0.9), size, number).present
    assert heavy_tails_in_sum(k, size.at[0].set(3.0), number).present
    one = heavy_tails_in_sum(k[:1].at[0].set(0.9), size[:1], number[:1])
    assert one.present and "1 of 1 intervals" in Verdict((one,)).why()
    # Nearly equal weights have small errors whatever their tails.
    assert not heavy_tails_in_sum(k.at[:3].set(0.9), size, jnp.full(100, 105)).present


def test_every_result_has_a_verdict():
    """All public classes with a Monte Carlo error."""
    classes = [getattr(jb, name) for name in jb.__all__ if inspect.isclass(getattr(jb, name))]
    estimates = [
        cls
        for cls in classes
        if hasattr(cls, "standard_error") or "standard_error" in getattr(cls, "__annotations__", {})
    ]
    assert {"Chain", "Score", "LogLikelihood"} <= {cls.__name__ for cls in estimates}
    # A summary repeats the verdict of its posterior.
    assert all(issubclass(cls, AbstractResult) for cls in estimates if cls != jb.PosteriorSummary)


def test_lost_paths():
    assert lost_paths(jnp.array([0, 20, 21]), jnp.array(3 * [1000])).present.tolist() == [0, 0, 1]


def test_lost_paths_count_for_more_where_weights_are_unequal():
    """4 % of equal weights are 4 % of the mass, and 4 % of weights of which half are effective 8 %,
    which is told where the standard error is below that."""
    number, effective = jnp.full(5, 1000), jnp.array([1000.0, 1000.0, 500.0, 50.0, 1000.0])
    lost = jnp.array([40, 51, 40, 6, 0])
    fault = lost_paths(lost, jnp.full(5, 1000), effective, number)
    assert fault.present.tolist() == [0, 1, 1, 0, 0]


def test_numbers_that_are_not_finite_are_a_fault():
    """If there is no other, for each interval."""
    other = Verdict((Fault(jnp.array([False, True, False]), "Another."),))
    numbers = jnp.array([[1.0, 2.0], [jnp.nan, 0.0], [0.0, jnp.inf]])
    made = other.with_finite(numbers, jnp.zeros(3))
    np.testing.assert_array_equal(made.trustworthy, [True, False, False])
    another, not_finite = made.why().split("\n")
    assert "Another." in another and "(first [2])" in not_finite and "finite" in not_finite
    scalar = Verdict((Fault(jnp.array(False), "Another."),))
    assert scalar.with_finite(jnp.ones((2, 3))).trustworthy
    assert not scalar.with_finite(jnp.ones(2), numbers).trustworthy
