import numpy as np
import pytest

from diagnostics.events.running_extremes import highest_so_far, lowest_so_far


@pytest.mark.parametrize("frames", [1, 2, 3, 8, 31, 32])
def test_they_equal_numpy_accumulate(frames: int, rng: np.random.Generator):
    given = rng.random((frames, 7)).astype(np.float32)
    before = given.copy()
    np.testing.assert_array_equal(lowest_so_far(given), np.minimum.accumulate(given))
    np.testing.assert_array_equal(highest_so_far(given), np.maximum.accumulate(given))
    np.testing.assert_array_equal(given, before)
