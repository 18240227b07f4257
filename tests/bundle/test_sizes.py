"""Files that declare more than memory holds, and paths that are no files, are refused in one line
before reading."""

import io
import os
import tracemalloc
import zipfile

import numpy as np
import pytest

from adaptfault.acquisition import read_key
from adaptfault.data.calibration import Calibration
from adaptfault.data.recordings import InputError, load, open_recordings
from adaptfault.fleet.listing import Fleet


def header(shape, kind) -> bytes:
    file = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        file, {"descr": kind, "fortran_order": False, "shape": shape}
    )
    return file.getvalue()


def bomb(path):
    with (
        zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive,
        archive.open("frames.npy", "w") as file,
    ):
        file.write(header((1, 1 << 20, 1024), "<f4"))
        file.write(bytes(1 << 20))


def long_names(path):
    with zipfile.ZipFile(path, "w") as archive:
        frames = np.zeros((1, 4, 6), np.float32)
        archive.writestr("frames.npy", header(frames.shape, "<f4") + frames.tobytes())
        archive.writestr("names.npy", header((1,), "<U500000000"))


def short_array(path):
    path.write_bytes(header((1 << 20, 1024), "<f4"))


def sparse(path):
    with open(path, "wb") as file:
        file.truncate(100_000_000_000)


@pytest.mark.parametrize(
    ("name", "make", "message"),
    [
        ("a.npz", bomb, "declares 4,294,967,296 bytes"),
        ("a.npz", long_names, "'names' declares texts of 2,000,000,000 bytes"),
        ("a.npy", short_array, "declares 4,294,967,296 bytes and holds"),
        ("a.csv", sparse, "is not a text file"),
    ],
)
def test_a_file_that_declares_too_much_is_left_out_and_the_others_go_on(
    tmp_path, name, make, message
):
    make(tmp_path / name)
    (tmp_path / "good.csv").write_text("1,2,3,4,5,0.5\n" * 20)
    tracemalloc.start()
    loaded = load(tmp_path, layout=(1, 2, 3))
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert most < 50_000_000
    assert len(loaded.recordings) == 1
    assert message in loaded.problems[0].message


@pytest.mark.parametrize(
    ("name", "make"),
    [("a.npz", bomb), ("a.csv", sparse), ("a.csv", lambda p: p.write_text("x,y\n" * 9))],
)
def test_one_bad_file_does_not_end_a_run_in_pieces(tmp_path, name, make):
    make(tmp_path / name)
    (tmp_path / "good.csv").write_text("1,2,3,4,5,0.5\n" * 20)
    opened = open_recordings(tmp_path, layout=(1, 2, 3), room=0)
    assert sum(len(piece) for piece in opened.pieces()) == 20
    assert [
        p.message.split(":")[0].split("/")[-1].split(",")[0]
        for p in opened.problems
        if p.level == "error"
    ] == [name]


def private_key(path):
    pytest.importorskip("cryptography")
    from adaptfault.bundle.signature import read_private_key

    read_private_key(path)


@pytest.mark.parametrize("read", [Calibration.read, Fleet.read, read_key, private_key])
def test_a_pipe_and_a_device_are_no_documents(tmp_path, read):
    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path / "pipe", "/dev/zero"):
        with pytest.raises(InputError, match="is not a regular file"):
            read(path)


def test_a_pipe_is_no_recording(tmp_path):
    os.mkfifo(tmp_path / "pipe.csv")
    with pytest.raises(InputError, match="no recording"):
        load(tmp_path / "pipe.csv")


def test_a_calibration_that_would_fill_the_memory_is_refused(tmp_path):
    points = "".join(f"999999,{i},{i}\n" for i in range(20_000))
    (tmp_path / "c.csv").write_text(f"cell,raw,force\n{points}")
    with pytest.raises(InputError, match="20000 points of one cell and 1000000 cells"):
        Calibration.read(tmp_path / "c.csv")
