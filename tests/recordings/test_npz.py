"""NPZ archives and single arrays: what is taken, what is refused, and what the user is told."""

import json

import numpy as np
import pytest
from recording_files import (
    PAPER,
    SDH,
    SMALL,
    archive,
    counts,
    messages,
    newtons,
    refusal,
    rng,
    write,
)

from adaptfault.data.recordings import InputError, Recordings, load, save, save_npz
from diagnostics import SensorLayout


@pytest.mark.skipif(not SDH.exists(), reason="the recordings of the real hand are not here")
def test_the_recordings_of_the_real_hand_are_read_without_options():
    loaded = load(SDH)
    recordings = loaded.recordings
    assert loaded.problems == ()
    assert len(recordings) == 856
    assert recordings.layout.shape == (2, 13, 6)
    assert int(recordings.layout.present.sum()) == 136
    assert (recordings.layout.full_scale, recordings.layout.unit, recordings.layout.rate) == (
        4095,
        "count",
        31.25,
    )
    assert len(recordings.class_names) == 36
    assert recordings.class_names[0] == "aerosol_can"
    with np.load(SDH) as data:
        np.testing.assert_array_equal(recordings.labels, data["labels"])
        assert [len(frames) for frames in recordings] == data["lengths"].tolist()
        np.testing.assert_array_equal(
            recordings.frames[5],
            data["frames"][5, : data["lengths"][5]].reshape(-1, 156).astype(np.float32),
        )


def test_what_save_npz_writes_load_gives_back(tmp_path):
    present = np.array([[[True, True, False], [True, True, True]]])
    layout = SensorLayout(1, 2, 3, full_scale=700, unit="kPa", rate=31.25, present=present)
    frames = tuple(rng.uniform(0, 700, (length, 6)).astype(np.float32) for length in (4, 9, 2))
    frames[1][3, 1] = np.nan
    before = Recordings(
        frames, layout, np.array([2, 0, 2]), ("a", "b", "ü c"), ("x/1.csv", "2", "3")
    )
    save_npz(tmp_path / "all.npz", before)
    loaded = load(tmp_path / "all.npz")
    after = loaded.recordings
    assert messages(loaded, "warning") == [
        f"{tmp_path / 'all.npz'}: 1 missing reading, first in recording 1, frame 3: kept as missing"
    ]
    assert (after.layout, after.class_names, after.names) == (
        layout,
        before.class_names,
        before.names,
    )
    assert after.labels.tolist() == [2, 0, 2]
    for one, other in zip(before, after, strict=True):
        np.testing.assert_array_equal(one, other)
    assert [p.name for p in tmp_path.iterdir()] == ["all.npz"]


def test_recordings_without_labels_survive_the_round_trip(tmp_path):
    save_npz(tmp_path / "a.npz", Recordings((newtons(5), newtons(4)), PAPER))
    after = load(tmp_path / "a.npz").recordings
    assert (after.labels, after.class_names, len(after)) == (None, (), 2)


@pytest.mark.parametrize(
    "declared",
    [
        {"wiring": "bus", "rest": "high"},
        {"groups": {"chip 0": [0, 1, 2], "chip 1": [3, 4, 5], "board": ["chip 0", "chip 1"]}},
        {"axes": 3},
    ],
)
def test_an_archive_keeps_the_wiring(tmp_path, declared):
    layout = SensorLayout(1, 2, 3, full_scale=700, unit="count", **declared)
    frames = rng.integers(0, 700, (9, layout.n_cells)).astype(np.float32)
    assert save(tmp_path / "a.npz", Recordings((frames,), layout)) == ()
    assert load(tmp_path / "a.npz").recordings.layout == layout
    assert "wiring, groups, axes, rest and device" in save(
        tmp_path / "a.npy", Recordings((frames,), layout)
    )


@pytest.mark.parametrize("text", ["no JSON", "[1]", "[" * 100_000, "{}"])
def test_an_array_called_layout_of_another_kind_declares_nothing(tmp_path, text):
    file = archive(tmp_path / "a.npz", frames=counts(), layout=np.frombuffer(text.encode(), "u1"))
    assert load(file).recordings.layout.is_matrix


@pytest.mark.parametrize("axes", [0, "3", 1.5, [3]])
def test_a_wrong_number_of_axes_in_an_archive_is_refused(tmp_path, axes):
    written = np.frombuffer(json.dumps({"axes": axes}).encode(), "u1")
    file = archive(tmp_path / "a.npz", frames=counts(), layout=written)
    assert refusal(file).startswith("layout: ")


def test_csv_files_with_times_give_the_same_recordings_and_rate_without_a_layout(tmp_path):
    layout = SensorLayout(1, 2, 3, full_scale=1023, unit="count", rate=120)
    frames = tuple(rng.integers(0, 900, (n, 6)).astype(np.float32) for n in (60, 75, 90))
    save(tmp_path / "csv", Recordings(frames, layout), times=True)
    first = (tmp_path / "csv/0.csv").read_text().splitlines()
    assert first[0] == "time_ms,cell0,cell1,cell2,cell3,cell4,cell5"
    assert [line.split(",")[0] for line in first[1:5]] == ["0", "8", "17", "25"]
    (tmp_path / "csv/layout.json").unlink()
    loaded = load(tmp_path / "csv", layout="2x3")
    assert loaded.problems == ()
    assert loaded.recordings.layout.rate == pytest.approx(120, rel=1e-3)
    for one, other in zip(loaded.recordings, frames, strict=True):
        np.testing.assert_array_equal(one, other)
    with pytest.raises(InputError, match="name a folder"):
        save(tmp_path / "a.npz", Recordings(frames, layout), times=True)


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
    ("highest", "full_scale"),
    [(200, 255), (1023, 1023), (1024, 4095), (4095, 4095), (16000, 16383), (65535, 65535)],
)
def test_counts_get_the_full_scale_of_the_smallest_converter_that_holds_them(
    tmp_path, highest, full_scale
):
    loaded = load(archive(tmp_path / "a.npz", frames=counts(highest=highest)))
    assert (loaded.recordings.layout.full_scale, loaded.recordings.layout.unit) == (
        full_scale,
        "count",
    )
    in_text = load(
        write(tmp_path / "a.csv", counts(highest=highest)[0].reshape(8, -1)), layout=(1, 2, 3)
    )
    assert in_text.recordings.layout == loaded.recordings.layout


def test_counts_that_never_rise_leave_a_doubt_about_the_full_scale(tmp_path):
    (warning,) = messages(
        load(archive(tmp_path / "a.npz", frames=np.zeros((1, 8, 1, 2, 3), np.uint16))), "warning"
    )
    assert "no count exceeds 0: taken as 0..255" in warning


def test_decimal_readings_of_another_array_get_a_scale_that_is_reported(tmp_path):
    values = rng.uniform(0, 80, (2, 5, 1, 2, 3))
    values[0, 0, 0, 0, 0] = 88.2
    file = archive(tmp_path / "a.npz", frames=values)
    loaded = load(file)
    assert (loaded.recordings.layout.full_scale, loaded.recordings.layout.unit) == (89, "a.u.")
    assert any(
        "full scale 89 a.u. (largest reading 88.2, no converter step" in text
        for text in loaded.inferred
    )
    assert load(file, full_scale=100, unit="kPa").recordings.layout == SensorLayout(
        1, 2, 3, full_scale=100, unit="kPa"
    )
    assert load(file, layout=SensorLayout(1, 2, 3, full_scale=100)).problems == ()


def test_the_full_scale_of_decimal_readings_is_that_of_the_converter_whose_step_they_show(tmp_path):
    volts = rng.integers(0, 2500, (3, 50, 1, 10, 10)) * (3.3 / 4095)
    for file in (
        archive(tmp_path / "a.npz", frames=volts),
        write(tmp_path / "b.csv", volts[0].reshape(50, -1)),
    ):
        loaded = load(file, layout="10x10")
        assert loaded.recordings.layout.shape == (1, 10, 10)
        assert loaded.recordings.layout.full_scale == pytest.approx(3.3, rel=0.002)
        assert any(
            "converter step 0.000806, 12 bits, largest reading 2.01" in text
            for text in loaded.inferred
        )
    rounded = load(
        archive(tmp_path / "c.npz", frames=np.round(rng.uniform(0, 2.04, (3, 50, 10, 10)), 3))
    )
    # thousandths are how the numbers were written
    assert rounded.recordings.layout.full_scale == 2.1


def test_what_is_stated_is_not_inferred(tmp_path):
    file = archive(tmp_path / "a.npz", frames=rng.uniform(0, 2, (2, 5, 10, 10)))
    assert [text.split()[0] for text in load(file).inferred] == [
        "shape",
        str(file) + ":",
        "full",
        "rate",
    ]
    stated = load(file, layout="1x10x10", full_scale=3.3, unit="V", rate=50)
    assert stated.inferred == ()
    assert stated.recordings.layout == SensorLayout(1, 10, 10, full_scale=3.3, unit="V", rate=50)
    with pytest.raises(
        InputError, match="no reading is above 0, so nothing shows the range; give the full scale"
    ):
        load(archive(tmp_path / "b.npz", frames=np.zeros((2, 5, 10, 10))))


def test_four_axes_are_recordings_of_one_pad_unless_the_shape_has_several(tmp_path):
    values = counts(4, 6, (2, 3))
    for file in (archive(tmp_path / "a.npz", frames=values), tmp_path / "a.npy"):
        np.save(tmp_path / "a.npy", values)
        for layout in (None, "2x3", "1x2x3", (1, 2, 3)):
            recordings = load(file, layout=layout).recordings
            assert (recordings.layout.shape, len(recordings)) == ((1, 2, 3), 4)
            np.testing.assert_array_equal(recordings.frames[1], values[1].reshape(6, 6))
        (one,) = load(file, layout="6x2x3").recordings
        np.testing.assert_array_equal(one, values.reshape(4, 36))
    masked = archive(tmp_path / "b.npz", frames=values, present=np.ones((6, 2, 3), bool))
    assert load(masked).recordings.layout.shape == (6, 2, 3)


def test_an_archive_without_its_json_names_what_it_lost(tmp_path):
    file = archive(tmp_path / "renamed.npz", frames=counts(), labels=[0, 1, 1])
    (lost,) = [text for text in load(file).inferred if "renamed.json" in text]
    assert "no renamed.json beside it" in lost
    assert "class names (the numbers of the labels are used), full scale, rate" in lost
    write(
        tmp_path / "renamed.json",
        json.dumps({"class_names": ["x", "y"], "rate": 20, "full_scale": 1023}),
    )
    assert load(file).inferred == ()


def test_an_archive_that_states_numbers_as_class_names_lost_nothing(tmp_path):
    save_npz(
        tmp_path / "kept.npz",
        Recordings((newtons(), newtons()), PAPER, np.array([0, 1]), ("0", "1")),
    )
    assert load(tmp_path / "kept.npz").inferred == ()


def test_readings_that_look_scaled_already_are_questioned(tmp_path):
    file = write(tmp_path / "a.csv", newtons() / 5)
    assert "if they are scaled to 0..1 already" in messages(load(file), "warning")[0]
    loaded = load(file, full_scale=1)
    assert (loaded.problems, loaded.recordings.layout.full_scale) == ((), 1.0)


def test_the_archive_says_more_than_the_json_beside_it(tmp_path):
    file = archive(
        tmp_path / "a.npz",
        frames=counts(),
        labels=[0, 1, 1],
        rate=50.0,
        present=np.ones((1, 2, 3), bool),
    )
    beside = {
        "class_names": ["x", "y"],
        "sampling_hz": 31.25,
        "unit": "mV",
        "full_scale": 3300,
        "units": "long text",
    }
    write(tmp_path / "a.json", json.dumps(beside))
    recordings = load(file).recordings
    assert recordings.class_names == ("x", "y")
    assert (recordings.layout.rate, recordings.layout.unit, recordings.layout.full_scale) == (
        50.0,
        "mV",
        3300,
    )


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
        ({"data": counts()}, "holds no array 'frames'; it holds data; save the recordings as"),
        ({"frames": counts().astype(object)}, "array 'frames' holds Python objects"),
        ({"frames": counts().astype(str)}, "frames are of type <U"),
        ({"frames": counts() > 0}, "frames are of type bool"),
        ({"frames": np.zeros((0, 5, 6))}, "hold no reading"),
        ({"frames": np.zeros(6)}, "frames have shape [6]; expected [n, T, pads, rows, cols]"),
        (
            {"frames": counts(), "lengths": [8, 9, 8]},
            "recording 1: length 9, but 'frames' has room for 8",
        ),
        ({"frames": counts(), "lengths": [8, -1, 8]}, "recording 1: length -1"),
        (
            {"frames": counts(), "lengths": [8, 8]},
            "array 'lengths' is int64 [2]; expected whole numbers [3]",
        ),
        ({"frames": counts(), "labels": [0, 1]}, "labels have shape [2] for 3 recordings"),
        ({"frames": counts(), "labels": [0, 1, -1]}, "recording 2: label -1; labels are 0 to 9999"),
        ({"frames": counts(), "labels": [0.0, 1, 2]}, "labels are of type float64"),
        (
            {"frames": counts(), "labels": [0, 1, 2], "class_names": ["a", "b"]},
            "label 2; the 2 class names allow 0 to 1",
        ),
        (
            {"frames": counts(), "labels": ["a", "b", "c"], "class_names": ["a", "b"]},
            "label 'c' is not among",
        ),
        ({"frames": counts(), "class_names": ["a", "a"]}, "a class name occurs twice"),
        (
            {"frames": counts(), "class_names": np.array(["a", 1], object)},
            "array 'class_names' holds Python objects",
        ),
        ({"frames": counts(), "class_names": 5}, "expected a list of text"),
        ({"frames": counts(), "names": ["a"]}, "array 'names' has 1 entries for 3 recordings"),
        (
            {"frames": counts(), "present": np.ones((1, 3), bool)},
            "'present' is bool [1, 3]; expected bool [1, 2, 3]",
        ),
        (
            {"frames": counts(), "present": np.ones((1, 3, 2), bool)},
            "'present' is bool [1, 3, 2]; expected bool [1, 2, 3]",
        ),
        (
            {"frames": counts(), "factory_mask": np.zeros((1, 2, 3), bool)},
            "'factory_mask' is False everywhere",
        ),
        ({"frames": counts(), "rate": -1.0}, "rate is -1.0; expected one number above 0"),
        ({"frames": counts(), "full_scale": np.nan}, "full_scale is nan"),
        ({"frames": counts(), "full_scale": [1, 2]}, "expected one number above 0"),
        (
            {"frames": counts(highest=9).astype(np.int64) * 10**6},
            "more than 16 bits; give the full scale",
        ),
    ],
)
def test_a_bad_archive_is_refused_with_the_array_and_the_mend(tmp_path, arrays, expected):
    message = refusal(archive(tmp_path / "a.npz", **arrays))
    assert message.startswith(str(tmp_path / "a.npz"))
    assert expected in message


def test_single_recordings_of_an_archive_can_be_bad(tmp_path):
    values = counts().astype(float) / 250
    values[2, 2, 0, 1, 1] = np.inf
    values[2, 7] = np.nan  # behind its length
    path = archive(tmp_path / "a.npz", frames=values, lengths=[8, 0, 7])
    loaded = load(path)
    assert loaded.recordings.names == (f"{path}, recording 0", f"{path}, recording 2")
    assert [str(problem) for problem in loaded.problems] == [
        f"error: {path}, recording 1: holds no frames; record it again or remove it",
        f"warning: {path}: 1 infinite reading, first in recording 2, frame 2: taken as missing",
    ]
    assert np.argwhere(np.isnan(loaded.recordings.frames[1])).tolist() == [[2, 4]]


def test_gaps_at_positions_without_a_cell_are_no_problem(tmp_path):
    values = newtons(20).reshape(1, 20, 2, 11, 10)
    present = np.ones((2, 11, 10), bool)
    present[0, 0, 0] = False
    values[:, :, 0, 0, 0] = np.nan
    assert load(archive(tmp_path / "a.npz", frames=values, present=present)).problems == ()


def test_a_flat_archive_takes_its_shape_from_the_mask_or_the_layout(tmp_path):
    flat = counts().reshape(3, 8, 6)
    assert load(
        archive(tmp_path / "a.npz", frames=flat), layout="1x2x3"
    ).recordings.layout.shape == (1, 2, 3)
    masked = archive(tmp_path / "c.npz", frames=flat, present=np.ones((3, 2, 1), bool))
    assert load(masked).recordings.layout.shape == (3, 2, 1)
    message = refusal(tmp_path / "a.npz")
    assert (
        "6 values a frame, and nothing states their rows and columns; give --shape (rows x columns,"
        " such as" in message
    )
    assert "such as 2x3) or --layout FILE" in message


def test_frames_whose_first_column_counts_are_refused_with_the_mend(tmp_path):
    (tmp_path / "a.csv").write_text("".join(f"{i},{i % 3},2,3,4,{i % 5},6\n" for i in range(9)))
    message = refusal(tmp_path / "a.csv")
    assert "7 values a frame" in message
    assert "the first column rises from line to line" in message
    assert "such as 2x3" in message


@pytest.mark.parametrize("shape", [(4, 5, 6), (5, 6), (4, 5, 1, 2, 3), (5, 1, 2, 3)])
def test_a_single_array_is_read(tmp_path, shape):
    values = rng.uniform(1.1, 4.9, shape)
    np.save(tmp_path / "a.npy", values)
    loaded = load(tmp_path / "a.npy", layout=(1, 2, 3))
    assert loaded.problems == ()
    assert len(loaded.recordings) == (4 if shape[0] == 4 else 1)
    np.testing.assert_array_equal(
        np.concatenate(loaded.recordings.frames), values.reshape(-1, 6).astype(np.float32)
    )


def test_no_cut_or_flipped_archive_raises_anything_but_an_input_error(tmp_path):
    save_npz(
        tmp_path / "whole.npz", Recordings((newtons(3, 6), newtons(2, 6)), SMALL, np.array([0, 1]))
    )
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
    assert "4.npz: rate 30.0 where other files have 20.0" in faster


def test_recordings_without_labels_beside_labelled_ones_leave_all_without(tmp_path):
    archive(tmp_path / "1.npz", frames=counts(), labels=[0, 1, 0])
    archive(tmp_path / "2.npz", frames=counts())
    loaded = load(tmp_path)
    assert loaded.recordings.labels is None
    assert "3 of 6 recordings have none" in messages(loaded, "warning")[0]


@pytest.mark.parametrize("axes", [(6,), (2, 3), (1, 2, 3)])
def test_recordings_that_stand_one_behind_the_other_are_told_apart_by_their_lengths(tmp_path, axes):
    lengths = np.array([4, 7, 1])
    frames = counts(3, 4).reshape(-1, 6)[:12]
    file = archive(
        tmp_path / "a.npz", frames=frames.reshape(12, *axes), lengths=lengths, labels=[0, 1, 0]
    )
    recordings = load(file, layout=(1, 2, 3)).recordings
    assert [len(one) for one in recordings] == lengths.tolist()
    np.testing.assert_array_equal(np.concatenate(list(recordings)), frames)
    assert recordings.labels.tolist() == [0, 1, 0]


@pytest.mark.parametrize(
    ("written", "full_scale"), [("12 bit (largest reading 619)", 4095), ("10-bit", 1023)]
)
def test_the_json_beside_an_archive_may_describe_the_converter_in_words(
    tmp_path, written, full_scale
):
    file = archive(tmp_path / "a.npz", frames=counts(), labels=[0, 1, 0])
    about = {"full_scale": written, "rate_Hz": 35.7, "classes": ["denim", "linen"]}
    (tmp_path / "a.json").write_text(json.dumps(about))
    loaded = load(file)
    assert loaded.problems == ()
    layout = loaded.recordings.layout
    assert (layout.full_scale, layout.rate) == (full_scale, 35.7)
    assert loaded.recordings.class_names == ("denim", "linen")


def test_words_that_are_no_number_in_the_json_beside_an_archive_are_told_and_ignored(tmp_path):
    file = archive(tmp_path / "a.npz", frames=counts())
    (tmp_path / "a.json").write_text(json.dumps({"full_scale": "large", "rate": "slow"}))
    loaded = load(file)
    assert [text.rpartition("a.json: ")[2] for text in messages(loaded, "warning")] == [
        "full_scale is 'large', no number: ignored",
        "rate is 'slow', no number: ignored",
    ]
    assert loaded.recordings.layout.full_scale == 1023
