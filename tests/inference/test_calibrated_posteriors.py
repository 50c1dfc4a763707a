"""Default chains on records of a double well, of which some used to end where no real path has so
large a weight, or none has any: beside exact posteriors, and the parameters that made them.

`python tests/posterior_calibration.py` does the same with all 60 records."""

import numpy as np
import pytest
from posterior_calibration import posterior_of, summary

# The first ten were far off, and number 46 found no likelihood at all.
NUMBERS = [1, 7, 8, 13, 29, 32, 45, 51, 54, 46, 0, 3, 4, 10]


@pytest.mark.slow
@pytest.mark.optimised
def test_posteriors_are_calibrated():
    """Of `gibbs`; the command counts those of `pmmh`, too."""
    posteriors = [posterior_of("gibbs", number) for number in NUMBERS]
    made = summary(posteriors)
    assert made["uniform ranks, p"] > 1e-3
    assert made["rms z of means"] < 1.6 and made["largest z of means"] < 4.5
    assert made["rms z of sds"] < 1.6 and made["largest z of sds"] < 4.5
    assert made["R-hat > 1.1 and trusted"] == 0 and made["trusted"] >= 12
    assert np.all([p.standard_error < 0.3 * p.exact_sd for p in posteriors])
