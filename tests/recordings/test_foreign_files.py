"""Valid files as pyarrow, h5py, zarr, xarray, scipy and MATLAB write them are read, or the true
reason is told."""

import json
import os
import shutil
import zipfile

import numpy as np
import pytest
import scipy.io
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from recording_files import messages, refusal

from adaptfault.data.recordings import load, open_recordings

h5py = pytest.importorskip("h5py")
pa = pytest.importorskip("pyarrow")
pq = pytest.importorskip("pyarrow.parquet")
zarr = pytest.importorskip("zarr")

X = np.random.default_rng(0).integers(0, 4096, (60, 12)).astype(np.float32)
GRID = "3x4"


class Registered(pa.ExtensionType):
    """What the libraries of LeRobot register for features of rows and columns."""

    def __init__(self):
        super().__init__(pa.list_(pa.list_(pa.float32())), "tests.array_2d")

    def __arrow_ext_serialize__(self):
        return b""

    @classmethod
    def __arrow_ext_deserialize__(cls, storage, data):
        return cls()


@pytest.fixture
def registered():
    kind = Registered()
    pa.register_extension_type(kind)
    yield kind
    pa.unregister_extension_type(kind.extension_name)


def table(path, **columns):
    pq.write_table(pa.table(columns), path)
    return path


def lists(values, kind=None):
    return pa.array(values.tolist(), kind or pa.list_(pa.float32(), values.shape[1]))


def check(path, *, rate=10.0, expected=X, **options):
    loaded = load(path, **{"layout": GRID, **options})
    np.testing.assert_array_equal(np.concatenate(loaded.recordings.frames), expected)
    assert loaded.recordings.layout.shape == (1, 3, 4)
    assert loaded.recordings.layout.rate == pytest.approx(rate)
    return loaded


def test_columns_of_arrows_own_tensors_are_read_in_the_order_of_their_writer(tmp_path):
    grid = X.reshape(-1, 3, 4)
    plain = pa.FixedShapeTensorArray.from_numpy_ndarray(grid)
    check(table(tmp_path / "a.parquet", tactile=plain), layout=None)
    stored = np.ascontiguousarray(grid.transpose(0, 2, 1)).ravel()
    kind = pa.fixed_shape_tensor(pa.float32(), (4, 3), permutation=(1, 0))
    storage = pa.FixedSizeListArray.from_arrays(pa.array(stored), 12)
    turned = pa.ExtensionArray.from_storage(kind, storage)
    np.testing.assert_array_equal(turned.to_numpy_ndarray(), grid)
    check(table(tmp_path / "b.parquet", tactile=turned), layout=None)


def test_a_type_that_another_library_registers_is_read_as_it_is_stored(tmp_path, registered):
    kind = pa.list_(pa.list_(pa.float32()))
    stored = pa.array(X.reshape(-1, 3, 4).tolist(), kind)
    column = pa.ExtensionArray.from_storage(registered, stored)
    check(table(tmp_path / "a.parquet", tactile=column), layout=None)


def test_times_of_day_dates_and_written_times_give_the_rate(tmp_path):
    ticks = np.arange(60) * 10
    dates = np.datetime64("2026-01-01", "ns") + ticks * np.timedelta64(1_000_000, "ns")
    for name, times in (
        ("of_day", pa.array(ticks.astype(np.int32), pa.time32("ms"))),
        ("of_day_ns", pa.array(ticks * 1_000_000, pa.time64("ns"))),
        ("since", pa.array(ticks * 1000, pa.duration("us"))),
        ("written", pa.array(np.datetime_as_string(dates).tolist())),
    ):
        check(table(tmp_path / f"{name}.parquet", time=times, tactile=lists(X)), rate=100)
    root = zarr.open_group(tmp_path / "dates.zarr", mode="w")
    root.create_array("tactile", data=X)
    root.create_array("time", data=dates)
    check(tmp_path / "dates.zarr", rate=100)
    with h5py.File(tmp_path / "since.nc", "w") as file:
        file["tactile"] = X
        file["time"] = ticks
        file["time"].attrs["units"] = "milliseconds since 2026-01-01"
    check(tmp_path / "since.nc", rate=100)


def test_missing_readings_and_scales_of_cf_are_used(tmp_path):
    stored = np.where(X < 400, -1, X).astype(np.int16)
    expected = np.where(X < 400, np.nan, X / 2 + 1).astype(np.float32)
    packing = {"_FillValue": -1, "scale_factor": 0.5, "add_offset": 1.0}
    array = zarr.open_group(tmp_path / "a.zarr", mode="w").create_array("tactile", data=stored)
    array.attrs.update(packing)
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["tactile"] = stored
        file["tactile"].attrs.update({k: np.array([v]) for k, v in packing.items()})
    for name in ("a.zarr", "a.h5"):
        check(tmp_path / name, expected=expected)


def unsigned_classic(path, stored, **attributes):
    """Write as netCDF 3 does, which has no type without a sign."""
    with scipy.io.netcdf_file(path, "w") as file:
        for name, size in (("time", len(stored)), ("cell", stored.shape[1])):
            file.createDimension(name, size)
        kind = f"i{stored.dtype.itemsize}"
        variable = file.createVariable("tactile", kind, ("time", "cell"))
        variable[:] = stored.view(kind)
        for name, value in {"_Unsigned": "true", **attributes}.items():
            setattr(variable, name, value)


def test_numbers_without_a_sign_are_so_in_netcdf(tmp_path):
    stored = (X % 256).astype(np.uint8)
    unsigned_classic(tmp_path / "three.nc", stored)
    unsigned_classic(tmp_path / "wide.nc", (X + 40_000).astype(np.uint16))
    packing = {"_FillValue": np.int8(-1), "scale_factor": 0.5}
    unsigned_classic(tmp_path / "scaled.nc", stored, **packing)
    with h5py.File(tmp_path / "four.h5", "w") as file:
        file["tactile"] = stored.view(np.int8)
        file["tactile"].attrs["_Unsigned"] = "true"
    check(tmp_path / "three.nc", expected=stored)
    check(tmp_path / "four.h5", expected=stored)
    check(tmp_path / "wide.nc", expected=X + 40_000)
    scaled = np.where(stored == 255, np.nan, stored * np.float32(0.5))
    check(tmp_path / "scaled.nc", expected=scaled)


@pytest.mark.parametrize(
    "limits",
    [
        {"valid_range": [100, 3900]},
        {"valid_min": 100, "valid_max": 3900},
        {"valid_range": [50.0, 1950.0]},  # of another type than what is stored: of the readings
    ],
)
def test_what_lies_outside_the_valid_range_of_cf_is_missing(tmp_path, limits):
    stored = X.astype(np.int16)
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["tactile"] = stored
        file["tactile"].attrs.update({**limits, "scale_factor": 0.5})
    array = zarr.open_group(tmp_path / "a.zarr", mode="w").create_array("tactile", data=stored)
    array.attrs.update({**limits, "scale_factor": 0.5})
    expected = np.where((X < 100) | (X > 3900), np.nan, X / 2)
    assert np.isnan(expected).any()
    for name in ("a.zarr", "a.h5"):
        check(tmp_path / name, expected=expected)


def test_netcdf_of_all_versions_is_read(tmp_path):
    with h5py.File(tmp_path / "four.nc", "w") as file:
        file["tactile"] = X.reshape(-1, 3, 4)
        file["time"] = np.arange(60) / 50
    with scipy.io.netcdf_file(tmp_path / "three.nc", "w") as file:
        for name, size in (("time", 60), ("row", 3), ("column", 4)):
            file.createDimension(name, size)
        file.createVariable("tactile", "f4", ("time", "row", "column"))[:] = X.reshape(-1, 3, 4)
        times = file.createVariable("time", "f8", ("time",))
        times[:] = np.arange(60) / 50
        times.units = "seconds since 2026-01-01"
    for name in ("four.nc", "three.nc"):
        check(tmp_path / name, layout=None, rate=50)


def test_frames_that_were_appended_after_consolidation_are_read(tmp_path):
    root = zarr.open_group(tmp_path / "a.zarr", mode="w", zarr_format=2)
    array = root.create_array("tactile", data=X[:40], chunks=(20, 12))
    zarr.consolidate_metadata(root.store)
    array.append(X[40:])
    check(tmp_path / "a.zarr")


@pytest.mark.parametrize("key", [None, "data/tactile"])
def test_of_a_zarr_with_a_codec_that_is_not_installed_the_touch_is_read(key, tmp_path):
    root = zarr.open_group(tmp_path / "a.zarr", mode="w", zarr_format=2)
    data = root.create_group("data")
    data.create_array("tactile", data=X)
    data.create_array("camera", data=np.zeros((60, 8, 8, 3), np.uint8))
    described = tmp_path / "a.zarr/data/camera/.zarray"
    about = json.loads(described.read_text()) | {"compressor": {"id": "imagecodecs_jpegxl"}}
    described.write_text(json.dumps(about))
    loaded = check(tmp_path / "a.zarr", key=key)
    assert "data/camera is left out: it cannot be read" in messages(loaded, "warning")[0]
    described.rename(tmp_path / "a.zarr/data/tactile/.zarray")
    assert "data/tactile cannot be read" in refusal(tmp_path / "a.zarr", layout=GRID)


def matlab_text(file, name, text):
    file[name] = np.array([ord(c) for c in text], np.uint16)[:, None]
    file[name].attrs["MATLAB_class"] = np.bytes_("char")


def test_matlab_files_of_both_versions_give_the_same(tmp_path):
    for place, called in enumerate(("mug", "sponge")):
        part = X[place * 30 :][:30].reshape(-1, 3, 4)
        scipy.io.savemat(
            tmp_path / f"five{place}.mat", {"tactile": part, "object": called, "rate": 40.0}
        )
        with h5py.File(tmp_path / f"seven{place}.mat", "w", userblock_size=512) as file:
            file["tactile"] = part.T
            file["tactile"].attrs["MATLAB_class"] = np.bytes_("single")
            matlab_text(file, "object", called)
            file["rate"] = np.array([[40.0]])
            file["rate"].attrs["MATLAB_class"] = np.bytes_("double")
    for version in ("five", "seven"):
        paths = [tmp_path / f"{version}{place}.mat" for place in (0, 1)]
        loaded = check(paths, layout=None, rate=40)
        assert loaded.recordings.class_names == ("mug", "sponge")


def test_arrays_of_structures_and_cells_of_matlab_are_episodes(tmp_path):
    demos = np.zeros((1, 2), dtype=[("tactile", "O"), ("label", "O")])
    demos[0, 0] = (X[:30], "mug")
    demos[0, 1] = (X[30:], "cup")
    scipy.io.savemat(tmp_path / "a.mat", {"demo": demos})
    loaded = check(tmp_path / "a.mat")
    assert loaded.recordings.labels.tolist() == [1, 0]
    cells = np.empty((1, 2), object)
    cells[0, :] = [X[:30], X[30:]]
    scipy.io.savemat(tmp_path / "b.mat", {"tactile": cells})
    check(tmp_path / "b.mat")
    with h5py.File(tmp_path / "c.mat", "w", userblock_size=512) as file:
        for name in ("tactile", "label"):
            references = []
            for place, called in enumerate(("mug", "cup")):
                held = f"#refs#/{name}{place}"
                if name == "tactile":
                    file[held] = X[place * 30 :][:30].T
                    file[held].attrs["MATLAB_class"] = np.bytes_("single")
                else:
                    matlab_text(file, held, called)
                references.append([file[held].ref])
            file.create_dataset(f"demo/{name}", data=references, dtype=h5py.ref_dtype)
    loaded = check(tmp_path / "c.mat")
    assert loaded.recordings.labels.tolist() == [1, 0]


def test_cells_by_frames_are_turned_where_the_shape_tells_and_it_is_said(tmp_path):
    scipy.io.savemat(tmp_path / "a.mat", {"tactile": X.T})
    with h5py.File(tmp_path / "b.h5", "w") as file:
        file["tactile"] = X.T.reshape(3, 4, 60)
        file["time"] = np.arange(60) / 25
    zarr.open_group(tmp_path / "c.zarr", mode="w").create_array("tactile", data=X.T)
    for name, rate in (("a.mat", 10), ("b.h5", 25), ("c.zarr", 10)):
        loaded = check(tmp_path / name, rate=rate)
        assert "time as its last axis" in messages(loaded, "warning")[0]


def write_frames(path, frames):
    """Write frames ``[T, D]`` into a file of the format that its name ends in."""
    match path.suffix:
        case ".parquet":
            table(path, tactile=lists(frames))
        case ".h5":
            with h5py.File(path, "w") as file:
                file["tactile"] = frames
        case ".mat":
            scipy.io.savemat(path, {"tactile": frames})
        case ".zarr":
            zarr.open_group(path, mode="w").create_array("tactile", data=frames)
        case ".npz":
            np.savez(path, frames=frames)
        case ".npy":
            np.save(path, frames)
        case ".jsonl":
            lines = [json.dumps({"tactile": frame}) for frame in frames.astype(float).tolist()]
            path.write_text("\n".join(lines) + "\n")
        case ".csv":
            np.savetxt(path, frames, delimiter=",", fmt="%g")


FORMATS = [".parquet", ".h5", ".mat", ".zarr", ".npz", ".npy", ".jsonl", ".csv"]


@settings(max_examples=60, deadline=None)
@given(
    other=st.sampled_from(FORMATS),
    good=st.sampled_from(FORMATS),
    rows=st.integers(1, 5),
    cols=st.integers(1, 5),
    width=st.integers(1, 30),
    frames=st.integers(2, 20),
    before=st.booleans(),
)
def test_a_file_of_any_other_width_is_left_out_beside_any_shape_in_any_format(
    other, good, rows, cols, width, frames, before, tmp_path_factory
):
    cells = rows * cols
    assume(width != cells)
    assume(frames != cells)  # cells x frames, which is read so
    folder = tmp_path_factory.mktemp("widths")
    rng = np.random.default_rng(width)
    written = rng.integers(1, 90, (40, cells)).astype(np.float32)
    write_frames(folder / f"m_good{good}", written)
    odd = rng.integers(1, 90, (frames, width)).astype(np.float32)
    write_frames(folder / f"{'a' if before else 'z'}_odd{other}", odd)
    loaded = load(folder, shape=(rows, cols), full_scale=100)
    np.testing.assert_array_equal(np.concatenate(loaded.recordings.frames), written)
    (told,) = messages(loaded, "error")
    assert f"_odd{other}" in told
    assert f"{width} value{'s' * (width != 1)} a frame" in told


@pytest.mark.parametrize("suffix", FORMATS)
def test_a_file_that_was_written_anew_is_read_anew(suffix, tmp_path):
    path = tmp_path / f"a{suffix}"
    for again in range(3):
        written = np.random.default_rng(again).integers(100, 900, (40, 12)).astype(np.float32)
        if suffix == ".zarr" and path.exists():
            shutil.rmtree(path)
        write_frames(path, written)
        loaded = load(path, layout=GRID)
        np.testing.assert_array_equal(loaded.recordings.frames[0], written)


def test_lists_of_different_lengths_are_refused_with_their_row(tmp_path):
    rows = [[1.0, 2.0], [3.0, 4.0, 5.0], [6.0]] * 4
    path = table(tmp_path / "a.parquet", tactile=pa.array(rows, pa.list_(pa.float32())))
    assert "row 1: tactile holds a list of 3 where the first row has 2" in refusal(path)


@pytest.mark.parametrize("kind", ["link", "virtual", "raw"])
def test_what_lies_in_another_file_is_not_read(kind, tmp_path):
    secret = tmp_path / "secret"
    secret.write_bytes(os.urandom(12 * 4 * 4))
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file["tactile"] = X
    with h5py.File(tmp_path / "a.h5", "w") as file:
        if kind == "link":
            file["tactile"] = h5py.ExternalLink("other.h5", "/tactile")
        elif kind == "virtual":
            layout = h5py.VirtualLayout((60, 12), np.float32)
            layout[:] = h5py.VirtualSource("other.h5", "tactile", (60, 12))
            file.create_virtual_dataset("tactile", layout)
        else:
            raw = [(str(secret), 0, 12 * 4 * 4)]
            file.create_dataset("tactile", (4, 12), np.float32, external=raw)
    told = refusal(tmp_path / "a.h5", layout=GRID)
    assert "tactile" in told
    assert {"link": "other.h5", "virtual": "virtual", "raw": "external storage"}[kind] in told


def test_flat_features_that_are_taken_as_rows_are_told(tmp_path):
    path = table(tmp_path / "a.parquet", tactile_l=lists(X[:, :6]), tactile_r=lists(X[:, 6:]))
    loaded = load(path)
    assert loaded.recordings.layout.shape == (2, 1, 6)
    (said,) = messages(loaded, "warning")
    assert "each is taken as one row, and a broken row or column shows as single cells" in said
    assert not load(path, layout="2x2x3").problems


def test_complex_numbers_and_records_are_refused_by_what_they_are(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["tactile"] = X * 1j
    assert "tactile holds complex numbers" in refusal(tmp_path / "a.h5")
    with h5py.File(tmp_path / "b.h5", "w") as file:
        file["tactile"] = np.zeros(5, [("time", "f8"), ("cells", "f4", 12)])
    assert "tactile holds records of several fields" in refusal(tmp_path / "b.h5")


def test_where_a_file_holds_nothing_else_the_reason_of_what_was_left_out_is_told(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["log"] = np.zeros(5, [("time", "f8"), ("tactile", "f4", 12)])
    assert "log holds records of several fields" in refusal(tmp_path / "a.h5")
    with h5py.File(tmp_path / "b.h5", "w") as file:
        rows = file.create_dataset("log", 5, h5py.vlen_dtype(np.float32))
        for frame in range(5):
            rows[frame] = np.zeros(12)
    assert "log holds a list a frame" in refusal(tmp_path / "b.h5")


def test_frames_and_times_that_belong_to_nothing_are_told(tmp_path):
    grids = X.reshape(-1, 3, 4)
    with h5py.File(tmp_path / "ends.h5", "w") as file:
        file["data/tactile"] = grids
        file["meta/episode_ends"] = [30, 50]
    with h5py.File(tmp_path / "times.h5", "w") as file:
        file["tactile"] = grids
        file["time"] = np.arange(40) / 50
    with h5py.File(tmp_path / "pads.h5", "w") as file:
        file["tactile_left"] = grids[:, :, :2]
        file["tactile_right"] = grids[:40, :, 2:]

    def told(loaded):
        return [message.partition(".h5: ")[2] for message in messages(loaded, "warning")]

    ends = load(tmp_path / "ends.h5")
    assert [len(one) for one in ends.recordings.frames] == [30, 20]
    assert told(ends) == [
        "data/tactile: 10 frames behind the last end in meta/episode_ends are left out"
    ]
    assert told(load(tmp_path / "times.h5")) == [
        "time holds 40 values where tactile has 60 frames: passed over"
    ]
    pads = load(tmp_path / "pads.h5", layout="2x3x2")
    assert [len(one) for one in pads.recordings.frames] == [40]
    assert told(pads) == [
        "tactile_left holds 60 frames where tactile_right has 40: the last 20 are left out"
    ]


# What declares more than it holds, and what has no end


def h5_declares(path, **options):
    with h5py.File(path, "w") as file:
        file.create_dataset("tactile", dtype="f4", **options)


def zarr_declares(path, **options):
    zarr.open_group(path, mode="w").create_array("tactile", dtype="f4", **options)


def zarr_with(path, replace):
    root = zarr.open_group(path, mode="w", zarr_format=2)
    chunks = root.create_array("tactile", data=X)
    replace(path / "tactile" / chunks.metadata.encode_chunk_key((0, 0)))


def pipe(path):
    path.unlink()
    os.mkfifo(path)


def device(path):
    path.unlink()
    path.symlink_to("/dev/zero")


def lerobot_pipe(path):
    (path / "meta").mkdir(parents=True)
    (path / "data").mkdir()
    features = {"tactile": {"dtype": "int16", "shape": [12]}}
    (path / "meta/info.json").write_text(json.dumps({"features": features}))
    os.mkfifo(path / "data/file.parquet")


HOSTILE = {
    "never_written.h5": (lambda p: h5_declares(p, shape=(10**9, 12), chunks=(99, 12)), "declares"),
    "contiguous.h5": (lambda p: h5_declares(p, shape=(10**9, 12)), "declares"),
    "chunk.h5": (lambda p: h5_declares(p, shape=(10**9, 12), chunks=(10**8, 6)), "chunks of"),
    "never_written.zarr": (lambda p: zarr_declares(p, shape=(10**9, 12), chunks=(99, 12)), "decl"),
    "chunk.zarr": (lambda p: zarr_declares(p, shape=(10**9, 12), chunks=(10**9, 12)), "chunks of"),
    "pipe.zarr": (lambda p: zarr_with(p, pipe), "cannot be read"),
    "device.zarr": (lambda p: zarr_with(p, device), "cannot be read"),
    "lerobot": (lerobot_pipe, "not a regular file"),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_what_declares_more_than_it_stores_or_has_no_end_is_left_out(name, tmp_path):
    write, reason = HOSTILE[name]
    write(tmp_path / name)
    np.save(tmp_path / "good.npy", X)
    loaded = check(tmp_path)
    (told,) = messages(loaded, "error")
    assert name in told
    assert reason in told


def test_a_mat_file_that_unpacks_to_more_than_the_limit_is_refused(tmp_path, monkeypatch):
    from adaptfault.data.recordings.formats.datasets import mat

    scipy.io.savemat(tmp_path / "a.mat", {"tactile": np.zeros((10**5, 12))}, do_compression=True)
    monkeypatch.setattr(mat, "MOST_BYTES", 10**6)
    assert "unpacks to more than 1,000,000 bytes" in refusal(tmp_path / "a.mat", layout=GRID)


def test_rows_of_parquet_that_are_all_alike_are_limited(tmp_path, monkeypatch):
    from adaptfault.data.recordings.facts import declared

    monkeypatch.setattr(declared, "_FREE", 10**5)
    monkeypatch.setattr(declared, "_RATIO", 20)
    table(tmp_path / "a.parquet", tactile=lists(np.zeros((60_000, 12), np.float32)))
    table(tmp_path / "good.parquet", tactile=lists(X))
    loaded = check(tmp_path)
    assert "a.parquet: tactile declares 2,880,000 bytes" in messages(loaded, "error")[0]


def test_links_in_circles_and_deep_groups_end(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        group = file
        for _ in range(200):
            group = group.create_group("g")
        group["tactile"] = X
        group["above"] = file["g"]
    check(tmp_path / "a.h5")


def test_the_groups_of_a_file_are_gone_through_once_each(tmp_path, monkeypatch):
    from adaptfault.data.recordings.formats.datasets import beside

    steps = []
    whole = beside.is_vector
    monkeypatch.setattr(beside, "is_vector", lambda *a: steps.append(0) or whole(*a))
    for count in (20, 40):
        with h5py.File(tmp_path / f"{count}.h5", "w") as file:
            for i in range(count):
                file[f"data/demo_{i}/tactile"] = X[:3]
                file[f"data/demo_{i}/time"] = np.arange(3) / 10
        steps.clear()
        assert len(load(tmp_path / f"{count}.h5", layout=GRID).recordings) == count
        assert len(steps) <= 4 * count


def test_a_large_chunk_is_unpacked_once(tmp_path):
    values = np.tile(X, (400, 1))
    array = zarr.open_group(tmp_path / "a.zarr", mode="w").create_array(
        "tactile", data=values, chunks=(len(values), 12)
    )
    assert array.chunks[0] > 4096
    check(tmp_path / "a.zarr", expected=values)


def test_archives_are_read_in_turns(tmp_path):
    for name, values in (("a", X[:20]), ("b", X[20:])):
        zarr.open_group(tmp_path / name, mode="w").create_array("tactile", data=values)
        with zipfile.ZipFile(tmp_path / f"{name}.zarr.zip", "w") as archive:
            for file in sorted((tmp_path / name).rglob("*")):
                archive.write(file, file.relative_to(tmp_path / name))
    paths = [tmp_path / f"{name}.zarr.zip" for name in "ab"]
    opened = open_recordings(paths, layout=GRID, room=0)
    for _ in range(2):
        np.testing.assert_array_equal(np.concatenate(list(opened)), X)
