"""Where a warm-up finds anew what guides paths."""

import pytest

from jaxbridge.inference.warm_up import stages


@pytest.mark.parametrize(
    "num_warmup, num_iterations, ends",
    [
        (800, 2000, [100, 200, 400, 2000]),
        (0, 10, [10]),  # without a warm-up there is one stage
        (3, 3, [1, 2, 3]),
    ],
)
def test_stages_end_within_the_warm_up(num_warmup, num_iterations, ends):
    assert stages(num_warmup, num_iterations) == ends
