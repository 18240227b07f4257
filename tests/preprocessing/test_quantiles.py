"""A quantile of what is known."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays

from diagnostics.preprocessing.quantiles import known_quantile

READINGS = st.floats(-1e6, 1e6) | st.just(np.nan)


@given(
    values=arrays(float, array_shapes(min_dims=2, max_dims=2, max_side=12), elements=READINGS),
    share=st.floats(0, 1),
    axis=st.sampled_from([0, 1]),
)
def test_it_equals_numpy_where_something_is_known(values, share, axis):
    found = known_quantile(values, share, axis)
    known = (~np.isnan(values)).any(axis=axis)
    lines = values if axis == 1 else values.T
    expected = [np.nanquantile(line, share) for line in lines[known]]
    np.testing.assert_allclose(found[known], expected, rtol=1e-12, atol=1e-9)
    assert np.isnan(found[~known]).all()


@pytest.mark.parametrize("share", [0.0, 0.05, 0.25, 0.5, 0.95, 1.0])
def test_it_equals_numpy_to_the_bit_on_readings(share):
    rng = np.random.default_rng(0)
    values = rng.uniform(0, 5, (53, 40))
    values[rng.random(values.shape) < 0.1] = np.nan
    assert np.array_equal(known_quantile(values, share, 0), np.nanquantile(values, share, axis=0))
