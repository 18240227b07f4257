"""Which files are read."""

import os
import sys

import pytest
from recording_files import messages, newtons, refusal, write

from adaptfault.data.recordings import load


def test_a_path_that_is_not_there_is_refused(tmp_path):
    assert (
        refusal(tmp_path / "gone.csv") == f"{tmp_path / 'gone.csv'}: is not there; check the path"
    )
    assert "no path given" in refusal([])
    assert "is not there" in refusal(tmp_path / ("x" * 200))


def test_a_folder_without_recordings_and_an_unknown_kind_of_file_are_refused(tmp_path):
    (tmp_path / "x.csv").mkdir()
    message = refusal(tmp_path / "x.csv")
    assert (
        "x.csv: the folder holds no recordings; expected files that end in .asc, .csv, .db3, .mcap,"
        " .npy, .npz, .tsv, .txt" in message
    )
    assert "notes.txt: is no recording" in refusal(write(tmp_path / "notes.txt", "hello"))


def test_hidden_files_and_folders_named_like_files_are_passed_over(tmp_path):
    write(tmp_path / "a.csv", newtons(3))
    (tmp_path / "._a.csv").write_bytes(b"\0\1")
    (tmp_path / "b.csv").mkdir()
    assert load(tmp_path).problems == ()


@pytest.mark.skipif(sys.platform == "win32", reason="links need rights there")
def test_folders_that_are_links_are_searched_and_loops_of_links_end(tmp_path):
    write(tmp_path / "elsewhere/a.csv", newtons(3))
    (tmp_path / "data").mkdir()
    (tmp_path / "data/good").symlink_to(tmp_path / "elsewhere", target_is_directory=True)
    (tmp_path / "elsewhere/loop").symlink_to(tmp_path / "data", target_is_directory=True)
    recordings = load(tmp_path / "data").recordings
    assert recordings.names == ("good/a.csv",)


def test_a_file_given_twice_is_read_once(tmp_path):
    file = write(tmp_path / "a.csv", newtons(3))
    assert len(load([file, tmp_path, str(file)]).recordings) == 1


def test_a_file_that_may_not_be_read_is_told(tmp_path, monkeypatch):
    write(tmp_path / "a.csv", newtons(3))
    locked = write(tmp_path / "b.csv", newtons(3))

    def refuse(path, *args, original=open, **options):
        if path == locked:
            raise PermissionError(13, "Permission denied", str(path))
        return original(path, *args, **options)

    monkeypatch.setattr("builtins.open", refuse)
    (error,) = messages(load(tmp_path), "error")
    assert (
        error == f"{locked}: cannot be read (Permission denied); check the path and its permissions"
    )


@pytest.mark.skipif(sys.platform != "linux", reason="other systems refuse such names")
def test_a_name_that_is_no_unicode_can_still_be_printed(tmp_path):
    with open(os.fsencode(tmp_path) + b"/\xff\n.csv", "wb") as file:
        file.write(b"a,b\nc,d\n")
    assert refusal(tmp_path).encode("utf-8")
