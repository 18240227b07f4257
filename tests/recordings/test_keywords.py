"""Keywords of ``load``: each option of the command line has its keyword, under its own name."""

from dataclasses import fields

import numpy as np
import pytest
from recording_files import refusal, write

from adaptfault.cli.reading import Reading
from adaptfault.data.recordings import load

GRID = np.arange(80.0).reshape(5, 16) % 7

SHAPES = [(4, 4), [4, 4], "4x4", np.array([4, 4]), (1, 4, 4)]


@pytest.mark.parametrize("shape", SHAPES, ids=str)
def test_a_shape_is_taken_by_its_own_name_in_every_form(tmp_path, shape):
    write(tmp_path / "a.csv", GRID)
    assert load(tmp_path / "a.csv", shape=shape).recordings.layout.shape == (1, 4, 4)


def test_every_option_of_reading_is_a_keyword(tmp_path):
    options = {one.name for one in fields(Reading) if one.metadata.get("section")}
    write(tmp_path / "a.csv", GRID)
    for name in options - {"shape", "layout"}:
        load(tmp_path / "a.csv", shape="4x4", **{name: None})


def test_a_misspelt_keyword_is_answered_with_the_one_that_is_meant(tmp_path):
    write(tmp_path / "a.csv", GRID)
    assert "is columns= meant?" in refusal(tmp_path / "a.csv", shape="4x4", colums="c*")


def test_a_shape_and_a_layout_are_one_too_many(tmp_path):
    write(tmp_path / "a.csv", GRID)
    assert "both given" in refusal(tmp_path / "a.csv", shape="4x4", layout="4x4")


@pytest.mark.parametrize("suffix", ["csv", "npy", "npz", "mat", "h5"])
@pytest.mark.parametrize("kind", [np.int16, np.float32, np.float64])
def test_whole_numbers_are_counts_however_they_are_stored(tmp_path, suffix, kind):
    values = np.random.default_rng(0).integers(0, 1024, (30, 4, 4)).astype(kind)
    values[3, 0, 0] = 1023
    path = tmp_path / f"a.{suffix}"
    if suffix == "csv":
        np.savetxt(path, values.reshape(30, 16), fmt="%.1f", delimiter=",")
    elif suffix == "npy":
        np.save(path, values)
    elif suffix == "npz":
        np.savez(path, frames=values[None])
    elif suffix == "mat":
        pytest.importorskip("scipy.io").savemat(path, {"pressure": values})
    else:
        with pytest.importorskip("h5py").File(path, "w") as file:
            file["pressure"] = values
    layout = load(path, shape="4x4").recordings.layout
    assert (layout.full_scale, layout.unit) == (1023, "count")
