"""Layouts that other people's files show by names, structures and lists: gloves, fingertips,
insoles, taxels of three axes, tables of grasps."""

import json
import re

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import scipy.io
from hypothesis import given
from hypothesis import strategies as st
from recording_files import refusal

from adaptfault.data.recordings import load
from adaptfault.data.recordings.facts.roles import axes_of, shape_of, sizes_of
from adaptfault.data.recordings.formats.datasets.features import is_touch

T = 30
rng = np.random.default_rng(0)


def table(path, columns, separator=",", above=""):
    lines = [separator.join(columns)]
    rows = zip(*columns.values(), strict=True)
    lines += [separator.join(str(value) for value in row) for row in rows]
    path.write_text(above + "\n".join(lines) + "\n")
    return path


def counts(cells):
    return rng.integers(0, 1023, (T, cells))


def times():
    return (np.arange(T) * 0.02).round(3)


def test_pads_of_a_glove_that_differ_in_size_are_read_by_rows_and_columns(tmp_path):
    palm = counts(30)
    thumb = counts(16)
    columns = {"timestamp": 1.7e9 + times(), "tick": np.arange(T) + 900}
    columns |= {f"imu_q{axis}": rng.normal(0, 0.5, T) for axis in "wxyz"}
    columns |= {f"palm_r{i // 5}_c{i % 5}": palm[:, i] for i in range(30)}
    columns |= {f"thumb_r{i // 4}_c{i % 4}": thumb[:, i] for i in range(16)}
    columns |= {"": [""] * T}  # as a separator at the end of each line leaves it
    loaded = load(table(tmp_path / "glove.csv", columns))
    layout = loaded.recordings.layout
    assert layout.shape == (2, 6, 5)
    assert layout.present.sum() == 46
    (frames,) = loaded.recordings.frames
    pads = frames.reshape(T, 2, 6, 5)
    np.testing.assert_array_equal(pads[:, 0], palm.reshape(T, 6, 5))
    np.testing.assert_array_equal(pads[:, 1, :4, :4], thumb.reshape(T, 4, 4))
    assert any("palm_r*_c* 6 x 5, thumb_r*_c* 4 x 4" in one for one in loaded.inferred)


@given(sizes=st.lists(st.tuples(st.integers(2, 5), st.integers(2, 5)), min_size=2, max_size=4))
def test_the_sizes_of_pads_are_those_of_their_names(sizes):
    letters = "abcd"
    names = [
        f"{letters[pad]}_r{row}_c{col}"
        for pad, (rows, cols) in enumerate(sizes)
        for row in range(rows)
        for col in range(cols)
    ]
    if len(set(sizes)) == 1:
        shown = shape_of(names)
        assert shown is not None
        assert shown[0] == (len(sizes), *sizes[0])
    else:
        assert shape_of(names) is None
        shown = sizes_of(names)
        assert shown is not None
        assert shown[0] == sizes


def test_fingers_are_pads_and_no_rows(tmp_path):
    readings = counts(24)
    columns = {"t_ms": np.arange(T) * 20}
    columns |= {f"f{i // 12 + 1}_e{i % 12:02d}": readings[:, i] for i in range(24)}
    loaded = load(table(tmp_path / "fingers.csv", columns))
    assert loaded.recordings.layout.shape == (2, 1, 12)
    np.testing.assert_array_equal(loaded.recordings.frames[0], readings)


@pytest.mark.parametrize("grouped", [False, True])
def test_taxels_of_three_axes_are_positions_with_axes(grouped, tmp_path):
    readings = {f"taxel_{i}_{axis}": counts(1)[:, 0] for i in range(16) for axis in "xyz"}
    names = sorted(readings, key=lambda name: name[-1]) if grouped else list(readings)
    path = table(tmp_path / "taxels.csv", {"time": times(), **{n: readings[n] for n in names}})
    loaded = load(path)
    layout = loaded.recordings.layout
    assert (layout.shape, layout.axes) == ((1, 1, 48), 3)
    expected = np.stack([readings[f"taxel_{i}_{axis}"] for i in range(16) for axis in "xyz"], 1)
    np.testing.assert_array_equal(loaded.recordings.frames[0], expected)
    (hint,) = [one.message for one in loaded.problems if "give --shape" in one.message]
    shape = re.search(r"give --shape (\S+),", hint)[1]
    hinted = load(path, shape=shape).recordings
    assert (hinted.layout.pads, hinted.layout.rows, hinted.layout.cols) == (1, 4, 4)
    assert hinted.layout.axes == 3
    np.testing.assert_array_equal(hinted.frames[0], expected)


@given(st.permutations([f"t{i}.{axis}" for i in range(4) for axis in "xyz"]))
def test_axes_stand_together_in_whatever_order_the_columns_are(names):
    axes, order = axes_of(names)
    assert axes == 3
    assert sorted(order) == list(range(12))
    ordered = [names[i] for i in order]
    for i in range(0, 12, 3):
        assert [name[-1] for name in ordered[i : i + 3]] == ["x", "y", "z"]
        assert len({name[:-1] for name in ordered[i : i + 3]}) == 1


def test_names_that_do_not_all_have_the_same_axes_have_none():
    assert axes_of(["t0_x", "t0_y", "t1_x"])[0] == 1
    assert axes_of(["c0", "c1"])[0] == 1
    assert axes_of([])[0] == 1


def test_of_insoles_the_cells_are_read_and_sums_flags_and_resultants_are_not(tmp_path):
    cells = rng.uniform(0, 60, (T, 32)).round(2)
    columns = {"Time [s]": times()}
    for side, name in enumerate(("Left", "Right")):
        some = cells[:, 16 * side : 16 * side + 16]
        columns |= {f"{name} pressure {i + 1} [N/cm2]": some[:, i] for i in range(16)}
        columns |= {f"{name} acceleration {axis} [g]": rng.normal(0, 1, T) for axis in "XYZ"}
        columns |= {f"{name} total force [N]": some.sum(axis=1).round(1)}
        columns |= {f"{name} contact": (some.sum(axis=1) > 500).astype(int)}
    above = "# Insole export 3.1\n# Subject: 12\n"
    path = table(tmp_path / "walk.txt", columns, ";", above)
    path.write_text(path.read_text().replace(".", ","))
    loaded = load(path)
    assert loaded.recordings.layout.shape == (2, 1, 16)
    np.testing.assert_allclose(loaded.recordings.frames[0], cells, rtol=1e-6)


@pytest.mark.parametrize("names", [("peak_{}",), ("c{}_mean", "c{}_max")])
def test_a_table_with_a_row_a_grasp_is_refused_with_the_reason(names, tmp_path):
    columns = {name.format(i): counts(1)[:, 0] for name in names for i in range(16)}
    columns |= {"duration_ms": counts(1)[:, 0], "label": ["cup", "can"] * (T // 2)}
    path = table(tmp_path / "grasps.csv", columns)
    message = refusal(path)
    assert "values of a whole grasp or step" in message
    assert "--columns" in message
    assert load(path, columns=names[0].format("*"), shape=(1, 4, 4)).recordings.layout.n_cells == 16


@pytest.mark.parametrize("written", [list, np.array, lambda row: [np.float64(v) for v in row]])
def test_lists_in_the_cells_of_a_table_are_readings(written, tmp_path):
    readings = rng.uniform(0, 5, (T, 16)).round(3)
    rows = [f'{i * 0.02:.2f},"{written(row)}",{i % 7},go' for i, row in enumerate(readings)]
    path = tmp_path / "lists.csv"
    path.write_text("time,tactile,gripper,task\n" + "\n".join(rows) + "\n")
    message = refusal(path)
    hint = re.search(r"give --shape \(rows x columns, such as (\S+)\)", message)
    value = hint[1]
    recordings = load(path, shape=value).recordings
    np.testing.assert_allclose(recordings.frames[0], readings, rtol=1e-6)
    assert recordings.layout.rate == 50
    assert recordings.class_names == ("go",)


def test_a_list_of_another_length_is_named_with_its_row(tmp_path):
    path = tmp_path / "lists.csv"
    path.write_text('time,tactile\n0,"[1, 2, 3, 4]"\n1,"[1, 2]"\n')
    assert "row 1: tactile holds a list of 2 where the first row has 4" in refusal(path)


def test_electrodes_of_fingertips_are_turned_by_their_times(tmp_path):
    fingers = [rng.integers(3000, 4000, (19, 300)) for _ in range(3)]
    parts = {
        f"F{i}": {"electrodes": one, "pdc": rng.normal(2000, 3, (1, 300)), "tdc": np.ones((1, 300))}
        for i, one in enumerate(fingers)
    }
    trial = {**parts, "time": np.arange(300) / 100, "label": "cup"}
    scipy.io.savemat(tmp_path / "cup.mat", {"trial": trial})
    recordings = load(tmp_path / "cup.mat").recordings
    assert recordings.layout.shape == (3, 1, 19)
    assert recordings.layout.rate == 100
    np.testing.assert_array_equal(recordings.frames[0], np.concatenate(fingers).T)


def test_an_array_of_structures_with_a_time_each_holds_frames(tmp_path):
    readings = rng.uniform(0, 5, (T, 4, 4))
    held = np.zeros((1, T), dtype=[("t", object), ("pressure", object), ("note", object)])
    for i in range(T):
        held[0, i] = (i * 0.02, readings[i], "x")
    scipy.io.savemat(tmp_path / "grasp.mat", {"samples": held})
    recordings = load(tmp_path / "grasp.mat").recordings
    assert recordings.layout.shape == (1, 4, 4)
    np.testing.assert_allclose(recordings.frames[0], readings.reshape(T, 16), rtol=1e-6)
    assert recordings.layout.rate == 50


def test_an_array_of_structures_with_many_times_each_holds_recordings(tmp_path):
    held = np.zeros((1, 12), dtype=[("t", object), ("pressure", object)])
    for i in range(12):
        held[0, i] = (times(), rng.uniform(0, 5, (T, 4, 4)))
    scipy.io.savemat(tmp_path / "grasps.mat", {"trials": held})
    assert len(load(tmp_path / "grasps.mat").recordings.frames) == 12


FINGERS = ("thumb", "index", "middle", "ring")


@pytest.mark.parametrize(
    "name", ["observations/{}_tactile", "{}/tactile", "tactile/{}", "tactile.{}", "{}_finger_skin"]
)
@pytest.mark.parametrize("key", [False, True])
def test_the_index_finger_is_no_counter(name, key, tmp_path):
    names = [name.format(finger) for finger in FINGERS]
    frames = {one: counts(24).reshape(T, 4, 6) for one in names}
    with h5py.File(tmp_path / "hand.h5", "w") as file:
        for one, readings in frames.items():
            file[one] = readings
        file["frame_index"] = np.arange(T)
        file["tactile_frame_index"] = np.arange(T)
    loaded = load(tmp_path / "hand.h5", key=name.format("*") if key else None)
    assert loaded.recordings.layout.shape == (4, 4, 6)
    (read,) = loaded.recordings.frames
    in_order = [frames[one] for one in sorted(names)]
    np.testing.assert_array_equal(read.reshape(T, 4, 4, 6), np.stack(in_order, axis=1))


def test_the_index_finger_has_a_topic_as_the_others_have():
    assert all(is_touch(f"/hand/{finger}/tactile") for finger in FINGERS)
    assert not is_touch("tactile_frame_index")
    assert not is_touch("taxel_index")


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
@pytest.mark.parametrize("number", ["grasp_id", "trial", "episode_id", "demo_id"])
def test_a_table_whose_rows_are_each_another_grasp_is_refused_with_the_reason(
    suffix, number, tmp_path
):
    columns = {number: np.arange(T), "success": counts(1)[:, 0] % 2}
    columns |= {f"{f}_{i}": counts(1)[:, 0] for f in FINGERS for i in range(12)}
    path = tmp_path / f"grasps{suffix}"
    if suffix == ".csv":
        table(path, columns)
    else:
        pq.write_table(pa.table(columns), path)
    message = refusal(path)
    assert "another" in message
    assert "nothing tells how a cell moves" in message


@pytest.mark.parametrize("number", ["grasp_id", "trial_id", "demo_id"])
def test_a_recording_begins_with_each_grasp(number, tmp_path):
    columns = {number: np.repeat([7, 8, 9], T // 3)}
    columns |= {f"cell_r{i // 4}_c{i % 4}": counts(1)[:, 0] for i in range(12)}
    recordings = load(table(tmp_path / "grasps.csv", columns)).recordings
    assert [len(frames) for frames in recordings.frames] == [T // 3] * 3
    assert [name.rpartition(", ")[2] for name in recordings.names] == [
        f"episode {i}" for i in (7, 8, 9)
    ]


def test_the_shapes_that_are_named_for_pads_that_differ_in_size_can_be_stated(tmp_path):
    columns = {"Time(s)": times()}
    sizes = {"Thumb": 9, "Index": 12, "Palm": 25}
    columns |= {f"{pad}_P{i + 1}": counts(1)[:, 0] for pad, n in sizes.items() for i in range(n)}
    path = table(tmp_path / "glove.csv", columns)
    loaded = load(path)
    (told,) = [one.message for one in loaded.problems if "give --shape" in one.message]
    named = re.findall(r"\d+x\d+x\d+", told)
    assert named
    for shape in named:
        stated = load(path, shape=shape)
        assert not [one for one in stated.problems if "--shape" in one.message]
        np.testing.assert_array_equal(stated.recordings.frames[0], loaded.recordings.frames[0])


def test_objects_in_json_lines_are_fields(tmp_path):
    readings = counts(32).reshape(T, 2, 4, 4)
    lines = [
        {
            "header": {"stamp": t * 0.02},
            "hand": {"skin": {"index": a.tolist(), "thumb": b.tolist()}},
        }
        for t, (a, b) in enumerate(readings)
    ]
    path = tmp_path / "log.jsonl"
    path.write_text("".join(json.dumps(line) + "\n" for line in lines))
    recordings = load(path).recordings
    assert recordings.layout.shape == (2, 4, 4)
    assert recordings.layout.rate == 50
    np.testing.assert_array_equal(recordings.frames[0], readings.reshape(T, 32))
