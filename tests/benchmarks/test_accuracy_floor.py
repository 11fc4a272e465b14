"""The floor of the torque's error: against a closed form, and on synthetic frames of known drift."""

import math

import numpy as np
import pytest

from benchmarks.accuracy_floor import KNOWN, TOLERANCE, bound_nm, synthetic_check


def test_without_drift_the_bound_is_that_of_two_means():
    response = np.array([3.0, 4.0])
    assert bound_nm(response, 4.0, np.zeros((2, 2))) == pytest.approx(2.0 / 5.0 * math.sqrt(1.0 + 1.0 / KNOWN))


def test_drift_along_the_response_is_part_of_the_bound():
    one = np.array([1.0])
    # The last known level of a random walk and its steps to the last frame, without noise.
    assert bound_nm(one, 1e-9, np.array([[1.0]])) == pytest.approx(math.sqrt(5.0), rel=1e-3)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_the_bound_of_synthetic_frames_is_found(seed):
    found_nm, known_nm = synthetic_check(seed)
    assert found_nm == pytest.approx(known_nm, rel=TOLERANCE)
    assert found_nm < known_nm, "rather too low than too high"
