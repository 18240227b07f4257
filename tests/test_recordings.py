"""Reading recordings: what is taken, what is refused, and what the user is told."""

import json
import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from adaptfault.recordings import InputError, Recordings, load, parse_shape, read_layout, save_npz
from diagnostics import SensorLayout

SDH = Path(__file__).parents[2] / "shared/data/sdh2x13x6_grasps36.npz"
PAPER = SensorLayout.paper()
SMALL = SensorLayout(1, 2, 3)
rng = np.random.default_rng(0)


def newtons(frames=100, cells=220):
    return rng.uniform(0, 4.9, (frames, cells)).round(3)


def text(values):
    return "".join(",".join(f"{v:g}" for v in row) + "\n" for row in np.atleast_2d(values))


def write(path, values):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(values if isinstance(values, str) else text(values))
    return path


def messages(loaded, level):
    return [problem.message for problem in loaded.problems if problem.level == level]


def refusal(*args, **options):
    """Return the one line that a load is refused with."""
    with pytest.raises(InputError) as caught:
        load(*args, **options)
    message = str(caught.value)
    assert "\n" not in message
    return message


# --- the paper's CSV files ---------------------------------------------------------------------------------------


def test_a_csv_of_100_rows_and_220_columns_is_the_papers_sensor(tmp_path):
    values = newtons()
    loaded = load(write(tmp_path / "a.csv", values))
    assert loaded.problems == ()
    assert loaded.recordings.layout == PAPER
    assert loaded.recordings.labels is None
    np.testing.assert_array_equal(loaded.recordings.frames[0], values.astype(np.float32))


def test_the_class_is_the_folders_name_and_numeric_names_sort_as_numbers(tmp_path):
    for name in ("10", "9", "0"):
        write(tmp_path / name / "x.csv", newtons(3))
    recordings = load(tmp_path).recordings
    assert recordings.class_names == ("0", "9", "10")
    assert recordings.labels.tolist() == [0, 1, 2]
    assert recordings.names == ("0/x.csv", "9/x.csv", "10/x.csv")


def test_files_of_two_folders_given_one_by_one_get_their_folders_as_classes(tmp_path):
    files = [write(tmp_path / name / "x.csv", newtons(3)) for name in ("b", "a")]
    recordings = load(files).recordings
    assert recordings.class_names == ("a", "b")
    assert recordings.labels.tolist() == [1, 0]
    assert load(files[0]).recordings.labels is None


def test_the_files_of_a_folder_come_in_natural_order(tmp_path):
    for i in (10, 9, 1):
        write(tmp_path / f"grasp{i}.csv", newtons(2))
    assert load(tmp_path).recordings.names == ("grasp1.csv", "grasp9.csv", "grasp10.csv")


@pytest.mark.parametrize(
    "header", [",".join(f"cell_{i}" for i in range(220)), ",".join(map(str, range(220))), ",".join(['"c"'] * 220)]
)
def test_a_header_line_is_passed_over_and_counted_in_line_numbers(tmp_path, header):
    values = newtons(4)
    values[2, 7] = np.nan
    loaded = load(write(tmp_path / "a.csv", header + "\n" + text(values)))
    assert len(loaded.recordings.frames[0]) == 4
    assert "line 4" in messages(loaded, "warning")[0]


@pytest.mark.parametrize("disguise", ["{}\n\n  \n", "\ufeff{}", "\n{}", '"{}'])
def test_blank_lines_byte_order_marks_and_quotes_do_no_harm(tmp_path, disguise):
    values = newtons(3)
    body = text(values).replace("\n", '"\n"').replace(",", '","')[:-1] if '"' in disguise else text(values)
    loaded = load(write(tmp_path / "a.csv", disguise.format(body)))
    np.testing.assert_array_equal(loaded.recordings.frames[0], values.astype(np.float32))


@pytest.mark.parametrize("end", ["\r\n", "\r"])
def test_line_ends_of_other_systems_are_read(tmp_path, end):
    values = newtons(3)
    (tmp_path / "a.csv").write_bytes(text(values).replace("\n", end).encode())
    np.testing.assert_array_equal(load(tmp_path).recordings.frames[0], values.astype(np.float32))


@pytest.mark.parametrize("gap", ["", "  ", "nan", "NaN"])
def test_a_missing_reading_is_kept_as_nan_and_told_with_its_line(tmp_path, gap):
    rows = text(newtons(5)).split("\n")
    rows[3] = gap + "," + rows[3].split(",", 1)[1]
    loaded = load(write(tmp_path / "a.csv", "\n".join(rows)))
    assert np.isnan(loaded.recordings.frames[0][3, 0])
    assert np.isnan(loaded.recordings.frames[0]).sum() == 1
    assert messages(loaded, "warning") == [f"{tmp_path / 'a.csv'}: 1 missing reading, first in line 4: kept as missing"]


def damaged(change):
    rows = text(newtons(6)).split("\n")[:-1]
    return "\n".join(change(rows)) + "\n"


def put(rows, line, cell, value):
    cells = rows[line].split(",")
    cells[cell : cell + 1] = value
    return [*rows[:line], ",".join(cells), *rows[line + 1 :]]


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        (damaged(lambda r: put(r, 2, 7, ["abc"])), "a.csv, line 3, column 8: 'abc' is not a number; write the reading"),
        (damaged(lambda r: put(r, 2, 7, ["1_0"])), "a.csv, line 3, column 8: '1_0' is not a number"),
        (damaged(lambda r: put(r, 0, 7, ["abc"])), "a.csv, line 1, column 8: 'abc' is not a number"),
        (damaged(lambda r: put(r, 4, 0, ["inf"])), "a.csv, line 5: value 1 is infinite or too large"),
        (damaged(lambda r: put(r, 4, 0, ["-1e999"])), "a.csv, line 5: value 1 is infinite or too large"),
        (damaged(lambda r: put(r, 2, 7, [])), "a.csv, line 3: 219 values where the other lines have 220"),
        (damaged(lambda r: put(r, 0, 7, [])), "a.csv, line 1: 219 values where the other lines have 220"),
        (
            damaged(lambda r: put(r, 5, 7, [])),
            "a.csv, line 6: 219 values where the other lines have 220; the recording",
        ),
        (text(newtons(6, 219)), "a.csv, line 1: 219 values a frame, expected 220: a column is missing"),
        (text(newtons(6, 221)), "a.csv, line 1: 221 values a frame, expected 220: if the first column is a time"),
        (damaged(lambda r: [x + "," for x in r]), "expected 220: each line ends with a comma, remove it"),
        (damaged(lambda r: ["2024-05-01," + x for x in r]), "a.csv, line 1, column 1: '2024-05-01' is not a number"),
        (text(newtons(6)).replace(",", ";"), "a.csv, line 1: separated by ';'? use commas"),
        (text(newtons(6)).replace(",", ";").replace(".", ","), "a.csv, line 1: separated by ';'? use commas"),
        (text(newtons(6)).replace(",", "\t"), "a.csv, line 1: separated by tabs? use commas"),
        (text(newtons(6)).replace(",", " "), "a.csv, line 1: separated by spaces? use commas"),
        ("", "a.csv: is empty (0 bytes)"),
        ("\n\n", "a.csv: holds no readings"),
        ("cell_0,cell_1\n", "a.csv: holds no readings"),
        ("# notes\nwritten by hand\n", "a.csv, line 2"),
    ],
)
def test_a_bad_csv_is_refused_with_its_line_and_the_mend(tmp_path, content, expected):
    assert expected in refusal(write(tmp_path / "a.csv", content))


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        (b"\x00\x01\x02", "is not a text file"),
        (b"\x89PNG\r\n\x1a\n\x00", "is not a text file"),
        ("0,1\n".encode("utf-16"), "is UTF-16 text; save it as UTF-8"),
        (b"1,2,3\n1,2,\xb5\n", "line 2: is not UTF-8 text (byte 0xb5)"),
    ],
)
def test_a_binary_csv_is_refused(tmp_path, content, expected):
    (tmp_path / "a.csv").write_bytes(content)
    assert expected in refusal(tmp_path / "a.csv")


def test_a_csv_that_was_cut_off_anywhere_gives_every_line_before_the_cut_and_says_so(tmp_path):
    values = newtons(4)
    data = text(values).encode()
    ends = [i + 1 for i, byte in enumerate(data) if byte == ord("\n")]
    for cut in range(ends[0] + 1, len(data) + 1, 7):
        for zeros in (b"", b"\0" * 100):
            (tmp_path / "a.csv").write_bytes(data[:cut] + zeros)
            loaded = load(tmp_path / "a.csv")
            (frames,) = loaded.recordings.frames
            complete = sum(end <= cut for end in ends)
            np.testing.assert_array_equal(frames[:complete], values[:complete].astype(np.float32))
            if len(frames) > complete:  # the cut lies in the line's last number, or at its end
                assert cut > ends[complete] - 6 and not zeros  # noqa: PT018
            elif cut not in ends:
                (warning,) = messages(loaded, "warning")
                assert f"line {complete + 1}: cut off in this line: the lines before it are kept" in warning


def test_one_bad_file_does_not_lose_the_others(tmp_path):
    for i in range(4):
        write(tmp_path / f"{i}.csv", newtons(10))
    write(tmp_path / "bad.csv", "0.1,x,0.2\n")
    write(tmp_path / "narrow.csv", newtons(10, 219))
    loaded = load(tmp_path)
    assert len(loaded.recordings) == 4
    bad, narrow = messages(loaded, "error")
    assert "bad.csv, line 1, column 2" in bad
    assert "narrow.csv, line 1: 219 values a frame, expected 220" in narrow


def test_where_nothing_survives_the_first_problem_and_their_number_are_told(tmp_path):
    for i in range(3):
        write(tmp_path / f"{i}.csv", "a,b\nc,d\n")
    message = refusal(tmp_path)
    assert message.startswith(f"{tmp_path / '0.csv'}, line 2, column 1: 'c' is not a number")
    assert message.endswith("(no recording is left; 3 errors in all)")


def test_99_rows_where_the_others_have_100_are_kept_with_a_warning(tmp_path):
    for i in range(10):
        write(tmp_path / f"{i}.csv", newtons(99 if i == 4 else 100))
    loaded = load(tmp_path)
    assert len(loaded.recordings) == 10
    assert messages(loaded, "error") == []
    assert messages(loaded, "warning") == [
        f"{tmp_path / '4.csv'}: 99 rows where the others have 100: kept; windows use whole windows only"
    ]


def test_99_rows_are_refused_where_100_were_asked_for(tmp_path):
    for i in range(3):
        write(tmp_path / f"{i}.csv", newtons(99 if i == 1 else 100))
    loaded = load(tmp_path, frames=100)
    assert len(loaded.recordings) == 2
    assert messages(loaded, "error")[0].startswith(f"{tmp_path / '1.csv'}: 99 rows where 100 were expected;")


def test_lengths_that_differ_throughout_are_no_problem(tmp_path):
    for i in range(5):
        write(tmp_path / f"{i}.csv", newtons(10 + i))
    assert load(tmp_path).problems == ()


def test_readings_outside_the_full_scale_are_kept_and_counted_with_the_first_line(tmp_path):
    values = newtons(20)
    values[3, 4], values[9, 0] = 7.5, -1
    loaded = load(write(tmp_path / "a.csv", values))
    assert loaded.recordings.frames[0][3, 4] == 7.5
    assert "2 readings outside 0..5 N, first in line 4, the farthest 7.5: kept" in messages(loaded, "warning")[0]
    values[3, 4], values[9, 0] = 5.05, -0.05
    assert load(write(tmp_path / "a.csv", values)).problems == ()


def test_a_scale_that_most_files_exceed_is_told_once(tmp_path):
    for i in range(9):
        write(tmp_path / f"{i}.csv", rng.uniform(0, 4000, (10, 220)))
    (warning,) = messages(load(tmp_path, layout=PAPER), "warning")
    assert "9 of 9 files hold readings outside 0..5 N: check the layout's full scale" in warning


def test_a_file_is_read_in_milliseconds(tmp_path):
    body = text(newtons())
    for i in range(70):
        write(tmp_path / str(i % 7) / f"{i}.csv", body)
    start = time.process_time()
    assert len(load(tmp_path).recordings) == 70
    assert (time.process_time() - start) / 70 < 0.02


# --- labels by table ---------------------------------------------------------------------------------------------


def test_a_label_table_in_the_folder_gives_the_classes(tmp_path):
    for name in ("a", "b", "c d"):
        write(tmp_path / "raw" / f"{name}.csv", newtons(3))
    write(tmp_path / "labels.csv", 'File, Label\nraw/a.csv,void\n"raw\\b.csv",good\nraw/c d.csv,"good"\n')
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
    lines = ["file,label", "a.csv,1", "gone.csv,1", "b.csv,2", "b.csv,2", "c.csv,1", "c.csv,2", "x", "a.csv,"]
    loaded = load(tmp_path, labels=write(tmp_path / "labels.csv", "\n".join(lines)))
    assert loaded.recordings.names == ("a.csv", "b.csv")
    table = tmp_path / "labels.csv"
    assert messages(loaded, "error") == [
        f"{table}, line 3: names 'gone.csv', which is not there; correct the path or remove the line",
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
    assert "labels.csv, line 1: expected a first line 'file,label', separated by commas" in refusal(tmp_path)


def test_a_file_beside_the_class_folders_is_left_out_with_a_warning(tmp_path):
    write(tmp_path / "stray.csv", newtons(3))
    write(tmp_path / "good/a.csv", newtons(3))
    loaded = load(tmp_path)
    assert loaded.recordings.names == ("good/a.csv",)
    assert "stray.csv: lies beside the folders of the classes" in messages(loaded, "warning")[0]


# --- paths -------------------------------------------------------------------------------------------------------


def test_a_path_that_is_not_there_is_refused(tmp_path):
    assert refusal(tmp_path / "gone.csv") == f"{tmp_path / 'gone.csv'}: is not there; check the path"
    assert "no path given" in refusal([])
    assert "is not there" in refusal(tmp_path / ("x" * 200))


def test_a_folder_without_recordings_and_an_unknown_kind_of_file_are_refused(tmp_path):
    (tmp_path / "x.csv").mkdir()
    message = refusal(tmp_path / "x.csv")
    assert "x.csv: the folder holds no recordings; expected files that end in .csv, .db3, .mcap, .npy, .npz" in message
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

    def read_bytes(path, original=Path.read_bytes):
        if path == locked:
            raise PermissionError(13, "Permission denied", str(path))
        return original(path)

    monkeypatch.setattr(Path, "read_bytes", read_bytes)
    (error,) = messages(load(tmp_path), "error")
    assert error == f"{locked}: cannot be read (Permission denied); check the path and its permissions"


@pytest.mark.skipif(sys.platform != "linux", reason="other systems refuse such names")
def test_a_name_that_is_no_unicode_can_still_be_printed(tmp_path):
    with open(os.fsencode(tmp_path) + b"/\xff\n.csv", "wb") as file:
        file.write(b"a,b\nc,d\n")
    assert refusal(tmp_path).encode("utf-8")


# --- archives ----------------------------------------------------------------------------------------------------


def archive(path, **arrays):
    np.savez(path, **arrays)
    return path


def counts(n=3, frames=8, shape=(1, 2, 3), highest=1023):
    values = rng.integers(0, highest, (n, frames, *shape)).astype(np.uint16)
    values[0, 0].flat[0] = highest
    return values


@pytest.mark.skipif(not SDH.exists(), reason="the recordings of the real hand are not here")
def test_the_recordings_of_the_real_hand_are_read_without_options():
    loaded = load(SDH)
    recordings = loaded.recordings
    assert loaded.problems == ()
    assert len(recordings) == 856
    assert recordings.layout.shape == (2, 13, 6)
    assert int(recordings.layout.present.sum()) == 136
    assert (recordings.layout.full_scale, recordings.layout.unit, recordings.layout.rate) == (4095, "count", 31.25)
    assert len(recordings.class_names) == 36
    assert recordings.class_names[0] == "aerosol_can"
    with np.load(SDH) as data:
        np.testing.assert_array_equal(recordings.labels, data["labels"])
        assert [len(frames) for frames in recordings] == data["lengths"].tolist()
        np.testing.assert_array_equal(
            recordings.frames[5], data["frames"][5, : data["lengths"][5]].reshape(-1, 156).astype(np.float32)
        )


def test_what_save_npz_writes_load_gives_back(tmp_path):
    present = np.array([[[True, True, False], [True, True, True]]])
    layout = SensorLayout(1, 2, 3, full_scale=700, unit="kPa", rate=31.25, present=present)
    frames = tuple(rng.uniform(0, 700, (length, 6)).astype(np.float32) for length in (4, 9, 2))
    frames[1][3, 1] = np.nan
    before = Recordings(frames, layout, np.array([2, 0, 2]), ("a", "b", "ü c"), ("x/1.csv", "2", "3"))
    save_npz(tmp_path / "all.npz", before)
    loaded = load(tmp_path / "all.npz")
    after = loaded.recordings
    assert messages(loaded, "warning") == [
        f"{tmp_path / 'all.npz'}: 1 missing reading, first in recording 1, frame 3: kept as missing"
    ]
    assert (after.layout, after.class_names, after.names) == (layout, before.class_names, before.names)
    assert after.labels.tolist() == [2, 0, 2]
    for one, other in zip(before, after, strict=True):
        np.testing.assert_array_equal(one, other)
    assert [p.name for p in tmp_path.iterdir()] == ["all.npz"]


def test_recordings_without_labels_survive_the_round_trip(tmp_path):
    save_npz(tmp_path / "a.npz", Recordings((newtons(5), newtons(4)), PAPER))
    after = load(tmp_path / "a.npz").recordings
    assert (after.labels, after.class_names, len(after)) == (None, (), 2)


def test_a_save_that_fails_leaves_the_old_file_and_no_litter(tmp_path, monkeypatch):
    path = write(tmp_path / "a.npz", "old")

    def full_disk(*_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(np, "savez_compressed", full_disk)
    with pytest.raises(OSError, match="No space left"):
        save_npz(path, Recordings((newtons(5),), PAPER))
    assert path.read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["a.npz"]


def test_recordings_that_cannot_be_saved_are_refused(tmp_path):
    with pytest.raises(InputError, match=r"a\.zip"):
        save_npz(tmp_path / "a.zip", Recordings((newtons(5),), PAPER))
    with pytest.raises(FileNotFoundError, match="gone"):
        save_npz(tmp_path / "gone/a.npz", Recordings((newtons(5),), PAPER))
    with pytest.raises(InputError, match="no recordings"):
        save_npz(tmp_path / "a.npz", Recordings((), PAPER))


@pytest.mark.parametrize(
    ("highest", "full_scale"), [(200, 255), (1023, 1023), (1024, 4095), (4095, 4095), (16000, 16383), (65535, 65535)]
)
def test_counts_get_the_full_scale_of_the_smallest_converter_that_holds_them(tmp_path, highest, full_scale):
    loaded = load(archive(tmp_path / "a.npz", frames=counts(highest=highest)))
    assert (loaded.recordings.layout.full_scale, loaded.recordings.layout.unit) == (full_scale, "count")
    in_text = load(write(tmp_path / "a.csv", counts(highest=highest)[0].reshape(8, -1)), layout=(1, 2, 3))
    assert in_text.recordings.layout == loaded.recordings.layout


def test_counts_that_never_rise_leave_a_doubt_about_the_full_scale(tmp_path):
    (warning,) = messages(load(archive(tmp_path / "a.npz", frames=np.zeros((1, 8, 1, 2, 3), np.uint16))), "warning")
    assert "no count exceeds 0: taken as 0..255" in warning


def test_decimal_readings_beyond_5_need_a_full_scale(tmp_path):
    file = archive(tmp_path / "a.npz", frames=rng.uniform(0, 90, (2, 5, 1, 2, 3)))
    assert "more than the paper's 5 N; give the full scale" in refusal(file)
    assert load(file, full_scale=100, unit="kPa").recordings.layout == SensorLayout(1, 2, 3, full_scale=100, unit="kPa")
    assert load(file, layout=SensorLayout(1, 2, 3, full_scale=100)).problems == ()


def test_readings_that_look_scaled_already_are_questioned(tmp_path):
    file = write(tmp_path / "a.csv", newtons() / 5)
    assert "if they are scaled to 0..1 already" in messages(load(file), "warning")[0]
    loaded = load(file, full_scale=1)
    assert (loaded.problems, loaded.recordings.layout.full_scale) == ((), 1.0)


def test_the_archive_says_more_than_the_json_beside_it(tmp_path):
    file = archive(tmp_path / "a.npz", frames=counts(), labels=[0, 1, 1], rate=50.0, present=np.ones((1, 2, 3), bool))
    beside = {"class_names": ["x", "y"], "sampling_hz": 31.25, "unit": "mV", "full_scale": 3300, "units": "long text"}
    write(tmp_path / "a.json", json.dumps(beside))
    recordings = load(file).recordings
    assert recordings.class_names == ("x", "y")
    assert (recordings.layout.rate, recordings.layout.unit, recordings.layout.full_scale) == (50.0, "mV", 3300)


def test_a_broken_json_beside_an_archive_is_a_warning(tmp_path):
    file = archive(tmp_path / "a.npz", frames=counts())
    write(tmp_path / "a.json", '{"class_names": [')
    loaded = load(file)
    assert len(loaded.recordings) == 3
    assert "a.json, line 1: is not JSON" in messages(loaded, "warning")[0]


def test_labels_may_be_text_or_numbers_without_names(tmp_path):
    by_text = load(archive(tmp_path / "a.npz", frames=counts(), labels=["b", "a", "b"])).recordings
    assert (by_text.class_names, by_text.labels.tolist()) == (("a", "b"), [1, 0, 1])
    by_number = load(archive(tmp_path / "a.npz", frames=counts(), labels=[4, 0, 4])).recordings
    assert (by_number.class_names, by_number.labels.tolist()) == (tuple("01234"), [4, 0, 4])


@pytest.mark.parametrize(
    ("arrays", "expected"),
    [
        ({"data": counts()}, "holds no array 'frames'; save the recordings as"),
        ({"frames": counts().astype(object)}, "array 'frames' holds Python objects"),
        ({"frames": counts().astype(str)}, "frames are of type <U"),
        ({"frames": counts() > 0}, "frames are of type bool"),
        ({"frames": np.zeros((0, 5, 6))}, "hold no reading"),
        ({"frames": np.zeros(6)}, "frames have shape [6]; expected [n, T, pads, rows, cols]"),
        ({"frames": counts(), "lengths": [8, 9, 8]}, "recording 1: length 9, but 'frames' has room for 8"),
        ({"frames": counts(), "lengths": [8, -1, 8]}, "recording 1: length -1"),
        ({"frames": counts(), "lengths": [8, 8]}, "array 'lengths' is int64 [2]; expected whole numbers [3]"),
        ({"frames": counts(), "labels": [0, 1]}, "labels have shape [2] for 3 recordings"),
        ({"frames": counts(), "labels": [0, 1, -1]}, "recording 2: label -1; labels are 0 to 9999"),
        ({"frames": counts(), "labels": [0.0, 1, 2]}, "labels are of type float64"),
        (
            {"frames": counts(), "labels": [0, 1, 2], "class_names": ["a", "b"]},
            "label 2; the 2 class names allow 0 to 1",
        ),
        ({"frames": counts(), "labels": ["a", "b", "c"], "class_names": ["a", "b"]}, "label 'c' is not among"),
        ({"frames": counts(), "class_names": ["a", "a"]}, "a class name occurs twice"),
        ({"frames": counts(), "class_names": np.array(["a", 1], object)}, "array 'class_names' holds Python objects"),
        ({"frames": counts(), "class_names": 5}, "expected a list of text"),
        ({"frames": counts(), "names": ["a"]}, "array 'names' has 1 entries for 3 recordings"),
        ({"frames": counts(), "present": np.ones((1, 3), bool)}, "'present' is bool [1, 3]; expected bool [1, 2, 3]"),
        ({"frames": counts(), "factory_mask": np.zeros((1, 2, 3), bool)}, "'factory_mask' is False everywhere"),
        ({"frames": counts(), "rate": -1.0}, "rate is -1.0; expected one number above 0"),
        ({"frames": counts(), "full_scale": np.nan}, "full_scale is nan"),
        ({"frames": counts(), "full_scale": [1, 2]}, "expected one number above 0"),
        ({"frames": counts(highest=9).astype(np.int64) * 10**6}, "more than 16 bits; give the full scale"),
    ],
)
def test_a_bad_archive_is_refused_with_the_array_and_the_mend(tmp_path, arrays, expected):
    message = refusal(archive(tmp_path / "a.npz", **arrays))
    assert message.startswith(str(tmp_path / "a.npz"))
    assert expected in message


def test_single_recordings_of_an_archive_can_be_bad(tmp_path):
    values = counts().astype(float) / 250
    values[1, 2, 0, 1, 1] = np.inf
    values[2, 7] = np.nan  # behind its length
    loaded = load(archive(tmp_path / "a.npz", frames=values, lengths=[8, 8, 7]))
    assert loaded.recordings.names == (f"{tmp_path / 'a.npz'}, recording 0", f"{tmp_path / 'a.npz'}, recording 2")
    (problem,) = loaded.problems
    assert problem.message.startswith(f"{tmp_path / 'a.npz'}, recording 1, frame 2: value 5 is infinite or too large;")


def test_gaps_at_positions_without_a_cell_are_no_problem(tmp_path):
    values, present = newtons(20).reshape(1, 20, 2, 11, 10), np.ones((2, 11, 10), bool)
    present[0, 0, 0] = False
    values[:, :, 0, 0, 0] = np.nan
    assert load(archive(tmp_path / "a.npz", frames=values, present=present)).problems == ()


def test_a_flat_archive_takes_its_shape_from_the_mask_or_the_layout(tmp_path):
    flat = counts().reshape(3, 8, 6)
    assert load(archive(tmp_path / "a.npz", frames=flat), layout="1x2x3").recordings.layout.shape == (1, 2, 3)
    masked = archive(tmp_path / "c.npz", frames=flat, present=np.ones((3, 2, 1), bool))
    assert load(masked).recordings.layout.shape == (3, 2, 1)
    message = refusal(tmp_path / "a.npz")
    assert "6 values a frame, expected 220 (the paper's sensor); for another array give the layout" in message
    assert "--layout FILE or --shape 2x13x6" in message


@pytest.mark.parametrize("shape", [(4, 5, 6), (5, 6), (4, 5, 1, 2, 3), (5, 1, 2, 3)])
def test_a_single_array_is_read(tmp_path, shape):
    values = rng.uniform(1.1, 4.9, shape)
    np.save(tmp_path / "a.npy", values)
    loaded = load(tmp_path / "a.npy", layout=(1, 2, 3))
    assert loaded.problems == ()
    assert len(loaded.recordings) == (4 if shape[0] == 4 else 1)
    np.testing.assert_array_equal(np.concatenate(loaded.recordings.frames), values.reshape(-1, 6).astype(np.float32))


def test_no_cut_or_flipped_archive_raises_anything_but_an_input_error(tmp_path):
    save_npz(tmp_path / "whole.npz", Recordings((newtons(3, 6), newtons(2, 6)), SMALL, np.array([0, 1])))
    np.save(tmp_path / "whole.npy", newtons(3, 6))
    for whole in (tmp_path / "whole.npz", tmp_path / "whole.npy"):
        data = whole.read_bytes()
        damaged = tmp_path / f"damaged{whole.suffix}"
        for i in range(0, len(data), max(1, len(data) // 100)):
            for content in (data[:i], data[:i] + bytes([data[i] ^ 0x55]) + data[i + 1 :]):
                damaged.write_bytes(content)
                try:
                    load(damaged, layout=SMALL)
                except InputError as error:
                    assert str(error).startswith(str(damaged))  # noqa: PT017


def test_files_that_are_no_archives_are_refused(tmp_path):
    (tmp_path / "a.npz").write_bytes(b"garbage" * 100)
    assert "is no NumPy file" in refusal(tmp_path / "a.npz")
    np.save(tmp_path / "b.npy", counts())
    (tmp_path / "b.npz").write_bytes((tmp_path / "b.npy").read_bytes())
    assert "is a single array; name it .npy" in refusal(tmp_path / "b.npz")
    archive(tmp_path / "c.npz", frames=counts())
    (tmp_path / "c.npy").write_bytes((tmp_path / "c.npz").read_bytes())
    assert "is an archive; name it .npz" in refusal(tmp_path / "c.npy")


def test_files_of_another_array_are_left_out(tmp_path):
    archive(tmp_path / "1.npz", frames=counts())
    archive(tmp_path / "2.npz", frames=counts(shape=(2, 2, 3)))
    archive(tmp_path / "3.npz", frames=counts(), rate=20.0)
    archive(tmp_path / "4.npz", frames=counts(), rate=30.0)
    loaded = load(tmp_path)
    assert len(loaded.recordings) == 6
    other, faster = messages(loaded, "error")
    assert "2.npz: frames of 2 x 2 x 3 (pads x rows x cols) where the layout has 1 x 2 x 3" in other
    assert "4.npz: rate 30.0 where the files before it have 20.0" in faster


def test_recordings_without_labels_beside_labelled_ones_leave_all_without(tmp_path):
    archive(tmp_path / "1.npz", frames=counts(), labels=[0, 1, 0])
    archive(tmp_path / "2.npz", frames=counts())
    loaded = load(tmp_path)
    assert loaded.recordings.labels is None
    assert "3 of 6 recordings have none" in messages(loaded, "warning")[0]


# --- layouts -----------------------------------------------------------------------------------------------------


def test_a_layout_that_does_not_fit_says_both_shapes(tmp_path):
    file = archive(tmp_path / "a.npz", frames=counts(shape=(1, 3, 2)))
    assert "frames of 1 x 3 x 2 (pads x rows x cols) where the layout has 1 x 2 x 3" in refusal(file, layout=SMALL)
    file = write(tmp_path / "a.csv", newtons(3, 7))
    assert "line 1: 7 values a frame, expected 6" in refusal(file, layout=SMALL)


def test_a_layout_file_is_read_and_its_scale_goes_before_the_archives(tmp_path):
    layout = SensorLayout(1, 2, 3, full_scale=500, unit="count", rate=20, present=[[[1, 1, 1], [1, 1, 0]]])
    path = write(tmp_path / "layout.json", json.dumps(layout.to_dict()))
    assert read_layout(path) == layout
    file = archive(tmp_path / "a.npz", frames=counts(highest=450), full_scale=1023, unit="count")
    loaded = load(file, layout=path)
    assert loaded.recordings.layout == layout
    assert "the file says 0..1023 count, but 0..500 count was asked for" in messages(loaded, "warning")[0]


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        ("", "is empty"),
        ("{", "line 1: is not JSON"),
        ("[" * 100_000, "is not JSON"),
        ("[1, 2]", "holds a JSON list where an object"),
        ("{}", "needs the field 'pads'"),
        ('{"pads": 1, "rows": 2}', "needs the field 'cols'"),
        ('{"pads": "1", "rows": 2, "cols": 3}', "field 'pads': expected a whole number, got '1'"),
        ('{"pads": true, "rows": 2, "cols": 3}', "field 'pads': expected a whole number"),
        ('{"pads": 0, "rows": 2, "cols": 3}', "pads >= 1"),
        ('{"pads": 99999, "rows": 99999, "cols": 3}', "more than 1000000 cells"),
        ('{"pads": 1, "rows": 2, "cols": 3, "rate": "fast"}', "field 'rate': expected a number, got 'fast'"),
        ('{"pads": 1, "rows": 2, "cols": 3, "full_scale": NaN}', "full_scale > 0"),
        ('{"pads": 1, "rows": 2, "cols": 3, "unit": 5}', "field 'unit': expected text"),
        ('{"pads": 1, "rows": 2, "cols": 3, "present": [[1], [1, 1]]}', "field 'present'"),
        ('{"pads": 1, "rows": 2, "cols": 3, "present": ["a"]}', "field 'present': expected lists"),
        ('{"pads": 1, "rows": 2, "cols": 3, "present": [[[1, 1, 1]]]}', "present has shape"),
        ('{"pads": 1, "rows": 2, "cols": 3, "colour": 1}', "no field 'colour'"),
        ('{"schema": "other/1", "pads": 1, "rows": 2, "cols": 3}', "expected schema 'adaptfault.layout/1'"),
    ],
)
def test_a_bad_layout_file_is_refused_with_the_field(tmp_path, content, expected):
    path = write(tmp_path / "layout.json", content)
    with pytest.raises(InputError) as caught:
        read_layout(path)
    assert str(caught.value).startswith(str(path))
    assert expected in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_layout_that_is_not_there_is_refused(tmp_path):
    with pytest.raises(InputError, match="No such file"):
        read_layout(tmp_path / "gone.json")


@pytest.mark.parametrize("words", ["2x13x6", " 2 X 13 X 6 ", "2×13×6", "2,13,6"])
def test_a_shape_is_read_from_words(words):
    assert parse_shape(words) == (2, 13, 6)


@pytest.mark.parametrize(
    "words", ["", "2x13", "2x13x6x1", "2x-3x6", "0x3x6", "axbxc", "2x1.5x6", "999999999x9x9", "٢x٣x٤"]
)
def test_a_shape_that_is_none_is_refused(words):
    with pytest.raises(InputError, match=r"^shape .*2x13x6|cells"):
        parse_shape(words)


@pytest.mark.parametrize(
    "options", [{"full_scale": -1}, {"full_scale": float("nan")}, {"rate": 0}, {"full_scale": "x"}]
)
def test_an_option_that_makes_no_layout_is_refused(tmp_path, options):
    assert refusal(write(tmp_path / "a.csv", newtons(3)), **options).startswith("layout: ")
    assert "frames 0" in refusal(tmp_path / "a.csv", frames=0)


# --- calibration and import --------------------------------------------------------------------------------------


def test_counts_are_calibrated_while_they_are_read(tmp_path):
    table = tmp_path / "tables.csv"
    table.write_text("cell,raw,force\n" + "".join(f"{cell},100,0\n{cell},900,4\n" for cell in range(6)))
    file = archive(tmp_path / "a.npz", frames=np.array([[[50, 100, 500, 900, 1000, 300]]], np.uint16), full_scale=1023)
    loaded = load(file, layout="1x2x3", calibration=table)
    assert loaded.recordings.layout == SensorLayout(1, 2, 3, full_scale=4.0, unit="N")
    np.testing.assert_allclose(loaded.recordings.frames[0], [[0, 0, 2, 4, 4, 1]])
    (warning,) = messages(loaded, "warning")
    assert "1 readings below and 1 above the tables of 2 cells" in warning
    assert "tables for 6 cells, but the layout has 4" in refusal(
        archive(tmp_path / "b.npz", frames=counts(shape=(1, 2, 2))), calibration=table
    )


def test_importing_the_readers_is_quick_and_loads_no_torch():
    code = "import sys, adaptfault.calibration, adaptfault.recordings; sys.exit('torch' in sys.modules)"
    root = Path(__file__).parents[1]
    for script in (code, code.replace("adaptfault.calibration, ", "")):
        assert subprocess.run([sys.executable, "-c", script], cwd=root, check=False).returncode == 0
