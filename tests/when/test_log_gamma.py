"""The gamma and beta functions are those of scipy."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import betaln, gammaln

from diagnostics.when.log_gamma import log_beta, log_gamma

POSITIVE = st.floats(1e-6, 1e9)


@given(x=POSITIVE, b=POSITIVE)
def test_they_agree_with_scipy(x, b):
    np.testing.assert_allclose(log_gamma([x]), gammaln([x]), rtol=1e-12, atol=1e-12)
    largest = max(1.0, float(np.abs(gammaln([x, b, x + b])).max()))
    np.testing.assert_allclose(log_beta(x, b), betaln(x, b), atol=1e-11 * largest)
