import numpy as np
import pytest

from diagnostics.events.contact_events import so_far


@pytest.mark.parametrize("frames", [1, 2, 3, 8, 31, 32])
def test_they_equal_numpy_accumulate(frames: int, rng: np.random.Generator):
    given = rng.random((frames, 7)).astype(np.float32)
    before = given.copy()
    for extreme in (np.minimum, np.maximum):
        np.testing.assert_array_equal(so_far(extreme, given), extreme.accumulate(given))
    np.testing.assert_array_equal(given, before)
