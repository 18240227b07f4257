"""Masks of what is valid are called as the data set calls its arrays, and shaped as these are."""

import json

import numpy as np
import pytest

from adaptfault.data.recordings import open_recordings
from adaptfault.data.recordings.valid import valid_masks, write_valid
from diagnostics import Fault

h5py = pytest.importorskip("h5py")
pa = pytest.importorskip("pyarrow")
pq = pytest.importorskip("pyarrow.parquet")
zarr = pytest.importorskip("zarr")

rng = np.random.default_rng(0)
FAULTS = [Fault("open", (1, 7))]
LEFT = np.ones((2, 3), bool)
LEFT[0, 1] = False  # cell 1
RIGHT = np.ones((2, 3), bool)
RIGHT[0, 1] = False  # cell 7


def written(path, out):
    log = open_recordings(path)
    masks = valid_masks(iter(log), FAULTS, log.layout)
    write_valid(out, masks, log.names, log.layout, log.origins)
    return out


def lerobot(folder, first=3):
    """Episodes ``first``, ...; the first rows of the data set are not there."""
    names = [f"observation.tactile.{side}" for side in ("left", "right")]
    features = {name: {"dtype": "float32", "shape": [2, 3]} for name in names}
    (folder / "meta").mkdir(parents=True)
    (folder / "data").mkdir()
    (folder / "meta/info.json").write_text(json.dumps({"fps": 30, "features": features}))
    columns = {name: rng.random((8, 2, 3)).tolist() for name in names}
    columns |= {"episode_index": np.repeat([first, first + 1], 4), "index": np.arange(20, 28)}
    pq.write_table(pa.table(columns), folder / "data/file-001.parquet")
    return folder


def demos(path):
    """Groups ``demo_7`` and ``demo_10``."""
    values = {
        f"data/demo_{i}/obs/tactile_{s}": rng.random((4, 2, 3)) for i in (7, 10) for s in "lr"
    }
    if path.suffix == ".h5":
        with h5py.File(path, "w") as file:
            for name, one in values.items():
                file[name] = one
    else:
        root = zarr.open_group(path, mode="w")
        for name, one in values.items():
            root.create_array(name, data=one)
    return path


def test_in_parquet_they_have_the_features_the_shape_and_the_index_of_the_data_set(tmp_path):
    table = pq.read_table(written(lerobot(tmp_path / "set"), tmp_path / "valid.parquet"))
    assert table["episode_index"].to_pylist() == [3] * 4 + [4] * 4
    assert table["frame_index"].to_pylist() == [0, 1, 2, 3] * 2
    assert table["index"].to_pylist() == list(range(20, 28))
    for side, expected in (("left", LEFT), ("right", RIGHT)):
        got = table[f"observation.tactile.{side}.valid"].to_pylist()
        np.testing.assert_array_equal(got, [expected] * 8)


@pytest.mark.parametrize("source", [".h5", ".zarr"])
@pytest.mark.parametrize("out", [".h5", ".zarr"])
def test_in_groups_they_stand_where_the_data_set_has_them(source, out, tmp_path):
    path = written(demos(tmp_path / f"demos{source}"), tmp_path / f"valid{out}")
    root = h5py.File(path) if out == ".h5" else zarr.open_group(path, mode="r")
    assert sorted(root["data"]) == ["demo_10", "demo_7"]
    for number in (7, 10):
        for side, expected in (("l", LEFT), ("r", RIGHT)):
            got = root[f"data/demo_{number}/obs/tactile_{side}.valid"][:]
            np.testing.assert_array_equal(got, [expected] * 4)
    if out == ".h5":
        root.close()
    again = written(tmp_path / f"demos{source}", path)  # over its own
    assert again.exists()


def test_episodes_one_behind_the_other_stay_so(tmp_path):
    root = zarr.open_group(tmp_path / "set.zarr", mode="w")
    root.create_array("data/tactile", data=rng.random((9, 4, 3)))
    root.create_array("meta/episode_ends", data=np.array([4, 9]))
    path = written(tmp_path / "set.zarr", tmp_path / "valid.zarr")
    got = zarr.open_group(path, mode="r")
    assert got["meta/episode_ends"][:].tolist() == [4, 9]
    assert got["data/tactile.valid"].shape == (9, 4, 3)
    with h5py.File(written(tmp_path / "set.zarr", tmp_path / "valid.h5")) as file:
        assert file["episode_1/data/tactile.valid"].shape == (5, 4, 3)


def test_pads_of_different_shapes_keep_theirs(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["tactile_palm"] = rng.random((5, 2, 5))
        file["tactile_thumb"] = rng.random((5, 3, 3))
    with h5py.File(written(tmp_path / "a.h5", tmp_path / "valid.h5")) as file:
        assert file["tactile_palm.valid"].shape == (5, 2, 5)
        assert file["tactile_thumb.valid"].shape == (5, 3, 3)
        assert not file["tactile_palm.valid"][0, 0, 1]
        assert file["tactile_thumb.valid"][:].all()
