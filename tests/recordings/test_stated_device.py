"""A device that files state is kept, and compared with the one that is expected."""

from pathlib import Path

import h5py
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import adaptfault as af
from adaptfault.data.recordings import InputError, load
from diagnostics import SensorLayout

SHAPE = (1, 3, 4)


def written(path: Path, device: object) -> Path:
    """Write a recording that states its device."""
    frames = np.random.default_rng(0).integers(0, 1000, (40, *SHAPE))
    if path.suffix == ".npz":
        np.savez(path, frames=frames[None], full_scale=1023, rate=20.0, device=np.array(device))
    else:
        with h5py.File(path, "w") as file:
            file["tactile"] = frames[:, 0]
            file.attrs.update({"device_id": device, "full_scale": 1023, "rate": 20.0})
    return path


@pytest.mark.parametrize("ending", [".npz", ".h5"])
@pytest.mark.parametrize(("device", "told"), [("hand 7", "hand 7"), (7, "7")])
def test_a_device_is_read_kept_in_an_archive_and_in_the_layout(tmp_path, ending, device, told):
    read = load(written(tmp_path / f"a{ending}", device), shape="3x4").recordings
    assert read.layout.device == told
    assert SensorLayout.from_dict(read.layout.to_dict()).device == told
    af.save_npz(tmp_path / "copy.npz", read)
    assert load(tmp_path / "copy.npz").recordings.layout.device == told


@pytest.mark.parametrize("ending", [".npz", ".h5"])
def test_recordings_of_another_robot_are_refused_where_one_is_expected(tmp_path, ending):
    ours = load(written(tmp_path / f"ours{ending}", "A"), shape="3x4").recordings.layout
    with pytest.raises(InputError, match="device B where A is expected: recordings of another"):
        load(written(tmp_path / f"other{ending}", "B"), layout=ours, strict=True)
    again = load(written(tmp_path / f"again{ending}", "A"), layout=ours, strict=True)
    assert again.recordings.layout.device == "A"


def test_files_of_several_devices_are_told_and_the_layout_names_none(tmp_path):
    for name in ("A", "B"):
        written(tmp_path / f"{name}.h5", name)
    report = load(tmp_path, shape="3x4")
    assert report.recordings.layout.device is None
    told = [str(problem) for problem in report.problems]
    assert any("recordings of 2 devices: A (A.h5), B (B.h5)" in text for text in told)


@given(device=st.text(min_size=1) | st.integers() | st.booleans() | st.just(2.5))
def test_whatever_a_file_states_a_layout_takes_it_or_leaves_it(device):
    from adaptfault.data.recordings.recording import Facts

    named = Facts(Path("x"), declared={"device": device}).device
    assert named is None or SensorLayout(1, 2, 2, device=named).device == named


def test_a_device_without_a_name_is_refused():
    with pytest.raises(ValueError, match="device: expected a printable name"):
        SensorLayout(1, 2, 2, device="")
