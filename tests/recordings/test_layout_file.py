"""Layouts from files and from words."""

import json

import numpy as np
import pytest
from recording_files import SMALL, archive, counts, messages, newtons, refusal, write

from adaptfault.data.recordings import InputError, load, parse_shape, read_layout
from diagnostics import SensorLayout


def test_a_layout_that_does_not_fit_says_both_shapes(tmp_path):
    file = archive(tmp_path / "a.npz", frames=counts(shape=(1, 3, 2)))
    assert "frames of 1 x 3 x 2 (pads x rows x cols) where the layout has 1 x 2 x 3" in refusal(
        file, layout=SMALL
    )
    file = write(tmp_path / "a.csv", newtons(3, 7))
    assert "line 1: 7 values a frame, expected 6" in refusal(file, layout=SMALL)


def test_a_layout_beside_the_recordings_that_does_not_fit_is_named(tmp_path):
    write(tmp_path / "layout.json", json.dumps(SMALL.to_dict()))
    where = "where the layout of the layout.json beside the recordings has 1 x 2 x 3"
    assert where in refusal(archive(tmp_path / "a.npz", frames=counts(shape=(1, 3, 2))))
    assert "layout.json" not in refusal(tmp_path / "a.npz", layout=SMALL)


def test_a_layout_file_is_read_and_its_scale_goes_before_the_archives(tmp_path):
    layout = SensorLayout(
        1, 2, 3, full_scale=500, unit="count", rate=20, present=[[[1, 1, 1], [1, 1, 0]]]
    )
    path = write(tmp_path / "layout.json", json.dumps(layout.to_dict()))
    assert read_layout(path) == layout
    file = archive(tmp_path / "a.npz", frames=counts(highest=450), full_scale=1023, unit="count")
    loaded = load(file, layout=path)
    assert loaded.recordings.layout == layout
    assert (
        "the file states 0..1023 count, but 0..500 count is used" in messages(loaded, "warning")[0]
    )


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
        (
            '{"pads": 1, "rows": 2, "cols": 3, "rate": "fast"}',
            "field 'rate': expected a number, got 'fast'",
        ),
        ('{"pads": 1, "rows": 2, "cols": 3, "full_scale": NaN}', "full_scale > 0"),
        ('{"pads": 1, "rows": 2, "cols": 3, "unit": 5}', "field 'unit': expected text"),
        ('{"pads": 1, "rows": 2, "cols": 3, "present": [[1], [1, 1]]}', "field 'present'"),
        ('{"pads": 1, "rows": 2, "cols": 3, "present": ["a"]}', "field 'present': expected lists"),
        ('{"pads": 1, "rows": 2, "cols": 3, "present": [[[1, 1, 1]]]}', "present has shape"),
        ('{"pads": 1, "rows": 2, "cols": 3, "colour": 1}', "no field 'colour'"),
        (
            '{"schema": "other/1", "pads": 1, "rows": 2, "cols": 3}',
            "expected schema 'adaptfault.layout/1'",
        ),
    ],
)
def test_a_bad_layout_file_is_refused_with_the_field(tmp_path, content, expected):
    assert_refused(write(tmp_path / "layout.json", content), expected)


def assert_refused(path, expected):
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
    "words", ["", "2", "2x13x6x1", "2x-3x6", "0x3x6", "axbxc", "2x1.5x6", "999999999x9x9", "٢x٣x٤"]
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


def test_frames_of_one_pad_that_may_be_recordings_are_refused_with_both_shapes(tmp_path):
    np.save(tmp_path / "a.npy", np.ones((60, 4, 6)))
    said = refusal(tmp_path / "a.npy")
    assert (
        "6 values a frame, and nothing states their rows and columns; give --shape (rows x columns,"
        " such as" in said
    )
    assert said.endswith("if these are 60 frames of one pad, --shape 4x6")
    assert load(tmp_path / "a.npy", layout="4x6").recordings.frames[0].shape == (60, 24)


@pytest.mark.parametrize("beside", [True, False])
def test_what_a_layout_file_leaves_open_is_taken_from_the_recordings(tmp_path, beside):
    path = write(
        tmp_path / "layout.toml", 'pads = 1\nrows = 2\ncols = 3\nwiring = "bus"\nrest = "low"\n'
    )
    times = np.round(np.arange(200) * 1000 / 35.7)
    values = np.random.default_rng(0).integers(20, 700, (200, 6))
    rows = [",".join(map(str, row)) for row in np.c_[times, values].astype(int)]
    file = write(tmp_path / "a.csv", "\n".join(["time_ms,a,b,c,d,e,f", *rows]))
    loaded = load(file, layout=None if beside else path)
    layout = loaded.recordings.layout
    assert (layout.wiring, layout.rest, layout.full_scale) == ("bus", "low", 1023)
    assert layout.unit == "count"
    assert layout.rate == pytest.approx(35.7, rel=1e-3)
    assert len(loaded.inferred) == 2
    write(path, path.read_text() + "rate = 40\n")
    assert load(file).recordings.layout.rate == 40


TOML = """
pads = 1
rows = 2
cols = 6
full_scale = 255
unit = "count"
rate = 20
rest = "high"
wiring = "bus"
present = [[[1, 1, 1, 1, 1, 1], [1, 1, 1, 1, 1, 0]]]

[groups]
"triangle 0" = [0, 1, 2]
"triangle 1" = [3, 4, 5]
"connector J3" = ["triangle 0", "triangle 1"]
"""


def test_a_layout_with_its_wiring_is_read_from_toml_as_from_json(tmp_path):
    layout = read_layout(write(tmp_path / "skin.toml", TOML))
    assert (layout.rest, layout.wiring, layout.full_scale) == ("high", "bus", 255)
    assert [str(line) for line in layout.lines] == [
        "triangle 0",
        "triangle 1",
        "connector J3",
        "pad 0, bus",
    ]
    assert read_layout(write(tmp_path / "skin.json", json.dumps(layout.to_dict()))) == layout


def test_recordings_keep_the_wiring_of_the_layout_file_beside_or_given(tmp_path):
    layout = read_layout(write(tmp_path / "layout.toml", TOML))
    frames = "\n".join(",".join("0" * 12) for _ in range(20))
    file = write(tmp_path / "a.csv", frames)
    assert load(file).recordings.layout == layout
    assert (
        load(file, layout=tmp_path / "layout.toml", rate=40).recordings.layout.lines == layout.lines
    )


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        ("pads = ", "is not TOML"),
        (TOML.replace('"triangle 1"]', '"triangle 9"]'), "names 'triangle 9', which is no group"),
        (TOML.replace("[3, 4, 5]", "[2, 3]"), "'triangle 0' and 'triangle 1' overlap"),
        (TOML.replace('"bus"', '"star"'), "wiring is one of matrix, bus"),
        (TOML.replace('"high"', "3"), "rest is one of low, high"),
        (TOML.replace("[0, 1, 2]", "3"), "'triangle 0' needs a list of cells"),
    ],
)
def test_a_bad_toml_layout_is_refused_in_one_line(tmp_path, content, expected):
    assert_refused(write(tmp_path / "layout.toml", content), expected)
