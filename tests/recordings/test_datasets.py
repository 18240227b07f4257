"""Data sets of robot learning and of laboratories, written by the libraries of their formats."""

import json
import math
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest
import scipy.io

from adaptfault.cli import main
from adaptfault.data.recordings import load
from adaptfault.data.recordings.errors import InputError
from adaptfault.data.recordings.formats.datasets.features import Pads, choose
from adaptfault.data.recordings.readers import reader_of, readers

h5py = pytest.importorskip("h5py")
pa = pytest.importorskip("pyarrow")
pq = pytest.importorskip("pyarrow.parquet")
zarr = pytest.importorskip("zarr")

GRID = (3, 4)


def episodes(n: int = 4, grid: tuple[int, ...] = GRID, length: int = 30) -> list[np.ndarray]:
    """Readings ``[T, ...]``, another length in each."""
    rng = np.random.default_rng(0)
    return [
        rng.integers(0, 1000, (length + 3 * i, *grid)).astype(np.float32) / 1000 for i in range(n)
    ]


def flat(recording: np.ndarray) -> np.ndarray:
    return recording.reshape(len(recording), -1)


def check(path: Path, expected: list[np.ndarray], shape: tuple[int, ...], **stated: object) -> None:
    """The recordings are those that were written."""
    loaded = load(path, **stated)
    assert not [problem for problem in loaded.problems if problem.level == "error"]
    recordings = loaded.recordings
    assert recordings.layout.shape == shape
    assert len(recordings) == len(expected)
    for got, written in zip(recordings, expected, strict=True):
        np.testing.assert_array_equal(got, flat(written))


# LeRobot


def lerobot(
    folder: Path,
    features: dict[str, list[np.ndarray]],
    *,
    version: str = "v3.0",
    dtypes: dict[str, str] | None = None,
) -> Path:
    """Write a data set as LeRobot lays it out."""
    first = next(iter(features.values()))
    about = {
        name: {
            "dtype": (dtypes or {}).get(name, "float32"),
            "shape": list(given[0].shape[1:]),
            "names": None,
        }
        for name, given in features.items()
    }
    for name, dtype in (("timestamp", "float32"), ("episode_index", "int64")):
        about[name] = {"dtype": dtype, "shape": [1], "names": None}
    about["observation.images.front"] = {"dtype": "video", "shape": [3, 48, 64], "names": None}
    (folder / "meta").mkdir(parents=True)
    info = {"codebase_version": version, "fps": 50, "features": about}
    (folder / "meta/info.json").write_text(json.dumps(info))
    if version == "v3.0":
        tasks = pa.table({"task_index": [0, 1], "__index_level_0__": ["pick", "place"]})
        pq.write_table(tasks, folder / "meta/tasks.parquet")
    else:
        lines = [{"task_index": 0, "task": "pick"}, {"task_index": 1, "task": "place"}]
        (folder / "meta/tasks.jsonl").write_text("\n".join(map(json.dumps, lines)))
    data = folder / "data/chunk-000"
    data.mkdir(parents=True)
    tables = []
    for i, one in enumerate(first):
        n = len(one)
        columns = {name: pa.array(given[i].tolist()) for name, given in features.items()}
        columns |= {
            "timestamp": pa.array(np.arange(n, dtype=np.float32) / 50),
            "episode_index": pa.array([i] * n),
            "frame_index": pa.array(range(n)),
            "task_index": pa.array([i % 2] * n),
        }
        tables.append(pa.table(columns))
        if version != "v3.0":
            pq.write_table(tables[-1], data / f"episode_{i:06d}.parquet")
    if version == "v3.0":  # several episodes a file
        half = len(tables) // 2
        for number, part in enumerate((tables[:half], tables[half:])):
            pq.write_table(pa.concat_tables(part), data / f"file-{number:03d}.parquet")
    return folder


@pytest.mark.parametrize("version", ["v3.0", "v2.1"])
def test_lerobot_episodes_are_recordings_and_their_tasks_are_classes(tmp_path, version):
    touch = episodes()
    state = [np.zeros((len(one), 7), np.float32) for one in touch]
    path = lerobot(
        tmp_path / "set",
        {"observation.tactile.left": touch, "observation.state": state, "action": state},
        version=version,
    )
    check(path, touch, (1, *GRID))
    recordings = load(path).recordings
    assert recordings.layout.rate == 50
    assert recordings.class_names == ("pick", "place")
    assert recordings.labels.tolist() == [0, 1, 0, 1]
    assert recordings.names[3].endswith("episode 3")


def test_info_of_a_lerobot_set_waits_for_no_package_that_it_does_not_need(tmp_path):
    path = lerobot(tmp_path / "set", {"observation.tactile.left": episodes()})
    code = (
        "import sys; from adaptfault.cli import main; main(sys.argv[1:]);"
        "sys.exit(str({'pandas', 'scipy', 'sklearn', 'torch', 'tqdm'} & sys.modules.keys()))"
    )
    told = subprocess.run(
        [sys.executable, "-c", code, "info", str(path)], capture_output=True, text=True, check=False
    )
    assert "4 of" in told.stdout
    assert told.stderr.splitlines()[-1] == "set()"


def test_lerobot_pads_of_different_shapes_are_one_layout(tmp_path):
    thumb = episodes(grid=(3, 3))
    palm = episodes(grid=(2, 5))
    path = lerobot(
        tmp_path / "set", {"observation.tactile.thumb": thumb, "observation.tactile.palm": palm}
    )
    recordings = load(path).recordings
    layout = recordings.layout
    assert layout.shape == (2, 3, 5)  # in natural order of their names: palm, thumb
    assert layout.present.sum() == 19
    grid = layout.grid(recordings.frames[2])
    np.testing.assert_array_equal(grid[:, 0, :2], palm[2])
    np.testing.assert_array_equal(grid[:, 1, :, :3], thumb[2])
    assert not grid[:, ~layout.present].any()


def test_lerobot_touch_in_windows_is_the_faster_stream_that_it_was(tmp_path):
    fast = episodes(n=2, grid=(12,), length=100)
    windows = [one[: len(one) // 5 * 5].reshape(-1, 5, 12) for one in fast]
    path = lerobot(tmp_path / "set", {"tactile": windows})
    expected = [one.reshape(-1, 12) for one in windows]
    check(path, expected, (1, 3, 4), layout="3x4")
    assert load(path, layout="3x4").recordings.layout.rate == 250


def test_a_lerobot_data_set_without_touch_says_what_it_holds(tmp_path):
    state = [np.full((9, 7), 0.5, np.float32)] * 2
    action = [np.zeros((9, 6), np.float32)] * 2
    path = lerobot(tmp_path / "set", {"observation.state": state, "action": action})
    with pytest.raises(InputError, match=r"action \[6\].*observation.state \[7\].*--key") as told:
        load(path)
    assert len(str(told.value).splitlines()) == 1
    check(path, state, (1, 1, 7), key="observation.state", layout="1x1x7")


def test_two_features_that_could_be_meant_are_named(tmp_path):
    touch = episodes(n=2)
    path = lerobot(tmp_path / "set", {"tactile": touch, "pressure": touch})
    with pytest.raises(InputError, match=r"pressure \[3, 4\], tactile \[3, 4\]; name one with"):
        load(path)
    check(path, touch, (1, *GRID), key="pressure")


@pytest.mark.parametrize("other", ["tactile_filtered", "pressure"])
def test_two_arrays_that_could_be_meant_are_no_pads(other, tmp_path):
    (touch,) = episodes(n=1)
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["tactile"] = touch
        file[other] = touch
    message = r"a\.h5: several features could hold the readings of touch: .*; name one with --key"
    with pytest.raises(InputError, match=message):
        load(tmp_path / "a.h5")
    check(tmp_path / "a.h5", [touch], (1, *GRID), key="tactile")


def test_of_a_data_set_with_a_truncated_file_the_other_episodes_are_read(tmp_path):
    touch = episodes()
    path = lerobot(tmp_path / "set", {"tactile": touch})
    file = path / "data/chunk-000/file-000.parquet"
    file.write_bytes(file.read_bytes()[:-200])
    loaded = load(path)
    assert len(loaded.recordings) == 2
    (error,) = [problem.message for problem in loaded.problems if problem.level == "error"]
    assert "file-000.parquet: is no Parquet file, or is cut off" in error


# Parquet


def test_parquet_with_a_list_column_is_divided_by_its_episodes(tmp_path):
    touch = episodes(n=3, grid=(6,))
    n = [len(one) for one in touch]
    table = pa.table(
        {
            "stamp_ms": np.concatenate([np.arange(k) * 10.0 for k in n]),
            "tactile": np.concatenate(touch).tolist(),
            "recording": np.repeat([4, 5, 6], n),
            "label": np.repeat(["cup", "ball", "cup"], n).tolist(),
        }
    )
    pq.write_table(table, tmp_path / "a.parquet", row_group_size=17)
    check(tmp_path / "a.parquet", touch, (1, 2, 3), layout="2x3")
    recordings = load(tmp_path / "a.parquet", layout="2x3").recordings
    assert recordings.layout.rate == pytest.approx(100)
    assert [recordings.class_names[label] for label in recordings.labels] == ["cup", "ball", "cup"]


def test_parquet_with_a_column_a_cell_is_one_recording(tmp_path):
    (touch,) = episodes(n=1, grid=(6,))
    columns = {f"cell_{i}": touch[:, i] for i in range(6)}
    times = np.datetime64("2026-01-01T00:00:00", "us") + np.arange(len(touch)) * 20_000
    pq.write_table(pa.table({"timestamp": times, **columns}), tmp_path / "a.parquet")
    check(tmp_path / "a.parquet", [touch], (1, 2, 3), layout="2x3")
    assert load(tmp_path / "a.parquet", layout="2x3").recordings.layout.rate == pytest.approx(50)


def test_parquet_with_lists_of_different_lengths_says_so(tmp_path):
    pq.write_table(pa.table({"tactile": [[1.0, 2.0], [1.0]]}), tmp_path / "a.parquet")
    with pytest.raises(
        InputError, match="row 1: tactile holds a list of 1 where the first row has 2"
    ):
        load(tmp_path / "a.parquet")


# Times and classes where no built-in name fits


def lerobot_named(path: Path, touch: list[np.ndarray]) -> Path:
    extra = {
        "touch": touch,
        "elapsed_ms": [np.arange(len(one), dtype=np.float32) * 10 for one in touch],
        "kind": [np.full((len(one), 1), i % 2, np.float32) for i, one in enumerate(touch)],
    }
    return lerobot(path / "set", extra)


def parquet_named(path: Path, touch: list[np.ndarray]) -> Path:
    tables = [
        pa.table(
            {
                "tactile": pa.array(one.tolist()),
                "trial": pa.array([i] * len(one)),
                "elapsed_ms": pa.array(np.arange(len(one)) * 10),
                "kind": pa.array([f"{i % 2}.0"] * len(one)),
            }
        )
        for i, one in enumerate(touch)
    ]
    pq.write_table(pa.concat_tables(tables), path / "a.parquet")
    return path / "a.parquet"


def jsonl_named(path: Path, touch: list[np.ndarray]) -> Path:
    lines = [
        {"tactile": frame.tolist(), "trial": i, "elapsed_ms": 10 * t, "kind": f"{i % 2}.0"}
        for i, one in enumerate(touch)
        for t, frame in enumerate(one)
    ]
    (path / "a.jsonl").write_text("\n".join(map(json.dumps, lines)) + "\n")
    return path / "a.jsonl"


def hdf5_named(path: Path, touch: list[np.ndarray]) -> Path:
    with h5py.File(path / "a.h5", "w") as file:
        for i, one in enumerate(touch):
            group = file.create_group(f"demo_{i}")
            group["tactile"] = one
            group["elapsed_ms"] = np.arange(len(one)) * 10
            group.attrs["kind"] = f"{i % 2}.0"
    return path / "a.h5"


def zarr_named(path: Path, touch: list[np.ndarray]) -> Path:
    store(path / "a.zarr", touch)
    root = zarr.open_group(path / "a.zarr", mode="a")
    times = np.concatenate([np.arange(len(one)) * 10 for one in touch])
    kinds = np.concatenate([np.full(len(one), i % 2, np.float32) for i, one in enumerate(touch)])
    root["data"].create_array("elapsed_ms", data=times)
    root["data"].create_array("kind", data=kinds)
    return path / "a.zarr"


NAMED = pytest.mark.parametrize(
    "write", [lerobot_named, parquet_named, jsonl_named, hdf5_named, zarr_named]
)


@NAMED
def test_times_and_classes_are_where_the_user_says(write, tmp_path):
    touch = episodes(n=3, grid=(6,))
    path = write(tmp_path, touch)
    options = {"layout": "2x3", "time_column": "elapsed_ms", "label_column": "kind"}
    check(path, touch, (1, 2, 3), **options)
    loaded = load(path, **options)
    recordings = loaded.recordings
    assert [recordings.class_names[label] for label in recordings.labels] == ["0.0", "1.0", "0.0"]
    times = [block.times for block in loaded_blocks(path, **options)]
    np.testing.assert_array_equal(times[0], np.arange(30) * 10.0)


def loaded_blocks(path: Path, **options: object) -> list:
    """The first block of each recording, as its reader gives it."""
    known = readers()
    reader = reader_of(path, known, is_folder=path.is_dir())
    found = reader.open(path, **{**options, "shape": (1, 2, 3)})
    blocks = [next(iter(one.blocks())) for one in found]
    assert {block.tick for block in blocks} == {"ms"}
    return blocks


@NAMED
@pytest.mark.parametrize("option", ["time_column", "label_column"])
def test_a_name_of_times_or_classes_that_is_not_there_is_told_with_those_that_are(
    write, option, tmp_path
):
    path = write(tmp_path, episodes(n=2, grid=(6,)))
    words = f"--{option.replace('_', '-')} wrong: .*elapsed_ms"
    with pytest.raises(InputError, match=words):
        load(path, layout="2x3", **{option: "wrong"})


# Zarr


def store(place: Path, touch: list[np.ndarray], version: int = 2) -> None:
    """Write episodes one behind the other, as UMI does."""
    root = zarr.open_group(place, mode="w", zarr_format=version)
    data = root.create_group("data")
    joined = np.concatenate(touch)
    data.create_array("left_tactile_data", data=joined, chunks=(32, *joined.shape[1:]))
    data.create_array("robot0_eef_pos", data=np.zeros((len(joined), 3), np.float32))
    data.create_array("timestamp", data=np.arange(len(joined)) / 32)
    ends = np.cumsum([len(one) for one in touch])
    root.create_group("meta").create_array("episode_ends", data=ends)


@pytest.mark.parametrize("version", [2, 3])
def test_zarr_is_divided_by_episode_ends(tmp_path, version):
    touch = episodes()
    store(tmp_path / "set.zarr", touch, version)
    check(tmp_path / "set.zarr", touch, (1, *GRID))
    check(tmp_path, touch, (1, *GRID))  # found in a folder, too
    assert load(tmp_path / "set.zarr").recordings.layout.rate == pytest.approx(32)


def test_a_zipped_zarr_is_read(tmp_path):
    touch = episodes()
    store(tmp_path / "set.zarr", touch)
    with zipfile.ZipFile(tmp_path / "other.zarr.zip", "w") as archive:
        for file in sorted((tmp_path / "set.zarr").rglob("*")):
            archive.write(file, file.relative_to(tmp_path / "set.zarr"))
    check(tmp_path / "other.zarr.zip", touch, (1, *GRID))
    (tmp_path / "cut.zarr.zip").write_bytes((tmp_path / "other.zarr.zip").read_bytes()[:900])
    with pytest.raises(InputError, match=r"cut\.zarr\.zip: is no Zarr store, or is damaged"):
        load(tmp_path / "cut.zarr.zip")


def test_of_a_zarr_with_a_damaged_chunk_the_other_episodes_are_read(tmp_path):
    touch = episodes(n=6)
    store(tmp_path / "set.zarr", touch)
    (tmp_path / "set.zarr/data/left_tactile_data/0.0.0").write_bytes(b"no chunk")
    loaded = load(tmp_path / "set.zarr")
    assert len(loaded.recordings) == 4  # the chunk holds 32 frames, the first episode 30
    np.testing.assert_array_equal(loaded.recordings.frames[0], flat(touch[2]))
    errors = [problem.message for problem in loaded.problems if problem.level == "error"]
    assert len(errors) == 2
    assert "episode 0, frames 0 to 29: cannot be read" in errors[0]


def test_episode_ends_that_do_not_fit_are_refused(tmp_path):
    store(tmp_path / "set.zarr", episodes(n=2))
    root = zarr.open_group(tmp_path / "set.zarr", mode="a")
    root["meta/episode_ends"][:] = [30, 900]
    with pytest.raises(InputError, match="ends at frame 900, but the readings hold 63"):
        load(tmp_path / "set.zarr")


# HDF5 and MAT


def test_hdf5_with_a_file_an_episode_is_read_from_a_folder(tmp_path):
    touch = episodes(n=3)
    for i, one in enumerate(touch):
        with h5py.File(tmp_path / f"episode_{i}.hdf5", "w") as file:
            file.create_dataset("observations/tactile", data=one)
            file.create_dataset("observations/qpos", data=np.zeros((len(one), 14)))
            file.attrs["fps"] = 60
    check(tmp_path, touch, (1, *GRID))
    assert load(tmp_path).recordings.layout.rate == 60


def test_hdf5_with_a_group_an_episode_is_read_with_its_labels(tmp_path):
    touch = episodes(n=11)
    with h5py.File(tmp_path / "demo.h5", "w") as file:
        for i, one in enumerate(touch):
            group = file.create_group(f"data/demo_{i}")
            group.create_dataset("obs/tactile", data=one)
            group.create_dataset("actions", data=np.zeros((len(one), 7)))
            group.attrs["label"] = ["cup", "ball"][i % 2]
    check(tmp_path / "demo.h5", touch, (1, *GRID))
    recordings = load(tmp_path / "demo.h5").recordings
    assert recordings.class_names == ("ball", "cup")
    assert recordings.names[10].endswith("demo_10")


def test_left_and_right_are_pads_not_episodes(tmp_path):
    left, right = episodes(n=2, grid=(2, 3))
    right = right[: len(left)]
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["left/tactile"] = left
        file["right/tactile"] = right
    check(tmp_path / "a.h5", [np.stack([left, right], axis=1)], (2, 2, 3))


def test_an_array_named_frames_holds_recordings(tmp_path):
    frames = np.stack([one[:30] for one in episodes(n=3, grid=(6,))])
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["frames"] = frames
        file["labels"] = np.array([2, 0, 2])
    check(tmp_path / "a.h5", list(frames), (1, 2, 3), layout="2x3")
    assert load(tmp_path / "a.h5", layout="2x3").recordings.class_names == ("0", "2")


def test_an_hdf5_file_that_is_cut_off_or_empty_says_so(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["tactile"] = np.zeros((5000, 40))
    whole = (tmp_path / "a.h5").read_bytes()
    (tmp_path / "cut.h5").write_bytes(whole[:3000])
    (tmp_path / "empty.h5").write_bytes(b"")
    for name in ("cut.h5", "empty.h5"):
        with pytest.raises(InputError, match="is no HDF5 file, or is cut off"):
            load(tmp_path / name)
    with h5py.File(tmp_path / "bare.h5", "w"):
        pass
    with pytest.raises(InputError, match="it holds no feature of numbers"):
        load(tmp_path / "bare.h5")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({}, "is being written by another program; wait until it has closed the file"),
        ({"libver": "latest", "swmr": True}, "is being written, or its writer was killed"),
    ],
)
def test_an_hdf5_file_that_is_being_written_says_so_and_the_others_are_read(
    options, message, tmp_path
):
    (touch,) = episodes(n=1)
    with h5py.File(tmp_path / "done.h5", "w") as file:
        file["tactile"] = touch
    script = f"""
import h5py, sys
options = {options!r}
shared = options.pop("swmr", False)
file = h5py.File({str(tmp_path / "open.h5")!r}, "w", **options)
file.create_dataset("tactile", (500, 6), maxshape=(None, 6), chunks=(32, 6))
if shared:
    file.swmr_mode = True
file.flush()
print("written", flush=True)
sys.stdin.readline()
"""
    writer = subprocess.Popen(
        [sys.executable, "-c", script], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    with writer:
        assert writer.stdout.readline() == "written\n"
        loaded = load(tmp_path)
        writer.stdin.close()
    (error,) = [problem.message for problem in loaded.problems if problem.level == "error"]
    assert f"open.h5: {message}" in error
    np.testing.assert_array_equal(loaded.recordings.frames[0], flat(touch))


@pytest.mark.parametrize("cut", [1, 20, 600])
@pytest.mark.parametrize("version", [2, 3])
def test_a_truncated_zarr_chunk_is_named_with_its_remedy(tmp_path, version, cut):
    touch = episodes(n=6)
    store(tmp_path / "set.zarr", touch, version)
    name = "0.0.0" if version == 2 else "c/0/0/0"
    chunk = tmp_path / "set.zarr/data/left_tactile_data" / name
    chunk.write_bytes(chunk.read_bytes()[:-cut])
    loaded = load(tmp_path / "set.zarr")
    errors = [problem.message for problem in loaded.problems if problem.level == "error"]
    assert len(loaded.recordings) == 4
    assert len(errors) == 2
    assert "episode 0, frames 0 to 29: cannot be read" in errors[0]
    assert errors[0].endswith("damaged, or cut off; copy it again")


def test_mat_of_version_5_is_read_with_fields_of_structures(tmp_path):
    (touch,) = episodes(n=1, grid=(6,))
    content = {"log": {"pressure": touch, "rate": 40.0, "gain": 3.0}, "note": "cup"}
    scipy.io.savemat(tmp_path / "a.mat", content)
    check(tmp_path / "a.mat", [touch], (1, 2, 3), layout="2x3")
    assert load(tmp_path / "a.mat", layout="2x3").recordings.layout.rate == 40
    (tmp_path / "cut.mat").write_bytes((tmp_path / "a.mat").read_bytes()[:300])
    with pytest.raises(InputError, match="is no MAT file, or is damaged"):
        load(tmp_path / "cut.mat")


def test_mat_of_version_7_3_has_its_axes_as_matlab_shows_them(tmp_path):
    (touch,) = episodes(n=1)
    with h5py.File(tmp_path / "a.mat", "w", userblock_size=512) as file:
        stored = file.create_dataset("tactile", data=touch.T)
        stored.attrs["MATLAB_class"] = np.bytes_("single")
    with (tmp_path / "a.mat").open("r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM")
    check(tmp_path / "a.mat", [touch], (1, *GRID))


# JSON lines


def test_json_lines_are_frames_of_episodes(tmp_path):
    touch = episodes(n=2)
    lines = [
        {"t": i / 25, "episode": k, "object": "ab"[k], "tactile": frame.tolist()}
        for k, one in enumerate(touch)
        for i, frame in enumerate(one.astype(float))
    ]
    lines[3]["tactile"][1][2] = None
    (tmp_path / "a.jsonl").write_text("\n".join(map(json.dumps, lines)) + '\n{"t": 3, "tac')
    loaded = load(tmp_path / "a.jsonl")
    touch[0][3, 1, 2] = np.nan
    for got, written in zip(loaded.recordings, touch, strict=True):
        np.testing.assert_array_equal(got, flat(written))
    assert loaded.recordings.layout.rate == pytest.approx(25)
    assert loaded.recordings.class_names == ("a", "b")
    assert "the last line is cut off" in " ".join(map(str, loaded.problems))


def test_json_lines_of_lists_are_read_and_a_wrong_line_is_named(tmp_path):
    (touch,) = episodes(n=1, grid=(6,))
    lines = [json.dumps(frame) for frame in touch.astype(float).tolist()]
    (tmp_path / "a.jsonl").write_text("\n".join(lines))
    check(tmp_path / "a.jsonl", [touch], (1, 2, 3), layout="2x3")
    lines[4] = "[1, 2]"
    (tmp_path / "b.jsonl").write_text("\n".join(lines))
    with pytest.raises(InputError, match=r"line 5: readings holds no \[6\] numbers"):
        load(tmp_path / "b.jsonl")
    (tmp_path / "c.jsonl").write_text("")
    with pytest.raises(InputError, match="holds no frames"):
        load(tmp_path / "c.jsonl")


# nothing in it, or something else


@pytest.mark.parametrize(
    ("info", "rows", "message"),
    [
        ("{", None, "is not JSON"),
        ({"fps": 3}, None, "lists no features"),
        ({"features": {"tactile": {"dtype": "float32", "shape": ["a"]}}}, None, "--key"),
        ({"features": {"tactile": {"dtype": "float32", "shape": [4]}}}, None, "holds no data"),
        ({"features": {"tactile": {"dtype": "float32", "shape": [4]}}}, [], "holds no frames"),
    ],
)
def test_a_lerobot_folder_with_something_else_in_it_says_so(tmp_path, info, rows, message):
    (tmp_path / "meta").mkdir()
    text = info if isinstance(info, str) else json.dumps(info)
    (tmp_path / "meta/info.json").write_text(text)
    if rows is not None:
        (tmp_path / "data").mkdir()
        kind = pa.list_(pa.float32())
        table = pa.table(
            {"tactile": pa.array(rows, kind), "episode_index": pa.array([], pa.int64())}
        )
        pq.write_table(table, tmp_path / "data/file.parquet")
    with pytest.raises(InputError, match=message) as told:
        load(tmp_path)
    assert len(str(told.value).splitlines()) == 1


def test_empty_files_say_that_they_hold_no_frames(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["tactile"] = np.zeros((0, 4))
    empty = pa.table({"tactile": pa.array([], pa.list_(pa.float32()))})
    pq.write_table(empty, tmp_path / "a.parquet")
    for name in ("a.h5", "a.parquet"):
        with pytest.raises(InputError, match=f"{name}: holds no frames"):
            load(tmp_path / name)


def test_links_that_lead_nowhere_do_no_harm(tmp_path):
    (touch,) = episodes(n=1)
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["tactile"] = touch
        file["soft"] = h5py.SoftLink("/nowhere")
        file["outside"] = h5py.ExternalLink("gone.h5", "/a")
        file["loop"] = h5py.SoftLink("/")
    check(tmp_path / "a.h5", [touch], (1, *GRID))


# which features, and where their readings go


@pytest.mark.parametrize(
    ("key", "chosen"),
    [
        (None, ["obs/tactile_1", "obs/tactile_2", "obs/tactile_10"]),
        ("tactile_2", ["obs/tactile_2"]),
        ("tactile_10,tactile_1", ["obs/tactile_10", "obs/tactile_1"]),
        ("obs/tactile_*", ["obs/tactile_1", "obs/tactile_2", "obs/tactile_10"]),
        ("state", ["obs/state"]),
    ],
)
def test_features_are_chosen_in_natural_order_or_as_they_are_named(key, chosen):
    features = {
        "obs/tactile_10": (4,),
        "obs/tactile_2": (4,),
        "obs/tactile_1": (4,),
        "obs/tactile_valid": (4,),
        "obs/tactile_temperature": (4,),
        "obs/state": (7,),
        "tactile_stamp": (),
    }
    assert choose(Path("set"), features, key) == chosen


def test_a_name_that_is_not_there_is_answered_with_those_that_are():
    with pytest.raises(InputError, match=r"holds no feature 'palm'; it holds t, tactile \[4\]"):
        choose(Path("set"), {"tactile": (4,), "t": ()}, "palm")


@pytest.mark.parametrize(
    "sizes", [[(3, 3), (12, 8)], [(4,), (4,)], [(5,), (2, 3)], [(2, 2, 3), (3, 1)], [(2, 3)]]
)
def test_each_reading_has_one_position_and_absent_ones_hold_0(sizes):
    pads = Pads.of(sizes)
    total = sum(map(math.prod, sizes))
    values = np.arange(1, total + 1)
    parts = np.split(values, np.cumsum([math.prod(size) for size in sizes])[:-1])
    (frame,) = pads.frames(
        [part.reshape(1, *size) for part, size in zip(parts, sizes, strict=True)]
    )
    assert sorted(frame[frame > 0].tolist()) == values.tolist()
    if pads.present is not None:
        assert (pads.present.ravel() == (frame > 0)).all()


# through the commands


def test_a_lerobot_data_set_goes_through_info_diagnose_and_convert(tmp_path, grasps, capsys):
    which = [i for i in range(len(grasps)) if i % 20 < 2]
    touch = [grasps.frames[i].reshape(-1, 2, 11, 10) for i in which]
    left = [one[:, 0] for one in touch]
    right = [one[:, 1] for one in touch]
    path = lerobot(tmp_path / "set", {"tactile.left": left, "tactile.right": right})
    assert main(["info", str(path)]) == 0
    told = capsys.readouterr().out
    assert f"{len(which)} of 100 frames each" in told or f"{len(which)} recordings" in told
    assert "2 x 11 x 10" in told or "2 pads" in told
    assert main(["diagnose", str(path)]) in (0, 1)
    converted = tmp_path / "same.npz"
    assert main(["convert", str(path), "--out", str(converted)]) == 0
    again = load(converted).recordings
    np.testing.assert_array_equal(again.frames[5], load(path).recordings.frames[5])
