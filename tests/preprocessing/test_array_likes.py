"""An array of any library is one recording, wherever recordings are given."""

import numpy as np
import pytest
from conftest import SMALL
from sklearn.linear_model import LinearRegression

import adaptfault as af
from diagnostics import Monitor, SelfDiagnosis, SensorLayout, inject
from diagnostics.preprocessing.array_likes import plain_array

LAYOUT = SensorLayout(1, 2, 3, full_scale=1.0)
FRAMES = np.random.default_rng(0).random((20, 6))


class Labelled:
    """An array with names of its axes, as xarray has."""

    def __init__(self, values):
        self.values = values

    def __array__(self, dtype=None, copy=None):
        return np.asarray(self.values, dtype)

    def __iter__(self):
        return map(Labelled, self.values)

    def __len__(self):
        return len(self.values)


def torch_tensor(values):
    torch = pytest.importorskip("torch")
    return torch.tensor(values, requires_grad=True)


def data_frame(values):
    return pytest.importorskip("pandas").DataFrame(values)


KINDS = pytest.mark.parametrize("kind", [torch_tensor, data_frame, Labelled, np.ma.array])


@KINDS
@pytest.mark.parametrize("grid", [(20, 6), (20, 2, 3), (20, 1, 2, 3)])
def test_an_array_of_any_library_is_one_recording(kind, grid):
    if kind is data_frame and len(grid) > 2:
        pytest.skip("a table has two axes")
    given = kind(FRAMES.reshape(grid))
    (one,) = LAYOUT.recordings(given)
    np.testing.assert_array_equal(LAYOUT.check_recording(one), FRAMES)
    both = LAYOUT.recordings([given, given])
    np.testing.assert_array_equal([LAYOUT.check_recording(one) for one in both], [FRAMES] * 2)


@KINDS
def test_functions_answer_alike_for_arrays_of_any_library(kind):
    given = kind(FRAMES)
    fitted = SelfDiagnosis(LAYOUT).fit(given)
    assert fitted.diagnose(given).to_dict() == fitted.diagnose(FRAMES).to_dict()
    np.testing.assert_array_equal(inject(given, [], LAYOUT), FRAMES)
    np.testing.assert_array_equal(
        af.make_windows(given, None, LAYOUT).x, af.make_windows(FRAMES, None, LAYOUT).x
    )
    recordings = af.Recordings((given,), LAYOUT)
    np.testing.assert_array_equal(recordings.frames[0], FRAMES.astype(np.float32))
    monitor = Monitor(fitted, wait=True)
    monitor.update(given.iloc[0] if kind is data_frame else kind(FRAMES[0]))


def test_what_is_masked_or_not_available_is_missing():
    mask = np.zeros(FRAMES.shape, bool)
    mask[3, 2] = True
    expected = np.where(mask, np.nan, FRAMES)
    for given in (np.ma.array(FRAMES, mask=mask), [np.ma.array(FRAMES, mask=mask)]):
        (one,) = LAYOUT.recordings(given)
        np.testing.assert_array_equal(LAYOUT.check_recording(one), expected)
    counts = np.ma.array((FRAMES * 100).astype(np.int16), mask=mask)
    assert np.isnan(LAYOUT.check_recording(counts)[3, 2])
    frame = np.ma.array(FRAMES[3], mask=mask[3])
    assert np.isnan(LAYOUT.check_frame(frame)[2])
    pandas = pytest.importorskip("pandas")
    table = pandas.DataFrame(counts.data).astype("Int16")
    table.iloc[3, 2] = pandas.NA
    np.testing.assert_array_equal(np.isnan(plain_array(table)), mask)


def test_imaginary_parts_are_refused():
    with pytest.raises(ValueError, match="complex numbers: give their real part"):
        LAYOUT.check_recording(FRAMES + 1j)
    with pytest.raises(ValueError, match="complex numbers"):
        SelfDiagnosis(LAYOUT).fit(np.ma.array(FRAMES + 1j))
    with pytest.raises(ValueError, match="complex numbers"):
        LAYOUT.check_frame(FRAMES[0] + 1j)


def test_masks_and_imaginary_parts_of_windows_and_samples_are_neither_lost_nor_ignored(versions):
    rng = np.random.default_rng(0)
    x = rng.random((40, 18))
    mask = rng.random(x.shape) < 0.1
    masked = np.ma.array(x, mask=mask)
    missing = np.where(mask, np.nan, x)
    statistics = af.CellImputer([3]).fit(masked)
    expected = af.CellImputer([3]).fit(missing)
    np.testing.assert_array_equal(statistics.mean_, expected.mean_)
    for given in (masked, missing):
        np.testing.assert_array_equal(statistics.transform(given), expected.transform(missing))
    y = x[:, :2].sum(axis=1)
    one = af.FaultTolerantRegressor(LinearRegression()).fit(masked, y).set_faults([3])
    two = af.FaultTolerantRegressor(LinearRegression()).fit(missing, y).set_faults([3])
    np.testing.assert_array_equal(one.predict(masked), two.predict(missing))
    np.testing.assert_array_equal(af.correct(masked), af.correct(missing))
    windows = masked.reshape(8, 5, 18)
    labels = np.zeros(8, int)
    held = af.Windows(windows, labels, labels)
    np.testing.assert_array_equal(held.x, missing.reshape(8, 5, 18).astype(np.float32))
    adaptation = af.Adaptation.load(versions["head"])
    outputs = [adaptation.predict_proba(given) for given in (windows, missing.reshape(8, 5, 18))]
    np.testing.assert_array_equal(*outputs)
    network = af.TactileTransformer(SMALL, 2, length=5)
    refusing = (
        af.correct,
        af.CellImputer().fit,
        statistics.transform,
        lambda values: af.Windows(values.reshape(8, 5, 18), labels, labels),
        lambda values: adaptation.predict(values.reshape(8, 5, 18)),
        lambda values: network.predict(values.reshape(8, 5, 18)),
    )
    for function in refusing:
        with pytest.raises(ValueError, match=r"[Cc]omplex"):
            function(x + 1j)
