"""Guides of records of the voltage of a neuron: a few of the cells of `tests/neuron_records.py`."""

import numpy as np
import pytest
from neuron_records import cell


@pytest.mark.slow
@pytest.mark.optimised
def test_guides_are_as_near_as_the_true_path_and_filters_far_better_than_without():
    cells = [cell(0, 0, 10, 0.1, 1), cell(1, 1, 10, 0.0316, 1), cell(2, 2, 10, 0.01, 3)]
    for made in cells:
        assert made.finite_at_zero and made.finite_share >= 0.9
        assert made.residual < max(made.true_residual, 2.5)
        assert made.ratio < 0.5 and np.isfinite(made.guided_variance)
    # In the first of them some paths explode, which is told.
    assert cells[0].finite_share < 1 and not cells[0].trusted
