"""Targets of a regression by table."""

import numpy as np
import pytest
from recording_files import messages, newtons, refusal, write

from adaptfault.data.recordings import Recordings, load, save
from adaptfault.data.windows import make_windows
from diagnostics import SensorLayout


def test_a_table_gives_the_values_of_each_recording_by_name(tmp_path):
    for name in ("hard/a", "soft/b"):
        write(tmp_path / f"{name}.csv", newtons(12))
    table = write(
        tmp_path / "targets.csv", 'File, force ,row\nhard/a.csv,4000,1e-3\n"soft\\b.csv",-3.5,2\n'
    )
    loaded = load(tmp_path, targets=table)
    assert loaded.problems == ()
    recordings = loaded.recordings
    assert recordings.value_names == ("force", "row")
    assert (recordings.labels, recordings.class_names) == (None, ())
    expected = [[4000, 1e-3], [-3.5, 2]]
    np.testing.assert_allclose(recordings.targets, expected, rtol=1e-6)
    assert recordings.targets[0].dtype == np.float32
    np.testing.assert_array_equal(recordings.select([1]).targets[0], recordings.targets[1])
    windows = make_windows(recordings.frames, recordings.targets, recordings.layout)
    np.testing.assert_allclose(windows.y, expected, rtol=1e-6)


def test_a_table_gives_the_values_of_each_frame_in_any_order(tmp_path):
    write(tmp_path / "a.csv", newtons(3))
    table = write(tmp_path / "t.csv", "file,frame,force\na.csv,2,3\na.csv,0,1\na.csv,1,2\n")
    recordings = load(tmp_path, targets=table).recordings
    assert recordings.targets[0].tolist() == [[1], [2], [3]]


def test_a_table_of_targets_in_the_folder_is_no_recording_and_not_read_without_the_option(tmp_path):
    write(tmp_path / "a.csv", newtons(3))
    write(tmp_path / "targets.csv", "file,force\na.csv,1\n")
    loaded = load(tmp_path)
    assert loaded.problems == ()
    assert loaded.recordings.names == ("a.csv",)
    assert loaded.recordings.targets is None


def test_each_bad_line_of_a_table_of_targets_is_told_and_the_other_files_go_on(tmp_path):
    for name in "abcde":
        write(tmp_path / f"{name}.csv", newtons(3))
    lines = [
        "file,force,row",
        "a.csv,1,2",
        "gone.csv,1,2",
        "b.csv,hard,2",
        "c.csv,1,",
        "x,1",
        "d.csv,1,2",
        "d.csv,1,3",
        "a.csv,1,2",
    ]
    table = write(tmp_path / "targets.csv", "\n".join(lines))
    loaded = load(tmp_path, targets=table)
    assert loaded.recordings.names == ("a.csv",)
    assert messages(loaded, "error") == [
        (
            f"{table}, line 3: names 'gone.csv', which is not there; correct the path or remove the"
            " line"
        ),
        f"{table}, line 4: force is 'hard'; expected a number with a decimal point",
        f"{table}, line 5: row is ''; expected a number with a decimal point",
        f"{table}, line 6: 2 cells where the header has 3; give a cell a column",
        f"{table}, line 8: 'd.csv' has other values before; left out, keep one line",
        *(
            f"{tmp_path / name}: has a line in {table} that cannot be used: left out; correct the"
            " line"
            for name in ("b.csv", "c.csv", "d.csv")
        ),
        f"{tmp_path / 'e.csv'}: is not in the table {table}: left out; add a line for it",
    ]


@pytest.mark.parametrize("number", ["nan", "inf", "1e99", "1,5", "0x10"])
def test_what_is_no_finite_number_is_refused(tmp_path, number):
    write(tmp_path / "a.csv", newtons(3))
    table = write(tmp_path / "t.csv", f'file,force\na.csv,"{number}"\n')
    said = refusal(tmp_path, targets=table)
    assert f"line 2: force is '{number}'; expected a number" in said


@pytest.mark.parametrize(
    ("header", "message"),
    [
        ("", "is empty"),
        ("name,force", "line 1: expected a first line as 'file,force' or 'file,frame,force'"),
        ("file", "line 1: expected a first line as"),
        ("file,frame", "line 1: expected a first line as"),
        ("file,,force", "line 1: expected a first line as"),
        ("file,force,Force", "line 1: the column 'force' stands there twice; rename one of them"),
    ],
)
def test_a_table_of_targets_without_its_columns_is_refused(tmp_path, header, message):
    write(tmp_path / "a.csv", newtons(3))
    table = write(tmp_path / "t.csv", header)
    assert message in refusal(tmp_path, targets=table)


@pytest.mark.parametrize(
    ("frames", "message"),
    [
        ("0 1", "a.csv: has 3 frames, but frame 2 has no values in"),
        ("0 1 2 3", "a.csv: has 3 frames, but there are values of frame 3 in"),
        ("0 1 last", "line 4: the frame is 'last'; expected a whole number, 0 for the first frame"),
        ("0 1 -1", "line 4: the frame is '-1'; expected a whole number"),
    ],
)
def test_values_of_frames_are_those_of_all_frames(tmp_path, frames, message):
    write(tmp_path / "a.csv", newtons(3))
    lines = [f"a.csv,{frame},1" for frame in frames.split()]
    table = write(tmp_path / "t.csv", "\n".join(["file,frame,force", *lines]))
    assert message in refusal(tmp_path, targets=table)


def test_a_file_of_many_recordings_has_no_line_of_targets(tmp_path):
    np.savez(tmp_path / "many.npz", frames=np.ones((2, 5, 2, 13, 6)))
    table = write(tmp_path / "t.csv", "file,force\nmany.npz,1\n")
    said = refusal(tmp_path, targets=table)
    assert "holds 2 recordings" in said
    assert "store each recording in a file of its own" in said


def test_labels_and_targets_are_not_given_together(tmp_path):
    write(tmp_path / "a.csv", newtons(3))
    table = write(tmp_path / "t.csv", "file,force\na.csv,1\n")
    assert "classes or values, not both" in refusal(tmp_path, targets=table, labels=table)


def test_recordings_refuse_targets_that_do_not_fit_them():
    layout = SensorLayout(1, 2, 2)
    frames = (np.zeros((5, 4)), np.zeros((6, 4)))
    with pytest.raises(ValueError, match="2 recordings need as many targets, got 1"):
        Recordings(frames, layout, targets=(np.zeros(2),))
    with pytest.raises(ValueError, match=r"recording 1: expected targets \[2\] or \[6, 2\]"):
        Recordings(frames, layout, targets=(np.zeros(2), np.zeros((5, 2))))
    named = Recordings(frames, layout, targets=(np.zeros(2), np.zeros((6, 2))))
    assert named.value_names == ("value 0", "value 1")


def test_a_file_that_is_written_says_that_it_holds_no_targets(tmp_path):
    layout = SensorLayout(1, 2, 2)
    recordings = Recordings((np.ones((5, 4)),), layout, targets=(np.zeros(2),))
    for name in ("a.npz", "a.npy", "folder"):
        assert "the targets of a regression" in save(tmp_path / name, recordings)
    assert save(tmp_path / "b.npz", Recordings((np.ones((5, 4)),), layout)) == ()
