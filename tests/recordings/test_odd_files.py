"""A file that cannot be read as asked is named and left out; what lies beside it is read."""

import numpy as np
import pytest
from recording_files import archive, messages, refusal

from adaptfault.data.recordings import load

h5py = pytest.importorskip("h5py")
zarr = pytest.importorskip("zarr")

rng = np.random.default_rng(0)
GRID = (3, 4)


def readings(frames: int = 12, sizes: tuple[int, ...] = GRID) -> np.ndarray:
    values = rng.integers(0, 900, (frames, *sizes)).astype(np.int16)
    values.flat[:1] = 900
    return values


def episodes_of(path, recordings):
    """Write recordings into a file of the format that its name ends in."""
    if path.suffix == ".h5":
        with h5py.File(path, "w") as file:
            for i, one in enumerate(recordings):
                file[f"demo_{i}/tactile"] = one
    elif path.suffix == ".zarr":
        root = zarr.open_group(path, mode="w")
        for i, one in enumerate(recordings):
            root.create_array(f"demo_{i}/tactile", data=one)
    else:
        joined = np.concatenate(recordings)
        archive(path, frames=joined, lengths=[len(one) for one in recordings])
    return path


@pytest.mark.parametrize("suffix", [".h5", ".zarr", ".npz"])
@pytest.mark.parametrize("which", [0, 2, 4])
def test_an_episode_without_frames_is_left_out_wherever_it_stands(suffix, which, tmp_path):
    recordings = [readings(0 if i == which else 9) for i in range(5)]
    loaded = load(episodes_of(tmp_path / f"a{suffix}", recordings), layout=GRID)
    held = [one.reshape(len(one), -1) for one in recordings if len(one)]
    np.testing.assert_array_equal(np.stack(loaded.recordings.frames), held)
    (told,) = messages(loaded, "error")
    assert "holds no frames" in told


def test_what_a_library_says_reaches_nobody_and_the_good_file_is_read(tmp_path, monkeypatch):
    from adaptfault.data.recordings.formats import npy

    def fails(path, **stated):
        raise IndexError("list index\nout of range")

    monkeypatch.setattr(npy, "open", fails)
    np.save(tmp_path / "bad.npy", readings())
    assert "out of range" not in refusal(tmp_path / "bad.npy")
    archive(tmp_path / "good.npz", frames=readings()[None])
    loaded = load(tmp_path)
    assert len(loaded.recordings) == 1
    (told,) = messages(loaded, "error")
    assert "bad.npy: cannot be read (IndexError)" in told


@pytest.mark.parametrize("suffix", [".h5", ".zarr"])
@pytest.mark.parametrize("which", [0, 1])
def test_an_episode_of_another_width_is_left_out_wherever_it_stands(suffix, which, tmp_path):
    recordings = [readings(9, (2, 4) if i == which else GRID) for i in range(3)]
    loaded = load(episodes_of(tmp_path / f"a{suffix}", recordings))
    assert loaded.recordings.layout.shape == (1, *GRID)
    assert len(loaded.recordings) == 2
    (told,) = messages(loaded, "error")
    assert "8 values a frame" in told
