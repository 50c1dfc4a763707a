"""Axes of results by name, and files of them."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
import xarray
from jaxtyping import Array, Float, PyTree

from jaxbridge.engine.verdict import AbstractResult, Fault, Verdict


class Draws(AbstractResult):
    """A result with every kind of field."""

    times: Float[Array, "*durations K"]
    _stored: Float[Array, "*I n K d"]
    theta: Float[Array, "*chains n p"]
    params: PyTree
    covariance: Float[Array, "p p"]
    missing: Float[Array, "*I n"] | None
    accepted: Float[Array, "..."]
    names: tuple[str, ...]
    num_steps: int
    varies: bool

    @property
    def stored(self):
        return 2 * self._stored

    @property
    def verdict(self):
        shape = self._stored.shape[:-3]
        return Verdict((Fault(jnp.zeros(shape, bool), "Something is wrong."),))


def made(of_intervals=(), of_chains=(4,)):
    theta = jnp.arange(10.0 * max(of_chains, default=1)).reshape(*of_chains, 5, 2)
    return Draws(
        times=jnp.zeros((*of_intervals, 3)) + jnp.arange(3.0),
        _stored=jnp.ones((*of_intervals, 7, 3, 2))[..., :5, :, :],
        theta=theta,
        params={"rate": theta[..., 0], "matrix": theta[..., None, :]},
        covariance=jnp.eye(2),
        missing=None,
        accepted=jnp.ones((2, 6)),
        names=("rate", "level"),
        num_steps=3,
        varies=True,
    )


def test_axes_have_the_names_of_annotations():
    one = made().to_xarray()
    assert one.stored.dims == ("draw", "time", "state") and np.all(one.stored == 2)
    assert one.theta.dims == ("chain", "draw", "parameter")
    assert one["params.rate"].dims == ("chain", "draw")
    assert one["params.matrix"].dims == ("chain", "draw", "params.matrix_2", "params.matrix_3")
    assert one.covariance.dims == ("parameter", "parameter_1")
    assert one.accepted.dims == ("accepted_0", "accepted_1") and one.trustworthy.dims == ()
    assert "missing" not in one and one.time.values.tolist() == [0, 1, 2]
    np.testing.assert_array_equal(one.theta.sel(parameter="rate"), one["params.rate"])
    assert one.attrs == {"num_steps": 3, "varies": 1, "why": "No fault was found."}


def test_axes_that_are_missing_or_more():
    several = made((2,), ()).to_xarray()
    assert several.stored.dims == ("interval", "draw", "time", "state")
    assert several.times.dims == ("interval", "time") and several.trustworthy.dims == ("interval",)
    assert several.theta.dims == ("draw", "parameter")
    mapped = made((3, 2)).to_xarray()
    assert mapped.stored.dims == ("interval_0", "interval_1", "draw", "time", "state")
    batch = eqx.tree_at(lambda draws: draws.covariance, made(), jnp.ones((6, 2, 2))).to_xarray()
    assert batch.covariance.dims == ("batch", "parameter", "parameter_1")


def test_files_hold_the_same_numbers(tmp_path):
    before = made().to_xarray()
    before.to_netcdf(tmp_path / "draws.nc")
    with xarray.open_dataset(tmp_path / "draws.nc") as after:
        xarray.testing.assert_identical(before, after.load())


def test_compiled_code_has_no_labels():
    with pytest.raises(TypeError, match=r"return the result from `jit`.*`to_xarray\(\)` there"):
        eqx.filter_jit(lambda result: result.to_xarray())(made())
