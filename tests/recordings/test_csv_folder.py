"""CSV files: what is taken, what is refused, and what the user is told."""

import sys

import numpy as np
import pytest
from recording_files import PAPER, csv_blocks, messages, newtons, refusal, rng, text, write

from adaptfault.data.recordings import load
from adaptfault.data.recordings.errors import InputError
from diagnostics import SensorLayout


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
    "header",
    [
        ",".join(f"cell_{i}" for i in range(220)),
        ",".join(map(str, range(220))),
        ",".join(['"c"'] * 220),
    ],
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
    body = (
        text(values).replace("\n", '"\n"').replace(",", '","')[:-1]
        if '"' in disguise
        else text(values)
    )
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
    assert messages(loaded, "warning") == [
        f"{tmp_path / 'a.csv'}: 1 missing reading, first in line 4: kept as missing"
    ]


def damaged(change):
    rows = text(newtons(6)).split("\n")[:-1]
    return "\n".join(change(rows)) + "\n"


def put(rows, line, cell, value):
    cells = rows[line].split(",")
    cells[cell : cell + 1] = value
    return [*rows[:line], ",".join(cells), *rows[line + 1 :]]


@pytest.mark.parametrize("reading", ["inf", "-1e999", "3.5e38"])
def test_an_infinite_reading_is_taken_as_missing_and_told_with_its_line(tmp_path, reading):
    loaded = load(write(tmp_path / "a.csv", damaged(lambda rows: put(rows, 4, 0, [reading]))))
    assert np.argwhere(np.isnan(loaded.recordings.frames[0])).tolist() == [[4, 0]]
    assert messages(loaded, "warning") == [
        f"{tmp_path / 'a.csv'}: 1 infinite reading, first in line 5: taken as missing"
    ]


@pytest.mark.parametrize("times", [["nan"] * 9, ["1e308", "-1e308"] * 3, ["5"] * 4])
def test_times_that_never_rise_give_no_rate(tmp_path, times):
    lines = "\n".join(f"{time},1,2,{i},4" for i, time in enumerate(times))
    loaded = load(write(tmp_path / "a.csv", f"time,a,b,c,d\n{lines}\n"), layout="2x2")
    assert loaded.recordings.layout.rate == 10
    assert any("rate 10 Hz (assumed" in text for text in loaded.inferred)


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        (
            damaged(lambda r: put(r, 2, 7, ["abc"])),
            "a.csv, line 3, column 8: 'abc' is not a number; write the reading",
        ),
        (
            damaged(lambda r: put(r, 2, 7, ["1_0"])),
            "a.csv, line 3, column 8: '1_0' is not a number",
        ),
        (
            damaged(lambda r: put(r, 0, 7, ["abc"])),
            "a.csv, line 1, column 8: 'abc' is not a number",
        ),
        (
            damaged(lambda r: put(r, 2, 7, [])),
            "a.csv, line 3: 219 values where the other lines have 220",
        ),
        (
            damaged(lambda r: put(r, 0, 7, [])),
            "a.csv, line 1: 219 values where the other lines have 220",
        ),
        (
            damaged(lambda r: put(r, 5, 7, [])),
            "a.csv, line 6: 219 values where the other lines have 220; the recording",
        ),
        (
            text(newtons(6, 219)),
            "a.csv, line 1: 219 values a frame, expected 220: a column is missing",
        ),
        (
            text(newtons(6, 221)),
            "a.csv, line 1: 221 values a frame, expected 220: if the first column is a time",
        ),
        (
            damaged(lambda r: [x + "," for x in r]),
            "expected 220: each line ends with a comma, remove it",
        ),
        (
            damaged(lambda r: ["2024-05-01," + x for x in r]),
            "a.csv, line 1, column 1: '2024-05-01' is not a number",
        ),
        (
            "time,a,b\n1,2,3\nnoon,2,3\n",
            "a.csv, line 3, column 1: 'noon' is no time; write a number, or a date as",
        ),
        (
            "time,a,b\n2025-13-01 00:00:00,2,3\n",
            "a.csv, line 2, column 1: '2025-13-01 00:00:00' is no time",
        ),
        ("frame\n1\n2\n", "line 2: holds numbers of frames and no readings"),
        ("", "a.csv: is empty (0 bytes)"),
        ("\n\n", "a.csv: holds no readings"),
        ("cell_0,cell_1\n", "a.csv: holds no readings"),
        ("# notes\nwritten by hand\n", "a.csv: holds no readings"),
    ],
)
def test_a_bad_csv_is_refused_with_its_line_and_the_mend(tmp_path, content, expected):
    assert expected in refusal(write(tmp_path / "a.csv", content))


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        (b"\x00\x01\x02", "is not a text file"),
        (b"\x89PNG\r\n\x1a\n\x00", "is not a text file"),
        (b"1,2,3\n1,2,\xb5\n", "line 2, column 3: '\xb5' is not a number"),
    ],
)
def test_a_binary_csv_is_refused(tmp_path, content, expected):
    (tmp_path / "a.csv").write_bytes(content)
    assert expected in refusal(tmp_path / "a.csv")


def test_a_csv_whose_pages_did_not_all_reach_the_disk_gives_the_lines_before_the_gap(tmp_path):
    lines = [",".join(f"{i / 7 + cell + 0.5:.5g}" for cell in range(6)) for i in range(400)]
    data = ("\n".join(lines) + "\n").encode()
    (tmp_path / "a.csv").write_bytes(data[:4096] + bytes(4096) + data[8192:])
    whole = data[:4096].count(b"\n")
    result = load(tmp_path / "a.csv", layout=SensorLayout(1, 2, 3))
    assert len(result.recordings.frames[0]) == whole
    assert f"line {whole + 1}: cut off in this line" in str(result.problems[0])
    assert sum(len(piece.lines) for piece in csv_blocks(tmp_path / "a.csv", 1000)) == whole
    (tmp_path / "b.csv").write_bytes("1,2,3,4,5,6\n".encode("utf-16-le"))
    with pytest.raises(InputError, match="zero bytes"):
        load(tmp_path / "b.csv", layout=SensorLayout(1, 2, 3))


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
                assert b"," not in data[cut : ends[complete]]
                assert not zeros
            elif cut not in ends:
                (warning,) = messages(loaded, "warning")
                assert (
                    f"line {complete + 1}: cut off in this line: the lines before it are kept"
                    in warning
                )


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
        f"{tmp_path / '4.csv'}: 99 rows where the others have 100: kept; windows use whole windows"
        " only"
    ]


def test_99_rows_are_refused_where_100_were_asked_for(tmp_path):
    for i in range(3):
        write(tmp_path / f"{i}.csv", newtons(99 if i == 1 else 100))
    loaded = load(tmp_path, frames=100)
    assert len(loaded.recordings) == 2
    assert messages(loaded, "error")[0].startswith(
        f"{tmp_path / '1.csv'}: 99 rows where 100 were expected;"
    )


def test_lengths_that_differ_throughout_are_no_problem(tmp_path):
    for i in range(5):
        write(tmp_path / f"{i}.csv", newtons(10 + i))
    assert load(tmp_path).problems == ()


def test_readings_outside_the_full_scale_are_kept_and_counted_with_the_first_line(tmp_path):
    values = newtons(20)
    values[3, 4] = 7.5
    values[9, 0] = -1
    loaded = load(write(tmp_path / "a.csv", values))
    assert loaded.recordings.frames[0][3, 4] == 7.5
    assert (
        "2 readings outside 0..5 N, first in line 4, the farthest 7.5: kept"
        in messages(loaded, "warning")[0]
    )
    values[3, 4] = 5.05
    values[9, 0] = -0.05
    assert load(write(tmp_path / "a.csv", values)).problems == ()


def test_a_scale_that_most_files_exceed_is_told_once(tmp_path):
    for i in range(9):
        write(tmp_path / f"{i}.csv", rng.uniform(0, 4000, (10, 220)))
    (warning,) = messages(load(tmp_path, layout=PAPER), "warning")
    assert "9 of 9 files hold readings outside 0..5 N: check the layout's full scale" in warning


def test_no_function_is_called_for_each_number_of_a_file(tmp_path):
    """That is what lets a file be read in milliseconds, and is the same on every machine."""
    for i in range(10):
        write(tmp_path / f"{i}.csv", newtons())
    load(tmp_path)  # imports
    calls = 0

    def count(frame, event, argument):
        nonlocal calls
        calls += event in ("call", "c_call")

    sys.setprofile(count)
    try:
        loaded = load(tmp_path)
    finally:
        sys.setprofile(None)
    assert len(loaded.recordings) == 10
    assert calls < 0.3 * 10 * 100 * 220


@pytest.mark.parametrize("header", ["unix_ms", "unixtime", "UTC [ms]", "DateTime (ms)", "millis"])
def test_times_are_told_by_their_name_wherever_they_stand(tmp_path, header):
    rows = [f"{i % 7},{i % 5},{1_700_000_000_000 + 50 * i}" for i in range(50)]
    file = write(tmp_path / "a.csv", "\n".join([f"c0,c1,{header}", *rows]) + "\n")
    loaded = load(file, shape="1x2", full_scale=7, unit="count")
    assert loaded.recordings.layout.rate == 20
    assert not loaded.problems


@pytest.mark.parametrize(
    ("header", "times", "rate"),
    [
        ("timestamp", 1_700_000_000 + np.arange(50) / 20, 20),
        ("time_ms", np.arange(50) * 50, 20),
        ("t [us]", np.arange(50) * 20_000.0, 50),
        ("%time", 1_700_000_000_000_000_000 + np.arange(50) * 50_000_000, 20),
        ("rosbagTimestamp", 1_700_000_000_000_000_000 + np.arange(50) * 50_000_000, 20),
        ("epoch", 1_700_000_000_000 + np.arange(50) * 50, 20),
        ("millis", np.arange(50) * 50, 20),
        ("elapsed_ms", np.arange(50) * 50, 20),
        ("Zeit", [f"10:00:{i / 20:06.3f}" for i in range(50)], 20),
        ("time", np.arange(50) * 100, 10),  # neither 0.01 Hz nor 10 kHz
        (
            "Timestamp",
            [f"{time}Z" for time in np.datetime64("2025-12-31T23:59:59.1") + 50 * np.arange(50)],
            20,
        ),
    ],
)
def test_a_time_column_gives_the_rate_and_is_no_reading(tmp_path, header, times, rate):
    values = newtons(50)
    rows = [f"{time},{row}" for time, row in zip(times, text(values).splitlines(), strict=True)]
    rows[7] = rows[7].rpartition(",")[0] + ","  # a missing reading takes the slower parser
    names = ",".join([header, *(f"cell{i}" for i in range(220))])
    file = write(tmp_path / "a.csv", "\n".join([names, *rows]) + "\n")
    loaded = load(file)
    assert loaded.recordings.layout.rate == rate
    assert f"rate {rate} Hz (time column of a.csv); otherwise give --rate" in loaded.inferred
    np.testing.assert_allclose(loaded.recordings.frames[0][:7], values[:7])
    assert load(file, rate=30).recordings.layout.rate == 30
    in_pieces = list(csv_blocks(file, 5000))
    assert len(in_pieces) > 5
    values = np.concatenate([block.values for block in in_pieces])
    np.testing.assert_array_equal(values, loaded.recordings.frames[0])


@pytest.mark.parametrize(
    "header", ["", "Unnamed: 0", "frame", "Index,time_ms", "sample_no,time_ms"]
)
def test_a_first_column_of_frame_numbers_is_no_reading(tmp_path, header):
    values = newtons(30)
    times = [f",{50 * i}" if "time" in header else "" for i in range(30)]
    rows = [
        f"{i}{time},{row}"
        for i, (time, row) in enumerate(zip(times, text(values).splitlines(), strict=True))
    ]
    # pandas numbers the columns
    for cells in (
        map(str, range(220)),
        (f"cell{i}" for i in range(220)),
    ):
        file = write(tmp_path / "a.csv", "\n".join([",".join([header, *cells]), *rows]))
        loaded = load(file)
        np.testing.assert_allclose(loaded.recordings.frames[0], values, rtol=1e-6)
        assert loaded.recordings.layout.rate == (20 if "time" in header else 10)


def test_a_file_of_times_alone_is_refused(tmp_path):
    file = write(tmp_path / "a.csv", "Time_MS\n0\n50\n100\n")
    assert "line 2: holds a column of times and no readings" in refusal(file)


def test_times_that_fall_are_told_with_their_line_and_the_rate_is_that_of_the_others(tmp_path):
    rows = [f"{8 * (i % 20)},1,2,{4 * i},4" for i in range(60)]
    file = write(tmp_path / "a.csv", "\n".join(["time_ms,a,b,c,d", *rows]) + "\n")
    loaded = load(file, layout="2x2")
    (warning,) = messages(loaded, "warning")
    assert warning == (
        f"{file}: 2 times are before the one before, first in line 22: the clock was reset, or the"
        " frames are not in order; kept as they stand"
    )
    assert loaded.recordings.layout.rate == 125
