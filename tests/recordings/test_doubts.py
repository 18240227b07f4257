"""What can be read, but is not what it looks like, is told in one warning."""

import numpy as np
import pytest

from adaptfault.cli import main
from adaptfault.data.recordings import load
from adaptfault.data.recordings.errors import InputError

SHAPE = (2, 3, 4)


def grasp(seed: int = 0, frames: int = 60) -> np.ndarray:
    """A contact, ``[T, 2, 3, 4]``, smooth in time."""
    rng = np.random.default_rng(seed)
    course = np.maximum(np.sin(np.linspace(0, np.pi, frames)), 0)[:, None, None, None]
    return np.round(course * rng.uniform(0.5, 4.5, SHAPE), 3)


def warnings_of(path, **stated: object) -> list[str]:
    return [str(problem) for problem in load(path, **stated).problems]


def folder(tmp_path, names, scales=(1.0,)):
    for i, name in enumerate(names):
        frames = grasp(i).reshape(60, -1) * scales[i % len(scales)]
        np.savetxt(tmp_path / f"{name}.csv", frames, "%.3f", ",")
    return tmp_path


def test_an_array_whose_last_axis_is_time_is_doubted(tmp_path):
    one_pad = np.stack([grasp(i)[:, 0] for i in range(5)])  # [n, T, rows, cols]
    np.savez(tmp_path / "right.npz", frames=one_pad)
    np.savez(tmp_path / "wrong.npz", frames=np.moveaxis(one_pad, 1, -1))
    assert not any("last axis" in text for text in warnings_of(tmp_path / "right.npz"))
    (text,) = [text for text in warnings_of(tmp_path / "wrong.npz") if "last axis" in text]
    assert "is the last axis time? Expected [n, T, rows, cols]" in text


@pytest.mark.parametrize(("full_scale", "doubted"), [(5.0, False), (30.0, False), (60.0, True)])
def test_a_full_scale_far_above_all_readings_is_doubted(tmp_path, full_scale, doubted):
    np.savez(tmp_path / "a.npz", frames=np.stack([grasp()]), full_scale=full_scale)
    told = [text for text in warnings_of(tmp_path / "a.npz") if "of the full scale" in text]
    assert bool(told) is doubted


def test_two_scales_in_one_folder_are_told_once(tmp_path):
    folder(tmp_path, [f"{i}" for i in range(12)], scales=(1.0, 819.0))
    (text,) = [
        text for text in warnings_of(tmp_path, layout=SHAPE, full_scale=5000) if "units" in text
    ]
    assert "readings of 6 files reach" in text
    assert "those of 6 others" in text


def test_one_weak_recording_among_many_is_no_other_scale(tmp_path):
    folder(tmp_path, [f"{i}" for i in range(12)], scales=(1.0,) * 11 + (0.01,))
    assert not any("units" in text for text in warnings_of(tmp_path, layout=SHAPE))


def test_classes_in_the_names_of_files_are_asked_for(tmp_path):
    folder(tmp_path, ["cup_01", "cup_02", "ball_01", "ball_02", "ball_10"])
    (text,) = [text for text in warnings_of(tmp_path, layout=SHAPE) if "classes" in text]
    assert "begin with 2 words (ball, cup)" in text


@pytest.mark.parametrize(
    "names",
    [["cup_01", "cup_02"], ["a1", "b1", "c1", "d1"], ["001", "002"], ["cup_1", "cup_2", "x"]],
)
def test_other_names_are_none(tmp_path, names):
    folder(tmp_path, names)
    assert not any("classes" in text for text in warnings_of(tmp_path, layout=SHAPE))


def test_whole_numbers_are_counts_whatever_their_type(tmp_path):
    counts = np.rint(grasp() * 200)[None]
    np.savez(tmp_path / "a.npz", frames=counts.astype(np.float64))
    layout = load(tmp_path / "a.npz").recordings.layout
    assert (layout.unit, layout.full_scale) == ("count", 1023)


def test_an_archive_without_frames_says_what_it_holds(tmp_path):
    np.savez(tmp_path / "a.npz", data=grasp(), y=np.arange(3))
    with pytest.raises(InputError, match="holds no array 'frames'; it holds data, y; save"):
        load(tmp_path / "a.npz")


def test_a_classifier_of_one_class_is_refused(tmp_path, capsys):
    frames = np.stack([grasp(i) for i in range(6)])
    np.savez(tmp_path / "a.npz", frames=frames, labels=np.zeros(6, int), class_names=["cup"])
    command = ["train", str(tmp_path / "a.npz"), "--out", str(tmp_path / "model")]
    assert main(command) == 3
    assert "all recordings are of one class, 'cup'" in capsys.readouterr().err
