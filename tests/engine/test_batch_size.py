"""How many lanes run side by side: within bounds, worked out by hand."""

import jax
import jax.numpy as jnp
import pytest

from jaxbridge.engine.batch_size import default_num_lanes


@pytest.mark.parametrize(
    ("num_wanted", "num_steps", "d", "expected"),
    [
        (1, 50, 2, 64),
        (1_000, 50, 2, 1_000),
        (10**6, 50, 2, 8_192),  # many lanes anyhow
        (10**6, 20, 8, 4_096),  # arrays within bounds
        (10**6, 1_000, 2, 698),  # 16 MiB
        (10**6, 50_000, 2, 256),  # more than that, for the sake of enough lanes
        (10**6, 50_000, 8, 111),  # 512 MiB
        (10**6, 10**9, 2, 1),
    ],
)
def test_on_a_cpu(num_wanted, num_steps, d, expected):
    point = jnp.zeros((1, d), jnp.float32)
    assert default_num_lanes(num_wanted, num_steps, point) == expected


@pytest.mark.parametrize(
    ("num_wanted", "num_steps", "d", "expected"),
    [
        (1_000, 50, 2, 1_000),
        (10**7, 50, 2, 2**19),
        (10**7, 50, 8, 2**17),  # arrays within bounds
        (10**6, 50_000, 2, 894),  # 1 GiB
    ],
)
def test_on_an_accelerator(num_wanted, num_steps, d, expected, monkeypatch):
    """It would idle with as few as are best for a CPU."""
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    point = jnp.zeros((1, d), jnp.float32)
    assert default_num_lanes(num_wanted, num_steps, point) == expected


def test_what_runs_on_a_cpu_beside_an_accelerator_is_bounded_as_there(monkeypatch):
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    with jax.default_device(jax.devices("cpu")[0]):
        assert default_num_lanes(10**7, 50, jnp.zeros((1, 2), jnp.float32)) == 2**13
