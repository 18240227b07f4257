"""Arrays whose last axis is the time: read along it, or asked for, in every format of arrays."""

import re

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from recording_files import messages, refusal

from adaptfault.data.recordings import load


def moving(sizes, frames, seed=0):
    """Readings [T, ...] that change little from frame to frame and much from cell to cell."""
    rng = np.random.default_rng(seed)
    phase = rng.uniform(0, 6, sizes)
    time = np.arange(frames).reshape(-1, *[1] * len(sizes)) / 15
    return (
        600 * np.clip(np.sin(time + phase), 0, None) + rng.integers(0, 3, (frames, *sizes))
    ).round()


def stored(path, array, kind=np.int16):
    """Write an array in the format of the file's name."""
    array = array.astype(kind)
    if path.suffix == ".npy":
        np.save(path, array)
    elif path.suffix == ".npz":
        np.savez(path, frames=array)
    elif path.suffix == ".mat":
        pytest.importorskip("scipy.io").savemat(path, {"pressure": array})
    else:
        with pytest.importorskip("h5py").File(path, "w") as file:
            file["pressure"] = array
    return path


@pytest.mark.parametrize("suffix", [".npy", ".npz", ".mat", ".h5"])
@settings(
    max_examples=8, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(
    sizes=st.sampled_from([(9, 5), (45,), (2, 4, 3), (16,)]),
    frames=st.integers(120, 400),
    last=st.booleans(),
    seed=st.integers(0, 9),
)
def test_the_axis_of_time_is_found_by_the_shape_or_asked_for(
    tmp_path, suffix, sizes, frames, last, seed
):
    readings = moving(sizes, frames, seed)
    array = np.moveaxis(readings, 0, -1) if last else readings
    path = stored(tmp_path / f"a{suffix}", array)
    shape = "x".join(map(str, sizes)) if len(sizes) > 1 else f"1x{sizes[0]}"
    loaded = load(path, shape=shape)
    assert any("time as its last axis" in text for text in messages(loaded, "warning")) == last
    np.testing.assert_array_equal(loaded.recordings.frames[0], readings.reshape(frames, -1))
    if last and (suffix != ".npz" or len(sizes) < 3):
        message = refusal(path)
        assert "readings change least along the last axis" in message
        hint = re.search(rf"--shape (\S+) for {frames} frames", message)[1]  # works when typed
        assert len(load(path, shape=hint).recordings.frames[0]) == frames


def test_a_shape_that_no_axes_hold_is_refused_without_the_words_of_a_library(tmp_path):
    for suffix in (".npy", ".npz", ".mat", ".h5"):
        path = stored(tmp_path / f"a{suffix}", moving((4, 4), 60))
        message = refusal(path, shape="3x4")
        assert "a" + suffix in message
        assert "3 x 4" in message
        assert "broadcast" not in message


def test_fingers_of_one_axis_stored_by_cells_are_the_pads(tmp_path):
    scipy = pytest.importorskip("scipy.io")
    readings = moving((2, 19), 300)
    scipy.savemat(
        tmp_path / "a.mat", {"F0Electrodes": readings[:, 0].T, "F1Electrodes": readings[:, 1].T}
    )
    key = "F0Electrodes,F1Electrodes"
    hint = re.search(r"--shape (\S+) for 300 frames", refusal(tmp_path / "a.mat", key=key))[1]
    loaded = load(tmp_path / "a.mat", key=key, shape=hint)
    np.testing.assert_array_equal(loaded.recordings.frames[0], readings.reshape(300, -1))


def test_short_recordings_of_many_cells_are_no_cells_by_time(tmp_path):
    path = stored(tmp_path / "a.npy", moving((9, 20), 6))
    assert load(path, shape="9x20").recordings.frames[0].shape == (6, 180)
    assert "last axis" not in refusal(path)
