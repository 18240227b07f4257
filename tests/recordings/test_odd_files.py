"""A file that cannot be read as asked is named and left out; what lies beside it is read."""

import warnings

import numpy as np
import pytest
import scipy.io
import scipy.sparse
from hypothesis import given, settings
from hypothesis import strategies as st
from recording_files import archive, messages, refusal

from adaptfault.data.recordings import load

h5py = pytest.importorskip("h5py")
pa = pytest.importorskip("pyarrow")
pq = pytest.importorskip("pyarrow.parquet")
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
        joined = joined.reshape(len(joined), -1)
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
    called = "recording" if suffix == ".npz" else "demo_"
    assert f"{called} {which}".replace("_ ", "_") in told
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


# Valid files that hold something else than is expected


def parquet(path, **columns):
    pq.write_table(pa.table(columns), path)


def twice(path):
    lists = pa.array(readings().reshape(12, -1).tolist())
    pq.write_table(pa.Table.from_arrays([lists, lists], names=["tactile", "tactile"]), path)


def h5(path, **arrays):
    with h5py.File(path, "w") as file:
        for name, values in arrays.items():
            file[name] = values


def h5_attributes(path, **attributes):
    with h5py.File(path, "w") as file:
        file["tactile"] = readings()
        for name, value in attributes.items():
            file["tactile"].attrs[name] = value
            file.attrs[name] = value


def h5_made(path, **options):
    with h5py.File(path, "w") as file:
        file.create_dataset("tactile", **options)


def zarr_arrays(path, **arrays):
    root = zarr.open_group(path, mode="w")
    for name, values in arrays.items():
        root.create_array(name, data=values)


def zarr_broken(path, text, version=3):
    root = zarr.open_group(path, mode="w", zarr_format=version)
    root.create_array("tactile", data=readings())
    name = "zarr.json" if version == 3 else ".zarray"
    (path / "tactile" / name).write_text(text)


def mat(path, **arrays):
    scipy.io.savemat(path, arrays)


def text(path, content):
    path.write_text(content)


def rows(values=None):
    return pa.array((readings() if values is None else values).reshape(12, -1).tolist())


def bag_without_files(path):
    path.mkdir()
    text(path / "metadata.yaml", "rosbag2_bagfile_information:\n  version: 9\n")


def cells(*values):
    held = np.empty((1, len(values)), object)
    held[0, :] = values
    return held


NAN = float("nan")
ODD = {
    "empty_lists.parquet": lambda p: parquet(p, tactile=[[]] * 12),
    "some_empty.parquet": lambda p: parquet(p, tactile=[[], [1.0, 2.0]] * 6),
    "no_lists.parquet": lambda p: parquet(p, tactile=pa.array([None] * 12, pa.list_(pa.int16()))),
    "twice.parquet": twice,
    "episodes_lists.parquet": lambda p: parquet(p, tactile=rows(), episode_index=[[0, 1]] * 12),
    "episodes_missing.parquet": lambda p: parquet(
        p, tactile=rows(), episode_index=[None, *[1] * 11]
    ),
    "episodes_text.parquet": lambda p: parquet(p, tactile=rows(), episode=["a", "b"] * 6),
    "time_text.parquet": lambda p: parquet(p, tactile=rows(), time=["noon"] * 12),
    "time_lists.parquet": lambda p: parquet(p, tactile=rows(), time=[[0.0, 1.0]] * 12),
    "time_bool.parquet": lambda p: parquet(p, tactile=rows(), time=[True] * 12),
    "label_lists.parquet": lambda p: parquet(p, tactile=rows(), label=[["a"]] * 12),
    "texts.parquet": lambda p: parquet(p, tactile=["x"] * 12),
    "bools.parquet": lambda p: parquet(p, tactile=[[True] * 12] * 12),
    "records.parquet": lambda p: parquet(p, tactile=[{"left": [1.0]}] * 12),
    "maps.parquet": lambda p: parquet(
        p, tactile=pa.array([[("a", 1)]] * 12, pa.map_(pa.string(), pa.int8()))
    ),
    "bytes.parquet": lambda p: parquet(p, tactile=[b"abc"] * 12),
    "no_rows.parquet": lambda p: parquet(p, tactile=pa.array([], pa.list_(pa.float32()))),
    "no_columns.parquet": lambda p: pq.write_table(pa.table({}), p),
    "nothing.parquet": lambda p: p.write_bytes(b""),
    "six_axes.h5": lambda p: h5(p, tactile=np.ones((2, 3, 2, 2, 3, 2))),
    "no_axes.h5": lambda p: h5(p, tactile=3.0),
    "no_cells.h5": lambda p: h5(p, tactile=np.zeros((12, 0, 4))),
    "complex.h5": lambda p: h5(p, tactile=np.ones((12, 12), np.complex64)),
    "bools.h5": lambda p: h5(p, tactile=np.ones((12, 12), bool)),
    "records.h5": lambda p: h5(p, tactile=np.zeros(12, [("a", "f4", 12)])),
    "texts.h5": lambda p: h5(p, tactile=["a"] * 12),
    "lists.h5": lambda p: h5_made(p, shape=12, dtype=h5py.vlen_dtype(np.float32)),
    "links.h5": lambda p: h5_made(p, shape=12, dtype=h5py.ref_dtype),
    "opaque.h5": lambda p: h5_made(p, shape=12, dtype="V12"),
    "empty.h5": lambda p: h5(p, tactile=h5py.Empty("f4")),
    "unit_bytes.h5": lambda p: h5_attributes(p, unit=np.bytes_(b"\xb5N")),
    "unit_numbers.h5": lambda p: h5_attributes(p, unit=[1, 2], rate="fast", full_scale=[[NAN]]),
    "attributes_empty.h5": lambda p: h5_attributes(p, unit=h5py.Empty("S3"), scale_factor=[]),
    "scale_zero.h5": lambda p: h5_attributes(p, scale_factor=0, add_offset="x", _FillValue="y"),
    "ends_text.h5": lambda p: h5(p, tactile=readings(), episode_ends=["a", "b"]),
    "ends_falling.h5": lambda p: h5(p, tactile=readings(), episode_ends=[9, 3]),
    "ends_decimal.h5": lambda p: h5(p, tactile=readings(), lengths=[2.5, NAN]),
    "times_texts.h5": lambda p: h5(p, tactile=readings(), time=["x"] * 12),
    "times_nan.h5": lambda p: h5(p, tactile=readings(), time=np.full(12, NAN)),
    "labels_grid.h5": lambda p: h5(p, tactile=readings(), label=np.ones((3, 2))),
    "wide.h5": lambda p: h5_made(p, shape=(2, 3_000_000), dtype="i1", chunks=(1, 1000)),
    "long_double.h5": lambda p: h5(p, tactile=readings().astype(np.longdouble)),
    "numbers_huge.h5": lambda p: h5(p, tactile=np.full((12, 12), 2**63, np.uint64)),
    "infinite.h5": lambda p: h5(p, tactile=np.full((12, 12), np.inf)),
    "one_name.h5": lambda p: h5(p, **{"a/demo_0/tactile": readings(), "b/demo_0/x": readings()}),
    "six_axes.zarr": lambda p: zarr_arrays(p, tactile=np.ones((2, 3, 2, 2, 3, 2))),
    "bools.zarr": lambda p: zarr_arrays(p, tactile=np.ones((12, 12), bool)),
    "no_json.zarr": lambda p: zarr_broken(p, "{"),
    "list.zarr": lambda p: zarr_broken(p, "[1]"),
    "no_shape.zarr": lambda p: zarr_broken(p, '{"zarr_format": 2}', 2),
    "nothing.zarr": lambda p: zarr.open_group(p, mode="w"),
    "structures.mat": lambda p: mat(p, tactile={"a": {"b": "c"}}, empty=np.zeros((0, 0))),
    "cells.mat": lambda p: mat(p, tactile=cells(np.ones((3, 12)), "text", np.ones(2))),
    "sparse.mat": lambda p: mat(p, tactile=scipy.sparse.eye_array(12).tocsc()),
    "six_axes.mat": lambda p: mat(p, tactile=np.ones((2, 3, 2, 2, 3, 2))),
    "complex.mat": lambda p: mat(p, tactile=np.ones((12, 12)) * 1j),
    "bools.mat": lambda p: mat(p, tactile=np.ones((12, 12), bool)),
    "numbers.jsonl": lambda p: text(p, "1\n2\n"),
    "ragged.jsonl": lambda p: text(p, '{"tactile": [[1, 2], [3]]}\n'),
    "texts.jsonl": lambda p: text(p, '{"tactile": ["a"], "t": "noon"}\n'),
    "nulls.jsonl": lambda p: text(p, '{"tactile": null}\n{"tactile": [1, 2]}\n'),
    "time_text.jsonl": lambda p: text(p, '{"t": "x", "tactile": [1, 2]}\n' * 5),
    "deep.jsonl": lambda p: text(p, "[" * 3000 + "]" * 3000),
    "six_axes.npy": lambda p: np.save(p, np.ones((2, 3, 2, 2, 3, 2))),
    "records.npy": lambda p: np.save(p, np.zeros(12, [("a", "f4")])),
    "complex.npz": lambda p: np.savez(p, frames=np.ones((3, 4, 12), np.complex64)),
    "texts.npz": lambda p: np.savez(p, frames=["a", "b"]),
    "numbers_huge.parquet": lambda p: parquet(p, tactile=rows(np.full((12, 12), 2**40))),
    "numbers_huge.csv": lambda p: text(p, f"{','.join(['70000000'] * 12)}\n" * 9),
    "first.bag": lambda p: text(p, "#ROSBAG V2.0\n"),
    "no_files_bag": bag_without_files,
    "no_folder.zarr": lambda p: text(p, "PK"),
    "no_description.zarr": lambda p: p.mkdir(),
    "link.csv": lambda p: p.symlink_to("nowhere.csv"),
    "circle.h5": lambda p: p.symlink_to(p),
}


@pytest.mark.parametrize("before", [True, False])
def test_no_valid_odd_file_loses_the_good_one_and_each_is_read_or_named(before, tmp_path):
    good = readings(30).reshape(30, -1)
    archive(tmp_path / ("z_good.npz" if before else "0_good.npz"), frames=good)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of the libraries that write
        for name, write in ODD.items():
            write(tmp_path / name)
    loaded = load(tmp_path, layout=GRID)
    held = dict(zip(loaded.recordings.names, loaded.recordings.frames, strict=True))
    (called,) = (name for name in held if "good" in name)
    np.testing.assert_array_equal(held[called], good)
    told = messages(loaded, "error")
    for name in ODD:
        is_read = any(one.startswith(name) for one in held)
        assert is_read or any(name in one for one in told), name
    assert not [one for one in told if "\n" in one]
    assert not [one for one in told if "broadcast" in one or "a sequence" in one]


@pytest.mark.parametrize(
    "odd",
    [
        {"rate": 77.0},
        {"full_scale": 5.0, "unit": "V"},
        {"present": np.arange(12).reshape(1, 3, 4) < 9},
        {"frames": np.full((9, 12), 2**33)},
    ],
)
@pytest.mark.parametrize("name", ["0", "z"])
def test_the_file_that_is_not_as_most_are_is_left_out_wherever_it_stands(odd, name, tmp_path):
    usual = {"frames": readings(9).reshape(9, -1), "rate": 20.0, "unit": "count"}
    usual |= {"full_scale": 1023.0, "present": np.ones((1, 3, 4), bool)}
    if "frames" in odd:
        del usual["full_scale"], usual["unit"]
    archive(tmp_path / f"{name}_odd.npz", **(usual | odd))
    for i in range(2):
        archive(tmp_path / f"good_{i}.npz", **usual)
    loaded = load(tmp_path)
    assert loaded.recordings.names == ("good_0.npz", "good_1.npz")
    (told,) = messages(loaded, "error")
    assert f"{name}_odd.npz" in told
    assert "load them apart" in told


@settings(max_examples=40, deadline=None)
@given(
    name=st.sampled_from(sorted(ODD)),
    suffix=st.sampled_from([".h5", ".zarr", ".npz"]),
    frames=st.integers(1, 40),
    before=st.booleans(),
)
def test_a_good_file_beside_any_odd_one_is_read_in_any_format(
    name, suffix, frames, before, tmp_path_factory
):
    folder = tmp_path_factory.mktemp("odd")
    good = readings(frames)
    episodes_of(folder / f"{'0' if before else 'z'}_good{suffix}", [good])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        ODD[name](folder / name)
    loaded = load(folder, layout=GRID)
    held = dict(zip(loaded.recordings.names, loaded.recordings.frames, strict=True))
    (called,) = (one for one in held if "good" in one)
    np.testing.assert_array_equal(held[called], good.reshape(frames, -1))


@settings(max_examples=30, deadline=None)
@given(
    suffix=st.sampled_from([".h5", ".zarr", ".npz"]),
    lengths=st.lists(st.integers(0, 6), min_size=1, max_size=6).filter(any),
)
def test_episodes_of_any_lengths_are_read_and_empty_ones_left_out(
    suffix, lengths, tmp_path_factory
):
    recordings = [readings(length) for length in lengths]
    path = episodes_of(tmp_path_factory.mktemp("any") / f"a{suffix}", recordings)
    loaded = load(path, layout=GRID)
    held = [one.reshape(len(one), -1) for one in recordings if len(one)]
    for came, written in zip(loaded.recordings.frames, held, strict=True):
        np.testing.assert_array_equal(came, written)
    assert len(messages(loaded, "error")) == lengths.count(0)
