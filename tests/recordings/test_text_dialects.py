"""Text files as people and instruments write them: separators, preambles, encodings, matrices."""

import json
import os
import re
from pathlib import Path

import numpy as np
import pytest
from recording_files import csv_blocks, messages, newtons, refusal, rng, text, write

from adaptfault.cli import main
from adaptfault.data.recordings import load
from adaptfault.data.recordings.formats import csv_folder, matrices

VALUES = rng.uniform(0.1, 4.9, (30, 6)).round(3)
NAMES = ",".join(f"c{i}" for i in range(6))


def frames(*args, **options):
    options.setdefault("layout", "2x3")
    (one,) = load(*args, **options).recordings.frames
    return one


def separated(separator, decimal="."):
    """Return the values with another separator and decimal sign."""
    return text(VALUES).replace(",", separator).replace(".", decimal)


def is_read(file, **options):
    np.testing.assert_array_equal(frames(file, **options), VALUES.astype(np.float32))


# Suffixes


@pytest.mark.parametrize("suffix", [".csv", ".txt", ".tsv", ".asc", ".TXT"])
def test_a_table_is_read_whatever_its_suffix(tmp_path, suffix):
    is_read(write(tmp_path / f"a{suffix}", VALUES))


def test_notes_among_recordings_are_passed_over_with_one_warning(tmp_path):
    write(tmp_path / "a.csv", VALUES)
    write(tmp_path / "README.txt", "Recorded 2024 by hand.\n\nGrasps of 3 mugs\n")
    write(tmp_path / "requirements.txt", "numpy==1.26\n# 3\n")
    loaded = load(tmp_path, layout="2x3")
    assert len(loaded.recordings) == 1
    assert messages(loaded, "error") == []
    (warning,) = messages(loaded, "warning")
    assert warning == (
        f"{tmp_path / 'README.txt'}: is no recording, it holds no line of numbers: passed over,"
        " and 1 more"
    )


@pytest.mark.parametrize("content", ["# one\n# two\n", "a,b\n"])
def test_a_csv_without_numbers_is_an_error_and_a_txt_is_not(tmp_path, content):
    write(tmp_path / "good.csv", VALUES)
    bad = write(tmp_path / "bad.csv", content)
    write(tmp_path / "notes.txt", content)
    loaded = load(tmp_path, layout="2x3")
    assert messages(loaded, "error") == [f"{bad}: holds no readings; record it again or remove it"]
    assert len(messages(loaded, "warning")) == 1


def test_an_empty_text_file_is_told_and_the_others_are_read(tmp_path):
    write(tmp_path / "a.csv", VALUES)
    write(tmp_path / "b.txt", "")
    (error,) = messages(load(tmp_path, layout="2x3"), "error")
    assert "b.txt: is empty (0 bytes)" in error


# Dialects


@pytest.mark.parametrize(
    ("separator", "decimal"),
    [(",", "."), (";", "."), (";", ","), ("\t", "."), ("\t", ","), (" ", "."), ("   ", "."),
     (", ", "."), (" ; ", ","), (" \t", ".")],
)  # fmt: skip
def test_a_file_with_any_separator_is_read_and_so_are_decimal_commas(tmp_path, separator, decimal):
    is_read(write(tmp_path / "a.csv", separated(separator, decimal)))


@pytest.mark.parametrize("separator", [",", ";", "\t", " "])
def test_a_header_with_any_separator_names_the_time(tmp_path, separator):
    lines = separated(separator).splitlines()
    rows = [f"{20 * i}{separator}{line}" for i, line in enumerate(lines)]
    header = f"time_ms,{NAMES}".replace(",", separator)
    file = write(tmp_path / "a.csv", "\n".join([header, *rows]) + "\n")
    loaded = load(file, layout="2x3")
    np.testing.assert_array_equal(loaded.recordings.frames[0], VALUES.astype(np.float32))
    assert loaded.recordings.layout.rate == 50


@pytest.mark.parametrize("separator", ["\t", ";"])
def test_a_separator_at_the_end_of_each_line_is_no_cell(tmp_path, separator):
    rows = [line + separator for line in separated(separator).splitlines()]
    is_read(write(tmp_path / "a.txt", "\n".join(rows)))
    is_read(write(tmp_path / "b.txt", "\n".join([NAMES.replace(",", separator), *rows])))


@pytest.mark.parametrize(
    "preamble",
    [
        "# glove 3\n",
        "% MATLAB\n% 2024\n",
        "// logger\n",
        "Device: glove\nRate 100 Hz\nOperator;Ada\n\n",
        "sep=,\n",
        f"# glove\n{NAMES}\n",
        f"# {NAMES}\n",
        f"Version 3\n\n{NAMES}\n# next\n",
        "".join(f"note {i}\n" for i in range(2000)),
    ],
)
def test_comments_and_lines_of_text_above_a_table_are_passed_over(tmp_path, preamble):
    is_read(write(tmp_path / "a.txt", preamble + text(VALUES)))


def test_comments_inside_a_table_are_passed_over_and_lines_are_still_counted(tmp_path):
    rows = text(VALUES).splitlines()
    rows[3] = "," + rows[3].partition(",")[2]
    rows.insert(2, "# grasped")
    loaded = load(write(tmp_path / "a.csv", "\n".join(["logger", *rows])), layout="2x3")
    (warning,) = messages(loaded, "warning")
    assert "1 missing reading, first in line 6" in warning


@pytest.mark.parametrize(
    ("encoding", "header"),
    [("utf-16", "Zelle µ"), ("utf-8-sig", "Zelle µ"), ("latin-1", "Zelle µ"), ("cp1252", "°C")],
)
def test_a_file_is_read_in_the_encoding_of_its_program(tmp_path, encoding, header):
    content = f"{header}\n{separated(';', ',')}".replace("\n", "\r\n")
    (tmp_path / "a.csv").write_bytes(content.encode(encoding))
    is_read(tmp_path / "a.csv")
    pieces = list(csv_blocks(tmp_path / "a.csv", 301))
    assert len(pieces) > 3
    np.testing.assert_array_equal(
        np.concatenate([piece.values for piece in pieces]), VALUES.astype(np.float32)
    )


@pytest.mark.parametrize("encoding", ["utf-8", "utf-16", "latin-1"])
def test_names_and_classes_keep_their_letters(tmp_path, encoding):
    rows = [f"{line};Tüte" for line in separated(";").splitlines()]
    content = "\n".join(["Zeitraum;" * 6 + "Größe", *rows])
    (tmp_path / "a.csv").write_bytes(content.encode(encoding))
    loaded = load(tmp_path, layout="2x3", label_column="Größe")
    assert loaded.recordings.class_names == ("Tüte",)


@pytest.mark.parametrize("gap", ["", "N/A", "NA", "nan", "null", "NULL", "-", '""'])
@pytest.mark.parametrize("separator", [",", ";", "\t"])
def test_words_for_missing_are_missing_readings(tmp_path, gap, separator):
    rows = separated(separator).splitlines()
    for line, cell in ((0, 0), (4, 2)):
        cells = rows[line].split(separator)
        cells[cell] = gap
        rows[line] = separator.join(cells)
    values = frames(write(tmp_path / "a.csv", "\n".join(rows)))
    assert np.argwhere(np.isnan(values)).tolist() == [[0, 0], [4, 2]]


def test_quoted_values_may_hold_a_decimal_comma_beside_semicolons(tmp_path):
    rows = ['"' + line.replace(";", '";"') + '"' for line in separated(";", ",").splitlines()]
    header = '"name; unit"' + ";c" * 5
    is_read(write(tmp_path / "a.csv", "\n".join([header, *rows])))


def test_a_line_with_another_separator_is_named(tmp_path):
    rows = separated(";").splitlines()
    rows[7] = rows[7].replace(";", ",")
    write(tmp_path / "good.csv", VALUES)
    bad = write(tmp_path / "bad.csv", "\n".join(rows))
    loaded = load(tmp_path, layout="2x3")
    assert len(loaded.recordings) == 1
    assert messages(loaded, "error") == [
        f"{bad}, line 8: 1 value where the other lines have 6; it is separated by ',': use one"
        " separator in the whole file"
    ]


@pytest.mark.parametrize("separator", [";", "\t", " "])
def test_a_ragged_line_is_named_with_any_separator(tmp_path, separator):
    rows = separated(separator).splitlines()
    rows[4] = rows[4].rpartition(separator)[0]
    message = refusal(write(tmp_path / "a.txt", "\n".join(["logger", *rows])), layout="2x3")
    assert "a.txt, line 6: 5 values where the other lines have 6; leave a missing" in message


@pytest.mark.parametrize("separator", [";", "\t", " "])
def test_a_last_line_that_was_cut_off_is_left_out_with_any_separator(tmp_path, separator):
    content = separated(separator)
    cut = content[: content.rstrip("\n").rindex(separator)]
    loaded = load(write(tmp_path / "a.txt", cut), layout="2x3")
    assert len(loaded.recordings.frames[0]) == 29
    assert "line 30: cut off in this line" in messages(loaded, "warning")[0]


def test_a_semicolon_file_is_read_in_pieces_as_in_one(tmp_path):
    file = write(tmp_path / "a.csv", "logger\n\n" + separated(";", ","))
    for size in (40, 100, 1000):
        pieces = list(csv_blocks(file, size))
        np.testing.assert_array_equal(
            np.concatenate([piece.values for piece in pieces]), VALUES.astype(np.float32)
        )
        assert np.concatenate([piece.lines for piece in pieces]).tolist() == list(range(3, 33))


def test_a_first_line_of_missing_readings_is_a_frame_and_one_of_empty_cells_is_none(tmp_path):
    content = f"glove,,,,,\n{NAMES}\n,,,,,\n" + text(VALUES)
    is_read(write(tmp_path / "a.csv", content))
    values = frames(write(tmp_path / "b.csv", f"{NAMES}\n" + "NA," * 5 + "NA\n" + text(VALUES)))
    assert np.isnan(values[0]).all()
    np.testing.assert_array_equal(values[1:], VALUES.astype(np.float32))


def test_the_examples_on_the_page_of_formats_are_read(tmp_path):
    page = (Path(__file__).parents[2] / "docs/file-formats.md").read_text()
    section = page.partition("## Recordings: text")[2].partition("### Classes")[0]
    first, second, third = re.findall(r"```text\n(.*?)```", section, re.DOTALL)
    assert load(write(tmp_path / "1.csv", first), layout="2x2").recordings.layout.rate == 50
    loaded = load(write(tmp_path / "2.csv", second), layout="1x2", label_column="object")
    assert loaded.recordings.layout.rate == 100
    assert loaded.recordings.class_names == ("mug",)
    loaded = load(tmp_path / "2.csv", layout="1x2", ignore="object")
    assert loaded.recordings.labels is None
    loaded = load(write(tmp_path / "3.txt", third))
    assert loaded.recordings.frames[0].shape == (2, 6)
    assert loaded.recordings.layout.shape == (1, 2, 3)


# Matrices


def blocks(between, values=VALUES, separator=","):
    """Return the values as matrices of 2 x 3, with something before each."""
    return "".join(
        between.replace("{}", str(i + 1)) + text(frame.reshape(2, 3)).replace(",", separator)
        for i, frame in enumerate(values)
    )


@pytest.mark.parametrize("separator", [",", ";", "\t", " "])
@pytest.mark.parametrize(
    "between", ["\n", "Frame {}\n", "\nframe: {}\n", "# Frame {}\n", "t = 0.{} s\n", "Frame {}\n\n"]
)
def test_blocks_of_lines_are_matrices_of_one_frame_each(tmp_path, between, separator):
    file = write(tmp_path / "a.txt", blocks(between, separator=separator))
    loaded = load(file)
    np.testing.assert_array_equal(loaded.recordings.frames[0], VALUES.astype(np.float32))
    assert loaded.recordings.layout.shape == (1, 2, 3)
    assert messages(loaded, "warning") == []


def test_matrices_below_a_preamble_are_read_in_pieces_as_in_one(tmp_path, monkeypatch):
    monkeypatch.setattr(matrices, "PIECE", 100)
    file = write(tmp_path / "a.txt", "Device glove\nOperator Ada\n\n" + blocks("\n"))
    is_read(file, layout=None)


@pytest.mark.parametrize("between", ["\n", "Frame {}\n"])
def test_a_frame_with_another_number_of_lines_is_named_and_other_files_go_on(tmp_path, between):
    write(tmp_path / "good.txt", blocks(between))
    rows = blocks(between).splitlines(keepends=True)
    bad = write(tmp_path / "bad.txt", "".join([*rows[:17], rows[16], *rows[17:]]))
    loaded = load(tmp_path)
    assert len(loaded.recordings) == 1
    (error,) = messages(loaded, "error")
    assert error.startswith(f"{bad}, line ")
    assert "lines in this frame where the first has 2; add what is missing" in error


@pytest.mark.parametrize("between", ["\n", "Frame {}\n"])
@pytest.mark.parametrize("cut", [12, 20])
def test_a_last_frame_that_was_cut_off_is_left_out_with_a_warning(tmp_path, between, cut):
    loaded = load(write(tmp_path / "a.txt", blocks(between)[:-cut]))
    np.testing.assert_array_equal(loaded.recordings.frames[0], VALUES[:29].astype(np.float32))
    (warning,) = messages(loaded, "warning")
    assert "line 89: cut off in this frame: the frames before it are kept" in warning


def test_a_ragged_line_and_a_word_in_a_matrix_are_named(tmp_path):
    rows = blocks("Frame {}\n").splitlines()
    rows[7] = rows[7].rpartition(",")[0]
    message = refusal(write(tmp_path / "a.txt", "\n".join(rows)))
    assert "a.txt, line 8: 2 values where the other lines have 3" in message
    rows[7] = "1,x,3"
    message = refusal(write(tmp_path / "a.txt", "\n".join(rows)))
    assert "a.txt, line 8, column 2: 'x' is not a number" in message


def test_blank_lines_inside_a_table_with_a_header_divide_no_frames(tmp_path):
    rows = text(VALUES).splitlines()
    content = "\n".join("\n".join(rows[i : i + 5]) + "\n" for i in range(0, 30, 5))
    is_read(write(tmp_path / "a.csv", f"{NAMES}\n{content}"))


# Tekscan

PREAMBLE = """DATA_TYPE MOVIE
VERSION Pressure Measurement System 7.0
ROWS 2
COLS 3
SECONDS_PER_FRAME 0.02
NOISE_THRESHOLD 3
UNITS kPa
START_FRAME 1
ASCII_DATA @@
"""


def test_a_tekscan_file_states_its_shape_rate_unit_and_the_positions_without_a_cell(tmp_path):
    rows = [f"Frame {i + 1}\nB,{a:g},{b:g}\n{c:g},{d:g},B\n\n" for i, (a, b, c, d) in
            enumerate(VALUES[:, :4])]  # fmt: skip
    file = write(tmp_path / "a.asc", (PREAMBLE + "".join(rows) + "@@\n").replace("\n", "\r\n"))
    loaded = load(file)
    layout = loaded.recordings.layout
    assert (layout.shape, layout.rate, layout.unit) == ((1, 2, 3), 50, "kPa")
    assert layout.present.ravel().tolist() == [False, True, True, True, True, False]
    values = loaded.recordings.frames[0]
    np.testing.assert_array_equal(values[:, 1:5], VALUES[:, :4].astype(np.float32))
    assert loaded.problems == ()


def test_raw_readings_of_a_tekscan_file_are_counts_and_decimal_commas_are_read(tmp_path):
    preamble = PREAMBLE.replace("kPa", "Raw").replace("0.02", "0,01")
    values = np.arange(180).reshape(30, 6) % 200
    file = write(tmp_path / "a.csv", preamble + blocks("Frame {}\n", values, ";"))
    loaded = load(file)
    np.testing.assert_array_equal(loaded.recordings.frames[0], values)
    assert loaded.recordings.layout.unit == "count"
    assert loaded.recordings.layout.rate == 100


def test_a_tekscan_file_of_other_rows_than_it_states_is_refused(tmp_path):
    file = write(tmp_path / "a.asc", PREAMBLE.replace("ROWS 2", "ROWS 3") + blocks("Frame {}\n"))
    assert "a.asc: ROWS 3, but the first frame has 2; correct it" in refusal(file)
    file = write(tmp_path / "b.asc", PREAMBLE)
    assert "b.asc: is no recording" in refusal(file)


# Columns


@pytest.fixture
def table(tmp_path):
    """A file with times, notes, readings, a second device and a class."""
    rows = [
        f"{i},2025-03-01 10:00:{i:02d},grasp,{line},{7 * i},mug"
        for i, line in enumerate(text(VALUES).splitlines())
    ]
    header = f"frame,when,note,{NAMES},imu,object"
    return write(tmp_path / "a.csv", "\n".join([header, *rows]) + "\n")


@pytest.mark.parametrize(
    "columns", ["c0,c1,c2,c3,c4,c5", "c?", "3-8", "c[0-2],6-8", " 3, 4 ,c2,6,7,8,3"]
)
def test_columns_are_chosen_by_name_pattern_or_number(table, columns):
    is_read(table, columns=columns)
    is_read(table, columns=columns.split(","))


def test_columns_come_in_the_order_in_which_they_are_asked_for(table):
    np.testing.assert_array_equal(
        frames(table, columns="c5,c0,c1,c2,c3,c4"), np.roll(VALUES, 1, axis=1).astype(np.float32)
    )


def _named_columns(path, names, values):
    """Write columns in the order of the names; ``values``: of each, by its name."""
    frames = np.stack([values[name] for name in names], axis=1)
    lines = [",".join(map(str, frame)) for frame in frames.tolist()]
    path.write_text("\n".join([",".join(names), *lines]))


@pytest.mark.parametrize(
    ("cell", "file_order"),
    [
        ("c{i}", sorted),  # as a program that sorts names as text writes it
        (
            "r{row}c{column}",
            lambda names: [names[k] for k in (0, 4, 8, 1, 5, 9, 2, 6, 10, 3, 7, 11)],
        ),
        ("pad_{row}_{column}", lambda names: names[::-1]),
    ],
)
@pytest.mark.parametrize("is_table", [True, False])
def test_cells_stand_in_the_order_of_their_numbers_as_in_parquet(
    tmp_path, cell, file_order, is_table
):
    names = [cell.format(i=i, row=i // 4, column=i % 4) for i in range(12)]
    values = {name: np.arange(20) % 7 + 10 * i for i, name in enumerate(names)}
    expected = np.stack([values[name] for name in names], axis=1)
    written = file_order(names)
    assert written != names
    if is_table:
        pq = pytest.importorskip("pyarrow.parquet")
        pa = pytest.importorskip("pyarrow")
        pq.write_table(pa.table({name: values[name] for name in written}), tmp_path / "a.parquet")
    else:
        _named_columns(tmp_path / "a.csv", written, values)
    loaded = load(tmp_path, layout="3x4")
    np.testing.assert_array_equal(loaded.recordings.frames[0], expected)
    told = [text for text in loaded.inferred if "in the order of their numbers" in text]
    assert len(told) == 1


@pytest.mark.parametrize("is_table", [True, False])
@pytest.mark.parametrize(
    "names", ["ch7,ch3,ch1,ch9", "x0y0,x1y0,x0y1,x1y1", "c3,c2,c1,c0", "R1,R0,L0,L1", "a,b,c,d"]
)
def test_columns_whose_numbers_say_nothing_of_their_place_stay_as_they_stand(
    tmp_path, names, is_table
):
    columns = names.split(",")
    values = {name: np.arange(20) % 7 + 10 * i for i, name in enumerate(columns)}
    if is_table:
        pq = pytest.importorskip("pyarrow.parquet")
        pq.write_table(pytest.importorskip("pyarrow").table(values), tmp_path / "a.parquet")
    else:
        _named_columns(tmp_path / "a.csv", columns, values)
    expected = np.stack([values[name] for name in columns], axis=1)
    np.testing.assert_array_equal(load(tmp_path, layout="2x2").recordings.frames[0], expected)


def test_what_is_ignored_is_no_reading(table):
    is_read(table, ignore="when,note,imu,object")
    is_read(table, columns="3-9", ignore=["imu"])


def test_the_time_and_the_class_are_taken_from_the_columns_that_are_named(table):
    loaded = load(table, layout="2x3", columns="c?", time_column="when", label_column="object")
    assert "rate 10 Hz" not in " ".join(loaded.inferred[1:])
    assert loaded.recordings.class_names == ("mug",)
    blocks_ = list(csv_folder.open(table, columns="c?", time_column="when")[0].blocks())
    assert np.diff(blocks_[0].times).tolist() == [1.0] * 29
    assert blocks_[0].tick == "s"


@pytest.mark.parametrize(
    "options", [{"columns": "d0"}, {"ignore": "c0,d*"}, {"time_column": "12"},
                {"label_column": "class"}, {"columns": "3-99"}],
)  # fmt: skip
def test_a_column_that_is_not_there_is_refused_with_those_that_are(table, options):
    message = refusal(table, layout="2x3", **options)
    ((name, _),) = options.items()
    assert f"a.csv: --{name.replace('_', '-')} " in message
    assert "there is no such column; it has frame, when, note, c0, c1, c2" in message


def test_more_columns_than_cells_are_told_with_the_options_that_choose(table):
    message = refusal(table, layout="1x2", ignore="when,note,object")
    assert "6 values a frame, expected 2: --columns or --ignore says which" in message


def test_columns_of_text_are_named_with_the_option_that_leaves_them_out(tmp_path):
    rows = [f"grasp,{line}" for line in text(VALUES).splitlines()]
    header = "note,thumb,index,middle,ring,little,palm"
    file = write(tmp_path / "a.csv", "\n".join([header, *rows]) + "\n")
    message = refusal(file, layout="2x3")
    assert "a.csv, line 2, column 1: 'grasp' is not a number" in message
    assert message.split("(no recording")[0].strip().endswith("--ignore note")
    is_read(file, ignore="note")


def test_each_column_of_many_is_looked_up_once():
    from adaptfault.data.recordings.formats.columns import _numbered

    class Counted(int):
        compared = 0
        __hash__ = int.__hash__

        def __eq__(self, other):
            Counted.compared += 1
            return int(self) == other

    names = ["note", *(f"c{i}" for i in range(900))]
    columns = [Counted(i) for i in range(len(names))]
    kept, told = _numbered(names, columns, None)
    assert kept == list(range(1, len(names)))
    assert "note left out" in told[0]
    assert Counted.compared < 10 * len(names)


def test_what_is_not_numbered_beside_numbered_readings_is_left_out_and_told(table):
    loaded = load(table, layout="2x3")
    np.testing.assert_array_equal(loaded.recordings.frames[0], VALUES.astype(np.float32))
    told = "a.csv: when, note, imu left out, as no reading beside c*; otherwise give --columns"
    assert told in loaded.inferred
    assert loaded.recordings.class_names == ("mug",)


def test_columns_without_names_are_known_by_number(tmp_path):
    rows = [f"{line};left" for line in separated(";", ",").splitlines()]
    file = write(tmp_path / "a.txt", "\n".join(rows))
    assert "--ignore 6" in refusal(file, layout="2x3")
    is_read(file, ignore="6")
    is_read(file, columns="0-5", label_column="6")
    assert "it has columns 0 to 6, without names" in refusal(file, columns="c0", layout="2x3")


def test_the_command_line_takes_the_columns(table, capsys):
    options = ["--shape", "2x3", "--columns", "c?", "--ignore", "imu", "--time-column", "when"]
    options += ["--label-column", "object", "--json"]
    assert main(["info", str(table), *options]) == 0
    assert json.loads(capsys.readouterr().out)
    assert main(["info", str(table), "--shape", "2x3", "--columns", "d?"]) == 3
    assert "--columns d?: there is no such column" in capsys.readouterr().err


# Clocks


@pytest.mark.parametrize(
    ("times", "rate"),
    [
        (1_700_000_000 + np.arange(30) / 20, 20),
        (1_700_000_000_000 + 50 * np.arange(30), 20),
        (1_700_000_000_000_000 + 50_000 * np.arange(30), 20),
        (1_700_000_000_000_000_000 + 50_000_000 * np.arange(30), 20),
        (10 * np.arange(30), 100),
    ],
)
@pytest.mark.parametrize("header", ["", f"when?,{NAMES}\n"])
def test_a_first_column_that_is_a_clock_is_taken_as_one_with_a_warning(
    tmp_path, times, rate, header
):
    rows = [
        f"{t!r},{row}" for t, row in zip(times.tolist(), text(VALUES).splitlines(), strict=True)
    ]
    file = write(tmp_path / "a.csv", header + "\n".join(rows) + "\n")
    loaded = load(file, layout="2x3")
    np.testing.assert_array_equal(loaded.recordings.frames[0], VALUES.astype(np.float32))
    assert loaded.recordings.layout.rate == rate
    assert messages(loaded, "warning") == [
        f"{file}: is the first column a time? it was taken as one; --time-column says which,"
        " --columns says which columns are readings"
    ]
    stated = load(file, layout="2x3", time_column="0")
    assert (stated.problems, stated.recordings.layout.rate) == ((), rate)
    np.testing.assert_array_equal(frames(file, columns="1-6"), VALUES.astype(np.float32))
    assert frames(file, columns="0-6", layout="1x7").shape == (30, 7)


def test_a_clock_of_dates_without_a_header_is_taken_as_one(tmp_path):
    rows = [f"10:00:{i / 20:06.3f};{row}" for i, row in enumerate(separated(";", ",").split())]
    loaded = load(write(tmp_path / "a.csv", "\n".join(rows)), layout="2x3")
    assert loaded.recordings.layout.rate == 20
    np.testing.assert_array_equal(loaded.recordings.frames[0], VALUES.astype(np.float32))


@pytest.mark.parametrize(
    "first",
    [np.arange(30), np.linspace(0.1, 4, 30), rng.permutation(30) * 100, np.full(30, 1e9)],
)
def test_a_first_column_that_counts_frames_or_does_not_run_far_ahead_stays_as_it_is(
    tmp_path, first
):
    rows = [f"{value:g},{row}" for value, row in zip(first, text(VALUES).splitlines(), strict=True)]
    assert frames(write(tmp_path / "a.csv", "\n".join(rows)), layout="1x7").shape == (30, 7)


def test_frames_that_are_counted_without_a_header_are_told_as_before(tmp_path):
    rows = [f"{i},{row}" for i, row in enumerate(text(newtons(200, 6)).splitlines())]
    message = refusal(write(tmp_path / "a.csv", "\n".join(rows)))
    assert "the first column rises from line to line" in message


# Lines in quotes, columns that are told by their names


@pytest.mark.parametrize("separator", [",", ";", "\t"])
def test_lines_in_quotes_as_a_whole_are_read(tmp_path, separator):
    lines = [f"time_ms{separator}{NAMES.replace(',', separator)}"]
    rows = separated(separator).splitlines()
    lines += [f"{20 * i}{separator}{row}" for i, row in enumerate(rows)]
    file = write(tmp_path / "a.csv", "\n".join(f'"{line}"' for line in lines) + "\n")
    is_read(file)
    assert load(file, layout="2x3").recordings.layout.rate == 50
    pieces = list(csv_blocks(file, 301))
    np.testing.assert_array_equal(
        np.concatenate([piece.values for piece in pieces]), VALUES.astype(np.float32)
    )


TIMES = {
    "time_ms": [str(20 * i) for i in range(30)],
    "TIMESTAMP": [f"2024-06-15 13:22:{17 + i / 50:06.3f}" for i in range(30)],
    "timestamp": [f"{1718450000 + i / 50:.2f}" for i in range(30)],
    "host_time": [f"{i / 50:.2f}" for i in range(30)],
    "Time (s)": [f"{i / 50:.2f}" for i in range(30)],
}


@pytest.mark.parametrize("name", TIMES)
@pytest.mark.parametrize("place", [0, 1, 4, 7])
def test_times_are_found_by_name_wherever_they_stand_and_are_no_cell(tmp_path, name, place):
    header = ["object", *NAMES.split(",")]
    header.insert(place, name)
    lines = [",".join(header)]
    for moment, row in zip(TIMES[name], text(VALUES).splitlines(), strict=True):
        cells = ["mug", *row.split(",")]
        cells.insert(place, moment)
        lines.append(",".join(cells))
    file = write(tmp_path / "a.csv", "\n".join(lines) + "\n")
    for options in ({}, {"columns": "c*"}):
        loaded = load(file, layout="2x3", **options)
        np.testing.assert_array_equal(loaded.recordings.frames[0], VALUES.astype(np.float32))
        assert loaded.recordings.layout.rate == 50
        assert loaded.recordings.class_names == ("mug",)
    assert "6 values a frame, expected 7" in refusal(file, layout="1x7")


def test_a_first_column_that_rises_in_equal_steps_is_a_time_also_where_columns_are_named(tmp_path):
    rows = [f"{i / 100:.2f},{row}" for i, row in enumerate(text(VALUES).splitlines())]
    file = write(tmp_path / "a.csv", "\n".join(rows))
    for options in ({}, {"columns": "1-6"}):
        loaded = load(file, layout="2x3", **options)
        np.testing.assert_array_equal(loaded.recordings.frames[0], VALUES.astype(np.float32))
        assert loaded.recordings.layout.rate == 100
        assert "is the first column a time?" in messages(loaded, "warning")[0]


@pytest.mark.parametrize("extra", ["flags", "MAX_VALUE", "PACKAGE_SIZE"])
def test_a_column_that_is_not_numbered_as_the_readings_is_left_out_and_told(tmp_path, extra):
    rows = [f"{row},0" for row in text(VALUES).splitlines()]
    header = f"R_ch0,R_ch1,R_ch2,L_ch0,L_ch1,L_ch2,{extra}"
    file = write(tmp_path / "a.csv", "\n".join([header, *rows]) + "\n")
    loaded = load(file)
    np.testing.assert_array_equal(loaded.recordings.frames[0], VALUES.astype(np.float32))
    assert loaded.recordings.layout.shape == (2, 1, 3)
    told = f"a.csv: {extra} left out, as no reading beside R_ch*, L_ch*; otherwise give --columns"
    assert told in loaded.inferred
    assert "nothing states their rows and columns" in messages(loaded, "warning")[0]
    assert frames(file, layout="1x7").shape == (30, 7)


def test_numbers_of_rows_and_columns_in_the_names_are_the_shape(tmp_path):
    names = [f"r{row}c{col}" for row in range(2) for col in range(3)]
    file = write(tmp_path / "a.csv", ",".join(names) + "\n" + text(VALUES))
    assert load(file).recordings.layout.shape == (1, 2, 3)
    names = names[3:] + names[:3]  # another order than row by row
    file = write(tmp_path / "b.csv", ",".join(names) + "\n" + text(VALUES))
    loaded = load(file).recordings
    assert loaded.layout.shape == (1, 2, 3)
    np.testing.assert_allclose(loaded.frames[0], VALUES[:, [3, 4, 5, 0, 1, 2]], atol=1e-3)


# Episodes and classes in columns


def labelled(path, classes, episodes=None):
    """A file of VALUES, repeated, with a class a line."""
    values = np.tile(VALUES, (len(classes) // len(VALUES) + 1, 1))[: len(classes)]
    header = f"{'' if episodes is None else 'episode_index,'}{NAMES},task"
    lines = [header]
    for i, row in enumerate(text(values).splitlines()):
        number = "" if episodes is None else f"{episodes[i]},"
        lines.append(f"{number}{row},{classes[i]}")
    return write(path, "\n".join(lines) + "\n"), values.astype(np.float32)


@pytest.mark.parametrize("encoding", ["utf-8", "utf-16"])
@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_a_column_of_episodes_divides_a_table(tmp_path, encoding, end, monkeypatch):
    episodes = np.repeat([7, 8, 3], [40, 1, 59])
    classes = np.repeat(["a", "b", "a"], [40, 1, 59])
    file, values = labelled(tmp_path / "a.csv", classes, episodes)
    file.write_bytes(file.read_text().replace("\n", end).encode(encoding))
    for size in (2_000_000, 97):
        monkeypatch.setattr("adaptfault.data.recordings.formats.spans.PIECE", size)
        recordings = load(file, layout="2x3").recordings
        assert [name.rpartition(" ")[2] for name in recordings.names] == ["7", "8", "3"]
        assert [recordings.class_names[i] for i in recordings.labels] == ["a", "b", "a"]
        np.testing.assert_array_equal(np.concatenate(recordings.frames), values)
        assert [len(frames) for frames in recordings.frames] == [40, 1, 59]


def test_a_class_that_changes_for_long_begins_a_recording_and_this_is_told(tmp_path):
    classes = np.repeat(["sit", "lean", "stand", "sit"], 20)
    file, _ = labelled(tmp_path / "a.csv", classes)
    loaded = load(file, layout="2x3")
    found = [loaded.recordings.class_names[i] for i in loaded.recordings.labels]
    assert found == ["sit", "lean", "stand", "sit"]
    assert "a.csv: a recording begins where the class changes, 4 in all" in loaded.inferred


def test_a_class_that_changes_all_the_time_is_told_with_what_is_lost(tmp_path):
    file, _ = labelled(tmp_path / "a.csv", ["stable", "slip", "slip"] * 20)
    loaded = load(file, layout="2x3")
    assert loaded.recordings.class_names == ("slip",)
    (told,) = messages(loaded, "warning")
    assert "the class changes 39 times within a recording" in told
    assert "that of 20 of 60 frames is lost" in told


@pytest.mark.parametrize(
    ("content", "told"),
    [
        ("1," * 1_500_000, "line 1: holds over 1,000,000 numbers"),
        ("c0,c1\n" + "1 " * 1_500_000 + "\n", "line 2: holds over 1,000,000 numbers"),
        ("1" * 3000, "line 1: is over 2,000 bytes long"),
    ],
)
def test_a_line_that_is_longer_than_any_frame_is_named_and_the_others_are_read(
    tmp_path, monkeypatch, content, told
):
    if len(content) < 10_000:
        monkeypatch.setattr("adaptfault.data.recordings.formats.dialect.LONGEST_LINE", 2000)
        monkeypatch.setattr("adaptfault.data.recordings.formats.dialect._CHUNK", 500)
    (tmp_path / "a.csv").write_text(content)
    np.save(tmp_path / "good.npy", VALUES.astype(np.float32))
    loaded = load(tmp_path, layout="1x6")
    assert len(loaded.recordings) == 1
    (error,) = [problem for problem in loaded.problems if problem.level == "error"]
    assert told in error.message


def test_what_is_no_file_is_named_and_passed_over(tmp_path):
    np.save(tmp_path / "good.npy", VALUES.astype(np.float32))
    os.mkfifo(tmp_path / "pipe.csv")
    (tmp_path / "zero.npz").symlink_to("/dev/zero")
    loaded = load(tmp_path, layout="1x6")
    assert len(loaded.recordings) == 1
    told = [problem.message for problem in loaded.problems]
    assert all("is a pipe, a device or a socket" in message for message in told)
    names = sorted(message.partition(":")[0].rpartition("/")[2] for message in told)
    assert names == ["pipe.csv", "zero.npz"]
