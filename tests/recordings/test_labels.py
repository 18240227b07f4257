"""Labels by table."""

import numpy as np
import pytest
from recording_files import messages, newtons, refusal, write

from adaptfault.data.recordings import load


def test_a_label_table_in_the_folder_gives_the_classes(tmp_path):
    for name in ("a", "b", "c d"):
        write(tmp_path / "raw" / f"{name}.csv", newtons(3))
    write(
        tmp_path / "labels.csv",
        'File, Label\nraw/a.csv,void\n"raw\\b.csv",good\nraw/c d.csv,"good"\n',
    )
    loaded = load(tmp_path)
    assert loaded.problems == ()
    assert loaded.recordings.class_names == ("good", "void")
    assert loaded.recordings.labels.tolist() == [1, 0, 0]


def test_a_label_table_elsewhere_is_given_by_option(tmp_path):
    write(tmp_path / "data/0/a.csv", newtons(3))
    table = write(tmp_path / "my.csv", "file,label,note\ndata/0/a.csv,good,first\n")
    assert load(tmp_path / "data", labels=table).recordings.class_names == ("good",)


def test_each_bad_line_of_a_label_table_is_told_and_the_others_go_on(tmp_path):
    for name in "abcd":
        write(tmp_path / f"{name}.csv", newtons(3))
    lines = [
        "file,label",
        "a.csv,1",
        "gone.csv,1",
        "b.csv,2",
        "b.csv,2",
        "c.csv,1",
        "c.csv,2",
        "x",
        "a.csv,",
    ]
    loaded = load(tmp_path, labels=write(tmp_path / "labels.csv", "\n".join(lines)))
    assert loaded.recordings.names == ("a.csv", "b.csv")
    table = tmp_path / "labels.csv"
    assert messages(loaded, "error") == [
        (
            f"{table}, line 3: names 'gone.csv', which is not there; correct the path or remove the"
            " line"
        ),
        f"{table}, line 7: 'c.csv' is labelled '2' here and '1' before; left out, keep one line",
        f"{table}, line 8: 1 cells where the header has 2; give a file and its label",
        f"{table}, line 9: the label is empty; give both",
    ]
    assert messages(loaded, "warning") == [
        f"{table}, line 5: 'b.csv' stands in the table twice; remove one line",
        f"{tmp_path / 'c.csv'}: is not in the table {table}: left out; add a line for it",
        f"{tmp_path / 'd.csv'}: is not in the table {table}: left out; add a line for it",
    ]


@pytest.mark.parametrize("content", ["a.csv,1\n", "file;label\na.csv;1\n", "\n", "name,label\n"])
def test_a_label_table_without_its_header_is_refused(tmp_path, content):
    write(tmp_path / "a.csv", newtons(3))
    write(tmp_path / "labels.csv", content)
    assert "labels.csv, line 1: expected a first line 'file,label', separated by commas" in refusal(
        tmp_path
    )


def test_a_file_beside_the_class_folders_is_left_out_with_a_warning(tmp_path):
    write(tmp_path / "stray.csv", newtons(3))
    write(tmp_path / "good/a.csv", newtons(3))
    loaded = load(tmp_path)
    assert loaded.recordings.names == ("good/a.csv",)
    assert "stray.csv: lies beside the folders of the classes" in messages(loaded, "warning")[0]


def test_classes_that_no_folder_may_be_called_are_written_apart(tmp_path):
    from adaptfault.data.recordings import Recordings, save
    from diagnostics import SensorLayout

    names = ("a/b", "a:b", "A:b", "..", "a_b 2")
    frames = tuple(np.full((5, 6), i / 10 + 0.1) for i in range(len(names)))
    layout = SensorLayout(1, 2, 3, full_scale=1.0)
    save(tmp_path / "out", Recordings(frames, layout, np.arange(len(names)), names))
    again = load(tmp_path / "out").recordings
    assert len(set(again.class_names)) == len(set(again.labels.tolist())) == len(names)
