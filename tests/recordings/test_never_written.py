"""Parts of an array in HDF5 that nobody wrote are missing readings, though the library reads them
as 0."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from recording_files import messages, refusal

from adaptfault.data.recordings import load

h5py = pytest.importorskip("h5py")

X = np.random.default_rng(0).integers(1, 900, (60, 3, 4)).astype(np.int16)
X.flat[0] = 900


def written(path, parts, chunks=(10, 3, 4), name="tactile", values=X, **attributes):
    """Write an array of which only some parts are written."""
    with h5py.File(path, "a") as file:
        array = file.create_dataset(name, values.shape, values.dtype, chunks=chunks)
        for part in parts:
            array[part] = values[part]
        array.attrs.update(attributes)
    return path


def test_frames_behind_the_last_that_was_written_are_left_out_with_their_times(tmp_path):
    path = written(tmp_path / "a.h5", [slice(30)])
    times = np.arange(60) / 50
    written(path, [slice(30)], (15,), "time", times)
    loaded = load(path)
    np.testing.assert_array_equal(loaded.recordings.frames[0], X[:30].reshape(30, 12))
    assert loaded.recordings.layout.rate == 50
    (told,) = messages(loaded, "warning")
    assert "tactile: the last 30 frames were never written, and are left out" in told


def test_what_was_not_written_between_is_missing(tmp_path):
    path = written(tmp_path / "a.h5", [slice(20), slice(40, 60)])
    (frames,) = load(path).recordings.frames
    expected = X.reshape(60, 12).astype(float)
    expected[20:40] = np.nan
    np.testing.assert_array_equal(frames, expected)
    path = written(tmp_path / "b.h5", [np.s_[:, :, :2], np.s_[:20, :, 2:]], (10, 3, 2))
    loaded = load(path)
    expected = X.astype(float)
    expected[20:, :, 2:] = np.nan
    np.testing.assert_array_equal(loaded.recordings.frames[0], expected.reshape(60, 12))
    assert any("240 missing readings" in told for told in messages(loaded, "warning"))


@pytest.mark.parametrize("chunks", [None, (10, 3, 4)])
def test_an_array_of_which_nothing_was_written_is_none(chunks, tmp_path):
    path = written(tmp_path / "a.h5", [], chunks)
    assert "tactile was never written" in refusal(path)
    written(path, [slice(60)], name="skin/tactile")
    assert len(load(path).recordings.frames[0]) == 60


def test_episodes_end_where_nothing_was_written_any_more(tmp_path):
    path = written(tmp_path / "ends.h5", [slice(30)])
    numbers = np.repeat([1, 2, 3], 20)
    with h5py.File(path, "a") as file:
        file["episode_ends"] = [20, 40, 60]
    loaded = load(path)
    assert [len(one) for one in loaded.recordings.frames] == [20, 10]
    assert any("holds no frames" in told for told in messages(loaded, "error"))
    path = written(tmp_path / "numbers.h5", [slice(30)])
    written(path, [slice(30)], (10,), "episode_index", numbers)
    assert [len(one) for one in load(path).recordings.frames] == [20, 10]
    recordings = np.stack([X, X + 1, X + 2])
    path = written(tmp_path / "outer.h5", [slice(2)], (1, 60, 3, 4), "frames", recordings)
    assert [len(one) for one in load(path).recordings.frames] == [60, 60]


def test_the_scale_and_the_sign_of_what_was_written_stay(tmp_path):
    stored = X.astype(np.int8)
    path = written(
        tmp_path / "a.h5",
        [slice(20), slice(40, 60)],
        values=stored,
        _Unsigned="true",
        scale_factor=0.5,
    )
    (frames,) = load(path).recordings.frames
    expected = stored.view(np.uint8).reshape(60, 12) * 0.5
    expected[20:40] = np.nan
    np.testing.assert_array_equal(frames, expected)


@settings(max_examples=40, deadline=None)
@given(data=st.data(), turned=st.booleans())
def test_zeros_are_readings_where_they_were_written_and_only_there(data, turned, tmp_path_factory):
    sizes = (3, 4, 60) if turned else (60, 3, 4)
    chunks = tuple(data.draw(st.integers(2, size)) for size in sizes)
    path = tmp_path_factory.mktemp("h5") / "a.h5"
    expected = np.full(sizes, np.nan)
    with h5py.File(path, "w") as file:
        array = file.create_dataset("tactile", sizes, "f4", chunks=chunks)
        for place in np.ndindex(
            *[-(-size // chunk) for size, chunk in zip(sizes, chunks, strict=True)]
        ):
            part = tuple(
                slice(i * chunk, (i + 1) * chunk) for i, chunk in zip(place, chunks, strict=True)
            )
            if not any(place) or data.draw(st.booleans()):
                values = (X.transpose(1, 2, 0) if turned else X)[part] % 3
                array[part] = values
                expected[part] = values
    frames = np.moveaxis(expected, -1, 0) if turned else expected
    frames = frames.reshape(60, 12)
    last = np.flatnonzero(np.isfinite(frames).any(axis=1))[-1] + 1
    loaded = load(path, layout=(3, 4), full_scale=10)
    np.testing.assert_array_equal(loaded.recordings.frames[0], frames[:last])
