"""Data sets at an address: what readers need is copied, and nothing else is read."""

import json

import fsspec
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from fsspec.implementations.memory import MemoryFileSystem
from hypothesis import given
from hypothesis import strategies as st

from adaptfault.cli import main
from adaptfault.data.recordings import InputError, load
from adaptfault.data.recordings.remote import needed

FEATURE = "observation.tactile.left"
FILES = 3
ROWS = 40


@pytest.fixture
def root(monkeypatch, tmp_path):
    """A LeRobot set of 3 episodes in memory, with a state of 64 joints and a video."""
    monkeypatch.setenv("ADAPTFAULT_CACHE", str(tmp_path / "cache"))
    files = fsspec.filesystem("memory")
    files.store.clear()
    rng = np.random.default_rng(0)
    features = {FEATURE: [2, 6], "observation.state": [64]}
    about = {name: {"dtype": "float32", "shape": sizes} for name, sizes in features.items()}
    about["episode_index"] = {"dtype": "int64", "shape": [1]}
    info = {"codebase_version": "v3.0", "fps": 20, "features": about}
    files.pipe("/bucket/set/meta/info.json", json.dumps(info).encode())
    for number in range(FILES):
        touch = pa.array(list(rng.uniform(0, 1, (ROWS, 12)).astype(np.float32)))
        state = pa.array(list(rng.normal(0, 1, (ROWS, 64)).astype(np.float32)))
        table = pa.table(
            {FEATURE: touch, "observation.state": state, "episode_index": [number] * ROWS}
        )
        with files.open(f"/bucket/set/data/chunk-000/file-{number:03d}.parquet", "wb") as file:
            pq.write_table(table, file)
    files.pipe("/bucket/set/videos/front.mp4", b"pixels" * 1000)
    files.pipe("/bucket/set/pictures/front.png", b"pixels" * 1000)
    return files


@pytest.fixture
def read(monkeypatch):
    """Names of the files that are opened."""
    names = []
    opened = MemoryFileSystem._open

    def counted(self, path, mode="rb", **options):
        if mode == "rb":
            names.append(path)
        return opened(self, path, mode, **options)

    monkeypatch.setattr(MemoryFileSystem, "_open", counted)
    return names


def loaded():
    return load("memory://bucket/set", shape=(1, 2, 6), full_scale=1.0)


@pytest.mark.usefixtures("root")
def test_a_set_at_an_address_is_read_as_one_on_the_disk_without_a_byte_of_a_video(read, tmp_path):
    recordings = loaded().recordings
    assert [frames.shape for frames in recordings.frames] == [(ROWS, 12)] * FILES
    assert recordings.layout.rate == 20
    assert not [name for name in read if name.endswith(("mp4", "png"))]
    copies = sorted((tmp_path / "cache").rglob("file-*.parquet"))
    assert len(copies) == FILES
    for copy in copies:
        assert pq.ParquetFile(copy).schema_arrow.names == [FEATURE, "episode_index"]


def test_what_was_copied_is_not_read_again_unless_it_changed(root, read):
    loaded()
    read.clear()
    loaded()
    assert not read
    name = "/bucket/set/data/chunk-000/file-001.parquet"
    root.pipe(name, root.cat_file(name))
    read.clear()
    loaded()
    assert read == [name]
    root.rm(name)
    assert len(loaded().recordings.frames) == FILES - 1


@pytest.mark.usefixtures("root")
def test_after_a_kill_the_rest_is_copied(monkeypatch, read):
    opened = MemoryFileSystem._open

    def killed(self, path, mode="rb", **options):
        if path.endswith("file-002.parquet"):
            raise KeyboardInterrupt
        return opened(self, path, mode, **options)

    with monkeypatch.context() as patch:
        patch.setattr(MemoryFileSystem, "_open", killed)
        with pytest.raises(KeyboardInterrupt):
            loaded()
    read.clear()
    assert len(loaded().recordings.frames) == FILES
    again = [name for name in read if name.endswith("parquet")]
    assert again == ["/bucket/set/data/chunk-000/file-002.parquet"]


def test_what_cannot_be_read_is_named_and_the_rest_is_checked(root, tmp_path, capsys):
    root.pipe("/bucket/set/data/chunk-000/file-001.parquet", b"no table")
    out = tmp_path / "check.json"
    stated = ("--shape", "2x6", "--full-scale", "1")
    code = main(["check", "memory://bucket/set", "--quick", "--out", str(out), *stated])
    said = capsys.readouterr().err
    assert code == 1
    assert (
        "memory://bucket/set: /bucket/set/data/chunk-000/file-001.parquet: cannot be read" in said
    )
    result = json.loads(out.read_text())
    assert len(result["summary"]["lengths"]) == FILES - 1
    assert "TOUCH-191" in {one["code"] for one in result["findings"]}


@pytest.mark.parametrize(
    ("address", "what"),
    [
        ("memory://nowhere", "is not there"),
        ("nobody://x/y", "pip install 'adaptfault[remote]'"),
        ("memory://bucket/set/pictures", "is no recording"),
    ],
)
@pytest.mark.usefixtures("root")
def test_what_is_not_there_is_one_line(address, what):
    with pytest.raises(InputError) as caught:
        load(address)
    assert what in str(caught.value)
    assert "\n" not in str(caught.value)


@given(
    touch=st.integers(0, 3),
    others=st.integers(0, 3),
    single=st.integers(0, 3),
    data=st.data(),
)
def test_no_reading_time_or_class_is_left_behind(touch, others, single, data):
    fields = [pa.field(f"tactile_{i}", pa.list_(pa.float32())) for i in range(touch)]
    fields += [pa.field(f"joints_{i}", pa.list_(pa.float32(), 7)) for i in range(others)]
    fields += [pa.field(f"value_{i}", pa.float64()) for i in range(single)]
    picture = pa.field("image", pa.struct([("bytes", pa.binary())]))
    fields = data.draw(st.permutations([*fields, picture, pa.field("raw", pa.binary())]))
    names = {field.name for field in fields}
    kept = set(needed(pa.schema(fields), None))
    assert not kept & {"image", "raw"}
    assert {name for name in names if name.startswith(("tactile", "value"))} <= kept
    if touch:
        assert not {name for name in kept if name.startswith("joints")}


def test_a_data_set_that_says_where_it_lies_is_read(root, tmp_path):
    class OfLeRobot:
        """What is asked of LeRobotDataset."""

        def __init__(self, place):
            self.root = place

    root.get("/bucket/set", str(tmp_path / "set"), recursive=True)
    for place in (tmp_path / "set", "memory://bucket/set"):
        loaded = load(OfLeRobot(place), shape=(1, 2, 6), full_scale=1.0)
        assert [frames.shape for frames in loaded.recordings.frames] == [(ROWS, 12)] * FILES


@pytest.mark.parametrize("version", [2, 3])
def test_of_a_zarr_store_the_pictures_are_not_read(version, root, read, tmp_path):
    zarr = pytest.importorskip("zarr")
    rng = np.random.default_rng(0)
    store = zarr.open_group(tmp_path / "set.zarr", mode="w", zarr_format=version)
    touch = rng.uniform(0, 1, (90, 3, 4)).astype(np.float32)
    store.create_array("data/tactile", data=touch, chunks=(30, 3, 4))
    store.create_array("data/camera_rgb", data=np.ones((90, 8, 8, 3), np.uint8))
    store.create_array("meta/episode_ends", data=np.array([40, 90]))
    for name in ("plain", "named.zarr"):
        root.put(str(tmp_path / "set.zarr"), f"/stores/{name}", recursive=True)
        read.clear()
        recordings = load(f"memory://stores/{name}", full_scale=1.0).recordings
        assert [len(frames) for frames in recordings.frames] == [40, 50]
        np.testing.assert_array_equal(np.concatenate(recordings.frames), touch.reshape(90, 12))
        pixels = [one for one in read if "camera" in one and "zarr.json" not in one]
        assert not [one for one in pixels if not one.endswith((".zarray", ".zattrs"))]
        root.rm(f"/stores/{name}", recursive=True)
