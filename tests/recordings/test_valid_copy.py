"""A copy of a data set says which of its readings are valid, and its statistics are of these."""

import json
import shutil

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from adaptfault.cli import main
from adaptfault.data.recordings import load, open_recordings
from adaptfault.data.recordings.formats.datasets.statistics import Statistics
from adaptfault.data.recordings.valid import valid_masks
from adaptfault.data.recordings.valid_copy import write_copy, writer_of
from diagnostics import Fault

h5py = pytest.importorskip("h5py")
pa = pytest.importorskip("pyarrow")
pq = pytest.importorskip("pyarrow.parquet")
zarr = pytest.importorskip("zarr")

LEFT = "observation.tactile.left"
RIGHT = "observation.tactile.right"
SIDES = (LEFT, RIGHT)
FAULTS = [Fault("open", (1,)), Fault("stuck", (7, 8), recordings=(1,))]
STATISTICS = ("min", "max", "mean", "std", "q01", "q50", "q99")


def copied(source, path, faults=FAULTS):
    log = open_recordings(source)
    masks = valid_masks(iter(log), faults, log.layout)
    write_copy(path, source, masks, log.layout, log.origins)
    return path


def files(folder):
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def readings():
    """Two episodes, [12, 2 features, 2, 3]; cell 1 reads 500, 7 and 8 in the second."""
    x = np.random.default_rng(0).random((12, 2, 2, 3))
    x.reshape(12, 12)[:, 1] = 500
    x.reshape(12, 12)[6:, 7:9] = 500
    return x.astype(np.float32)


def statistics_of(x, axis=0):
    quantiles = {f"q{q:02d}": np.quantile(x, q / 100, axis=axis) for q in (1, 50, 99)}
    simple = {"min": x.min(axis), "max": x.max(axis), "mean": x.mean(axis), "std": x.std(axis)}
    told = {name: value.tolist() for name, value in {**simple, **quantiles}.items()}
    return {**told, "count": [len(x)]}


def lerobot(folder, *, version="v3.0", windows=False):
    """Episodes 3 and 4 in two files, a state beside them."""
    x = readings()
    state = np.random.default_rng(1).random((12, 4)).astype(np.float32)
    for sub in ("meta/episodes/chunk-000", "data/chunk-000", "videos"):
        (folder / sub).mkdir(parents=True)
    (folder / "videos/a.mp4").write_bytes(b"film")
    about = {name: {"dtype": "float32", "shape": [2, 3], "names": None} for name in SIDES}
    about["observation.state"] = {"dtype": "float32", "shape": [4], "names": None}
    info = {"codebase_version": version, "fps": 30, "features": about}
    (folder / "meta/info.json").write_text(json.dumps(info))
    stats = {name: statistics_of(x[:, i]) for i, name in enumerate(SIDES)}
    stats["observation.state"] = statistics_of(state)
    (folder / "meta/stats.json").write_text(json.dumps(stats))
    episodes = {"episode_index": [3, 4], "length": [6, 6]}
    for number in range(2):
        rows = slice(6 * number, 6 * number + 6)
        for i, name in enumerate(SIDES):
            for which, value in statistics_of(x[rows, i]).items():
                episodes.setdefault(f"stats/{name}/{which}", []).append(value)
        columns = {name: x[rows, i].tolist() for i, name in enumerate(SIDES)}
        columns |= {"observation.state": state[rows].tolist()}
        columns |= {"episode_index": np.full(6, 3 + number), "index": np.arange(12)[rows]}
        file = folder / f"data/chunk-000/file-00{number}.parquet"
        pq.write_table(pa.table(columns), file, row_group_size=4)
    pq.write_table(pa.table(episodes), folder / "meta/episodes/chunk-000/file-000.parquet")
    return folder


def test_of_lerobot_each_frame_says_which_readings_are_valid(tmp_path):
    source = lerobot(tmp_path / "set")
    before = files(source)
    copy = copied(source, tmp_path / "copy")
    assert files(source) == before
    valid = np.ones((12, 12), bool)
    valid[:, 1] = False
    valid[6:, 7:9] = False
    for number in range(2):
        name = f"data/chunk-000/file-00{number}.parquet"
        old = pq.read_table(source / name)
        new = pq.read_table(copy / name)
        assert new.select(old.column_names).equals(old)
        got = np.stack([np.array(new[f"{one}.valid"].to_pylist()) for one in SIDES], axis=1)
        np.testing.assert_array_equal(got.reshape(6, 12), valid[6 * number : 6 * number + 6])
    features = json.loads((copy / "meta/info.json").read_text())["features"]
    assert features[f"{LEFT}.valid"] == {"dtype": "bool", "shape": [2, 3], "names": None}
    assert (copy / "videos/a.mp4").read_bytes() == b"film"
    assert files(copy).keys() == {copy / path.relative_to(source) for path in before}


def test_its_statistics_are_those_of_valid_readings(tmp_path):
    source = lerobot(tmp_path / "set")
    copy = copied(source, tmp_path / "copy")
    told = json.loads((copy / "meta/stats.json").read_text())
    before = json.loads((source / "meta/stats.json").read_text())
    assert told["observation.state"] == before["observation.state"]
    x = readings().reshape(12, 2, 6)
    right = statistics_of(x[:6, 1])  # cells 7 and 8 are faulty in the other episode
    whole = statistics_of(x[:, 1])
    left = statistics_of(x[:, 0])
    for which in STATISTICS:
        expected = np.array(left[which])
        expected[1] = np.median(np.delete(expected, 1))  # it has no valid reading
        np.testing.assert_allclose(np.ravel(told[LEFT][which]), expected, rtol=1e-5)
        expected = np.array(whole[which])
        expected[1:3] = np.array(right[which])[1:3]
        np.testing.assert_allclose(np.ravel(told[RIGHT][which]), expected, rtol=1e-5)
    assert np.shape(told[LEFT]["mean"]) == (2, 3)
    assert told[LEFT]["count"] == [12]
    assert told[f"{LEFT}.valid"]["mean"] == [[1, 0, 1], [1, 1, 1]]
    episodes = pq.read_table(copy / "meta/episodes/chunk-000/file-000.parquet").to_pydict()
    np.testing.assert_allclose(np.ravel(episodes[f"stats/{RIGHT}/max"][0]), right["max"], rtol=1e-6)
    assert np.max(episodes[f"stats/{RIGHT}/max"][1]) < 1


def without_invalid(source, faults=FAULTS):
    """The recordings of a data set, in which readings that are not valid are missing."""
    log = open_recordings(source)
    masks = valid_masks(iter(log), faults, log.layout)
    return [np.where(mask, one, np.nan) for one, mask in zip(log, masks, strict=True)]


def test_the_copy_is_read_as_the_data_set_without_the_readings_that_are_not_valid(tmp_path):
    source = lerobot(tmp_path / "set")
    after = load(copied(source, tmp_path / "copy"))
    assert after.recordings.layout.full_scale == 1.0  # of dead cells 500
    assert any("missing readings" in str(one) for one in after.problems)
    for old, new in zip(without_invalid(source), after.recordings.frames, strict=True):
        assert np.isnan(old).any()
        np.testing.assert_array_equal(old, new)


def test_a_mask_of_another_shape_is_none(tmp_path):
    table = {"tactile": [[1.0, 2.0]] * 3, "tactile.valid": [[False]] * 3}
    pq.write_table(pa.table(table), tmp_path / "set.parquet")
    (frames,) = load(tmp_path / "set.parquet", shape="1x2").recordings.frames
    np.testing.assert_array_equal(frames, [[1.0, 2.0]] * 3)


def test_whole_numbers_with_a_mask_keep_what_they_count(tmp_path):
    counts = np.arange(24, dtype=np.uint16).reshape(4, 6) * 100
    mask = counts != 700
    with h5py.File(tmp_path / "set.h5", "w") as file:
        file["tactile"] = counts
        file["tactile.valid"] = mask
    loaded = load(tmp_path / "set.h5", shape="2x3")
    np.testing.assert_array_equal(
        loaded.recordings.frames[0], np.where(mask, counts.astype(float), np.nan)
    )


def test_statistics_of_each_episode_in_lines_are_those_of_valid_readings(tmp_path):
    source = lerobot(tmp_path / "set", version="v2.1")
    x = readings()
    lines = [
        {"episode_index": 3 + n, "stats": {RIGHT: statistics_of(x[6 * n : 6 * n + 6, 1])}}
        for n in range(2)
    ]
    path = "meta/episodes_stats.jsonl"
    (source / path).write_text("\n".join(map(json.dumps, lines)))
    copy = copied(source, tmp_path / "copy")
    told = [json.loads(line) for line in (copy / path).read_text().splitlines()]
    assert [one["episode_index"] for one in told] == [3, 4]
    assert np.max(told[1]["stats"][RIGHT]["max"]) < 1
    assert f"{RIGHT}.valid" in told[0]["stats"]


def test_an_episode_that_was_not_read_is_not_valid(tmp_path):
    source = lerobot(tmp_path / "set")
    log = open_recordings(source)
    masks = [next(iter(valid_masks(iter(log), [], log.layout)))]
    write_copy(tmp_path / "copy", source, iter(masks), log.layout, log.origins[:1])
    for number, expected in ((0, True), (1, False)):
        table = pq.read_table(tmp_path / f"copy/data/chunk-000/file-00{number}.parquet")
        got = np.array(table[f"{LEFT}.valid"].to_pylist())
        assert got.shape == (6, 2, 3)
        assert (got == expected).all()


@pytest.mark.parametrize(
    "path", ["data/chunk-000/file-001.parquet", "meta/stats.json", "meta/episodes_stats.jsonl"]
)
def test_a_damaged_file_of_the_data_set_is_named_and_no_copy_is_left(path, tmp_path):
    source = lerobot(tmp_path / "set")
    log = open_recordings(source)
    masks = list(valid_masks(iter(log), [], log.layout))
    (source / path).write_bytes(b"PAR1 {")
    with pytest.raises(ValueError, match=rf"{path.rpartition('/')[2]}: (is no|cannot be read)"):
        write_copy(tmp_path / "copy", source, iter(masks), log.layout, log.origins)
    assert [one.name for one in tmp_path.iterdir()] == ["set"]


def test_windows_of_a_faster_stream_keep_their_shape(tmp_path):
    (tmp_path / "set/meta").mkdir(parents=True)
    (tmp_path / "set/data").mkdir()
    about = {LEFT: {"dtype": "float32", "shape": [5, 6]}}
    info = {"fps": 30, "features": about}
    (tmp_path / "set/meta/info.json").write_text(json.dumps(info))
    x = np.random.default_rng(0).random((8, 5, 6))
    table = pa.table({LEFT: x.tolist(), "episode_index": np.repeat([0, 1], 4)})
    pq.write_table(table, tmp_path / "set/data/file-000.parquet")
    log = open_recordings(tmp_path / "set", shape="2x3")
    masks = valid_masks(iter(log), [Fault("open", (1,))], log.layout)
    write_copy(tmp_path / "copy", tmp_path / "set", masks, log.layout, log.origins)
    got = np.array(
        pq.read_table(tmp_path / "copy/data/file-000.parquet")[f"{LEFT}.valid"].to_pylist()
    )
    assert got.shape == (8, 5, 6)
    assert not got[:, :, 1].any()
    assert np.delete(got, 1, axis=2).all()
    frames = np.concatenate(list(open_recordings(tmp_path / "copy", shape="2x3")))
    np.testing.assert_array_equal(np.isnan(frames), ~got.reshape(-1, 6))


def demos(path):
    """Groups ``demo_7`` and ``demo_10``; or episodes one behind the other."""
    x = readings()
    if path.suffix == ".parquet":
        columns = {name: x[:, i].tolist() for i, name in enumerate(SIDES)}
        pq.write_table(pa.table({**columns, "episode_index": np.repeat([3, 4], 6)}), path)
        return path
    named = {
        f"data/demo_{7 + 3 * n}/obs/tactile_{side}": x[6 * n : 6 * n + 6, i]
        for n in range(2)
        for i, side in enumerate("lr")
    }
    root = h5py.File(path, "w") if path.suffix == ".h5" else zarr.open_group(path, mode="w")
    for name, one in named.items():
        root.create_dataset(name, data=one) if path.suffix == ".h5" else root.create_array(
            name, data=one
        )
    if path.suffix == ".h5":
        root.close()
    return path


def arrays_of(path):
    """All arrays of a file by name."""
    if path.suffix == ".parquet":
        table = pq.read_table(path)
        return {name: np.array(table[name].to_pylist()) for name in table.column_names}
    found = {}
    if path.suffix == ".h5":
        with h5py.File(path) as file:
            file.visititems(
                lambda name, one: found.update({name: one[()]} if hasattr(one, "shape") else {})
            )
        return found
    root = zarr.open_group(path, mode="r")
    return {name: one[:] for name, one in root.members(max_depth=None) if hasattr(one, "shape")}


@pytest.mark.parametrize("ending", [".parquet", ".h5", ".zarr"])
def test_of_other_formats_the_masks_stand_beside_the_arrays(ending, tmp_path):
    source = demos(tmp_path / f"set{ending}")
    before = arrays_of(source)
    copy = copied(source, tmp_path / f"copy{ending}")
    after = arrays_of(copy)
    for name, one in before.items():
        np.testing.assert_array_equal(after[name], one)
    masks = {name: one for name, one in after.items() if name not in before}
    touch = [name for name in before if "tactile" in name]
    assert set(masks) == {f"{name}.valid" for name in touch}
    for name in touch:
        assert masks[f"{name}.valid"].shape == before[name].shape
        np.testing.assert_array_equal(masks[f"{name}.valid"], before[name] != 500)
    for old, new in zip(without_invalid(source), open_recordings(copy), strict=True):
        np.testing.assert_array_equal(old, new)


def test_a_copy_that_would_fill_the_disk_is_not_begun(tmp_path, monkeypatch):
    source = demos(tmp_path / "set.h5")
    before = files(tmp_path)
    usage = shutil.disk_usage(tmp_path)._replace(free=1000)
    monkeypatch.setattr(shutil, "disk_usage", lambda path: usage)
    with pytest.raises(OSError, match="No space left on device"):
        copied(source, tmp_path / "copy.h5")
    assert files(tmp_path) == before


def test_episodes_one_behind_the_other_have_one_mask(tmp_path):
    root = zarr.open_group(tmp_path / "set.zarr", mode="w", zarr_format=2)
    root.create_array("data/tactile", data=readings()[:, 0])
    root.create_array("meta/episode_ends", data=np.array([6, 12]))
    zarr.consolidate_metadata(tmp_path / "set.zarr", zarr_format=2)
    copy = copied(tmp_path / "set.zarr", tmp_path / "copy.zarr", [Fault("short", (1,))])
    held = zarr.open_group(copy, mode="r", use_consolidated=True)
    np.testing.assert_array_equal(held["data/tactile.valid"][:], readings()[:, 0] != 500)


def test_what_cannot_be_copied_is_refused_and_nothing_is_left_behind(tmp_path):
    source = lerobot(tmp_path / "set")
    with pytest.raises(ValueError, match="is there already; name a copy that is not"):
        copied(source, source)
    np.save(tmp_path / "a.npy", readings().reshape(12, 12))
    with pytest.raises(ValueError, match=r"expected a LeRobot data set.*--write-valid"):
        writer_of(tmp_path / "b.npy", tmp_path / "a.npy")
    log = open_recordings(source)
    masks = list(valid_masks(iter(log), [], log.layout))
    masks[1] = masks[1][:-1]
    with pytest.raises(ValueError, match="episode 4 has 6 rows and 5 frames"):
        write_copy(tmp_path / "copy", source, iter(masks), log.layout, log.origins)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.npy", "set"]


@pytest.mark.parametrize("shape", [(2, 3), (3,), (1,), ()])
def test_statistics_have_the_shape_that_they_had(shape):
    """LeRobot's own writer takes the rows of a frame together."""
    rng = np.random.default_rng(0)
    x = rng.normal(10, 1, (50, 2, 3))
    valid = rng.random(x.shape) < 0.7
    of = Statistics((2, 3))
    of.add(x, valid)
    told = of.as_told(dict.fromkeys(STATISTICS, np.zeros(shape).tolist()))
    held = np.where(valid, x, np.nan).reshape(-1, *shape) if shape else np.where(valid, x, np.nan)
    axis = 0 if shape else None
    expected = {"min": np.nanmin, "max": np.nanmax, "mean": np.nanmean, "std": np.nanstd}
    for name in STATISTICS:
        of_all = expected.get(
            name, lambda y, axis, q=name: np.nanquantile(y, int(q[1:]) / 100, axis)
        )
        np.testing.assert_allclose(told[name], of_all(held, axis=axis), atol=1e-9)
    assert of.as_told({"mean": [1.0, 2.0]}) == {"mean": [1.0, 2.0]}  # of something else


@given(
    st.integers(0, 2**32),
    st.integers(1, 40),
    st.lists(st.integers(1, 39), max_size=4),
    st.floats(0, 0.9),
)
def test_statistics_are_the_same_however_the_frames_are_divided(seed, n, cuts, missing):
    rng = np.random.default_rng(seed)
    x = rng.normal(10, 1, (n, 2, 3))
    valid = rng.random(x.shape) >= missing
    of = Statistics((2, 3))
    for part in np.split(np.arange(n), sorted({cut for cut in cuts if cut < n})):
        of.add(x[part], valid[part])
    held = np.where(valid, x, np.nan)
    seen = valid.any(axis=0)
    before = dict.fromkeys(STATISTICS, np.full((2, 3), -1.0).tolist())
    told = of.as_told({**before, "count": [n], "other": 3})
    assert (told["count"], told["other"]) == ([n], 3)
    if not seen.any():
        assert told["mean"] == before["mean"]
        return
    expected = {"min": np.nanmin, "max": np.nanmax, "mean": np.nanmean, "std": np.nanstd}
    for name in STATISTICS:
        got = np.array(told[name])
        of_seen = held[:, seen]
        known = expected.get(name)
        if known is None:
            right = np.nanquantile(of_seen, int(name[1:]) / 100, axis=0)
        else:
            right = known(of_seen, axis=0)
        np.testing.assert_allclose(got[seen], right, atol=1e-9)
        np.testing.assert_allclose(got[~seen], np.median(right), atol=1e-9)


def test_check_writes_the_copy(tmp_path, capsys):
    source = lerobot(tmp_path / "set")
    options = ["check", str(source), "--quiet", "--write-copy"]
    assert main([*options, str(tmp_path / "copy")]) in (0, 1, 2)
    assert (tmp_path / "copy/meta/info.json").is_file()
    capsys.readouterr()
    assert main([*options, str(tmp_path / "copy")]) == 3
    assert "is there already" in capsys.readouterr().err
    assert main([*options, str(source / "copy")]) == 3
    shutil.copytree(source, tmp_path / "other")
    several = ["check", str(source), str(tmp_path / "other"), "--write-copy"]
    assert main([*several, str(tmp_path / "new")]) == 3
    assert "one data set" in capsys.readouterr().err
