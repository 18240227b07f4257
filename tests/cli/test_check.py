"""adaptfault check: the health of a data set before anybody trains on it."""

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from adaptfault.cli import main
from adaptfault.data.recordings import load
from adaptfault.data.recordings.facts.rates import Elapsed
from adaptfault.data.recordings.valid import valid_masks, write_valid
from adaptfault.data.summary import summarise
from adaptfault.inspection.begins import Begins
from adaptfault.inspection.data_set import DataSetCheck
from adaptfault.inspection.inspection import inspect
from diagnostics import Fault, SelfDiagnosis, SensorLayout, inject

LAYOUT = SensorLayout(1, 3, 4, full_scale=1.0, unit="V", rate=50.0)


def contacts(n: int = 8, seed: int = 0) -> list[np.ndarray]:
    """Recordings that begin and end without contact."""
    rng = np.random.default_rng(seed)
    course = np.maximum(np.sin(np.linspace(-0.5, np.pi + 0.5, 60)), 0)[:, None]
    return [
        0.1 + course * rng.uniform(0.2, 0.8, 12) + rng.normal(0, 0.002, (60, 12)) for _ in range(n)
    ]


def starts(recordings: list[np.ndarray]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    names = [f"{i}" for i in range(len(recordings))]
    return Begins.of(recordings, LAYOUT).in_contact(names, LAYOUT)


@pytest.fixture
def data_set(tmp_path):
    """40 recordings as CSV files with a clock and a layout; cell 7 is dead."""
    folder = tmp_path / "set"
    folder.mkdir()
    (folder / "layout.json").write_text(json.dumps(LAYOUT.to_dict()))
    for i, recording in enumerate(contacts(40)):
        frames = inject(recording, [Fault("short", (7,))], LAYOUT)
        times = np.arange(len(frames))[:, None] / LAYOUT.rate
        header = ",".join(["time_s", *(f"cell{c}" for c in range(12))])
        np.savetxt(
            folder / f"{i:02d}.csv",
            np.hstack([times, frames]),
            "%.4f",
            ",",
            header=header,
            comments="",
        )
    return folder


def test_it_writes_page_badge_json_and_validity(data_set, tmp_path, capsys):
    outputs = {name: tmp_path / name for name in ("a.json", "a.html", "a.svg", "valid.npz")}
    options = ["--out", "--html", "--badge", "--write-valid"]
    paths = [
        str(part)
        for option, path in zip(options, outputs.values(), strict=True)
        for part in (option, path)
    ]
    code = main(["check", str(data_set), "--healthy", "0:20", "--count-from", "1", *paths])
    told = json.loads(outputs["a.json"].read_text())
    assert told["schema"] == "adaptfault.check/1"
    assert told["inspection"]["diagnosis"]["fault_set"] == [7]
    assert code == 1
    text = capsys.readouterr().out
    assert "recordings" in text
    assert "row 1, column 3" not in text
    assert "pad 1, row 2, column 4 (cell7) is short" in text
    assert "pad 1, row 2, column 4 (cell7) is short" in outputs["a.html"].read_text()
    assert "row 1, column 3 (cell7) is short" in outputs["a.json"].read_text()
    assert "11 of 12 cells" in outputs["a.svg"].read_text()
    with np.load(outputs["valid.npz"]) as archive:
        valid = archive["valid"].reshape(40, -1, 12)
    assert not valid[:, :, 7].any()
    assert np.delete(valid, 7, axis=2).all()


@pytest.mark.parametrize("part", ["0:", "a:3", "5", "3:3", "0:99"])
def test_healthy_recordings_that_are_not_there_are_refused(data_set, part, capsys):
    code = main(["check", str(data_set), "--healthy", part])
    message = capsys.readouterr().err
    if part == "0:":  # all of them
        assert code in (0, 1)
    else:
        assert code == 3
        assert f"--healthy {part}: " in message


def test_recordings_that_begin_in_contact_are_named():
    recordings = contacts()
    recordings[3] = recordings[3][25:]
    assert starts(recordings) == (("3",), ())


@pytest.mark.parametrize("sign", [1, -1])
def test_a_tare_in_contact_is_named_whichever_way_readings_go(sign):
    recordings = [0.5 + sign * (recording - 0.1) for recording in contacts()]
    held = recordings[5][25:]
    recordings[5] = held - held[0] + 0.5  # the driver takes the first frame off
    assert starts(recordings) == ((), ("5",))


def test_where_most_recordings_begin_in_contact_none_is_told_as_tared():
    assert starts([recording[25:] for recording in contacts(9)])[1] == ()


def test_healthy_recordings_and_those_without_contact_get_no_remark():
    assert starts(contacts(20)) == ((), ())
    assert starts([np.full((30, 12), 0.1)] * 4) == ((), ())
    assert starts([np.full((30, 12), np.nan)] * 4) == ((), ())


@pytest.mark.parametrize(
    ("times", "jitter", "lost", "falls"),
    [
        (np.arange(100) / 50, 0.0, 0, 0),
        (np.delete(np.arange(100), [7, 40, 41]) / 50, 0.0, 3, 0),
        (np.r_[np.arange(50), np.arange(50)] / 50, 0.0, 0, 1),
    ],
)
def test_the_clock_tells_lost_frames_and_falls(times, jitter, lost, falls):
    elapsed = Elapsed()
    elapsed.add(times)
    clock = elapsed.clock()
    assert clock.jitter == pytest.approx(jitter, abs=1e-9)
    assert (clock.lost, clock.falls) == (lost, falls)


def test_jitter_is_told_as_a_share_of_the_period():
    rng = np.random.default_rng(0)
    elapsed = Elapsed()
    elapsed.add(np.cumsum(rng.normal(1.0, 0.1, 5000)))
    assert elapsed.clock().jitter == pytest.approx(0.1, rel=0.05)


def test_whoever_trains_is_told_everything_in_sentences():
    recordings = contacts(40)
    recordings[2][10:12, 5] = np.nan
    recordings[3] = recordings[3][25:]
    names = tuple(f"grasp {i}" for i in range(40))
    check = DataSetCheck(
        inspect(recordings, SelfDiagnosis(LAYOUT)),
        summarise(recordings, LAYOUT, lengths=[len(one) for one in recordings]),
        Elapsed().clock(),
        2,
        *Begins.of(recordings, LAYOUT).in_contact(names, LAYOUT),
    )
    text = "\n".join(check.remarks)
    assert "2 recordings or files could not be read" in text
    assert "of the readings are missing" in text
    assert "grasp 3 begins in contact" in text
    assert check.severity >= 1
    assert json.loads(json.dumps(check.to_dict(), allow_nan=False))["remarks"] == list(
        check.remarks
    )


@pytest.mark.parametrize("ending", ["npz", "parquet", "zarr", "h5"])
def test_validity_is_written_in_each_format(tmp_path, ending):
    recordings = contacts(3)
    recordings[1][4, 2] = np.nan
    faults = [Fault("open", (0, 5)), Fault("short", (9,), onset=70)]
    path = tmp_path / f"valid.{ending}"
    expected = list(valid_masks(recordings, faults, LAYOUT))
    write_valid(path, iter(expected), ["a", "b", "c"], LAYOUT)
    assert not expected[1][4, 2]
    assert expected[1][9, 9]
    assert not expected[1][10:, 9].any()
    assert not expected[2][:, [0, 5, 9]].any()
    if ending == "npz":
        with np.load(path) as archive:
            got = archive["valid"].reshape(3, 60, 12)
    elif ending == "parquet":
        table = pytest.importorskip("pyarrow.parquet").read_table(path)
        assert table["episode_index"].to_pylist() == [0] * 60 + [1] * 60 + [2] * 60
        column = table["observation.tactile.0.valid"].to_pylist()
        got = np.array(column).reshape(3, 60, 12)
    elif ending == "zarr":
        root = pytest.importorskip("zarr").open_group(path, mode="r")
        assert root["meta/episode_ends"][:].tolist() == [60, 120, 180]
        got = root["data/valid"][:].reshape(3, 60, 12)
    else:
        with pytest.importorskip("h5py").File(path) as file:
            got = np.stack([file[f"episode_{i}/valid"][:].reshape(60, 12) for i in range(3)])
    np.testing.assert_array_equal(got, np.stack(expected))


def test_another_ending_is_refused(tmp_path):
    with pytest.raises(ValueError, match=r"expected a name that ends in \.npz, \.parquet"):
        write_valid(tmp_path / "valid.csv", iter([]), [], LAYOUT)


def test_the_data_set_itself_is_never_changed(data_set, tmp_path):
    before = {path: path.read_bytes() for path in data_set.iterdir()}
    main(["check", str(data_set), "--write-valid", str(tmp_path / "valid.npz")])
    assert {path: path.read_bytes() for path in data_set.iterdir()} == before
    assert len(load(data_set).recordings) == 40


@settings(max_examples=30, deadline=None)
@given(
    sign=st.sampled_from([1, -1]),
    standing=st.lists(st.booleans(), min_size=1, max_size=8),
    rest=st.sampled_from([0.0, 0.5]),
    seed=st.integers(0, 99),
)
def test_a_recording_that_begins_in_contact_was_not_tared(sign, standing, rest, seed):
    """Steps of two feet, some recordings of which begin while both stand."""
    rng = np.random.default_rng(seed)
    frames = np.arange(200)
    recordings = []
    for stands in standing:
        phase = rng.uniform(0, 50)
        steps = [np.maximum(np.sin((frames + phase) / 8 + foot), 0) for foot in (0, np.pi)]
        load = np.repeat(steps, 6, axis=0).T * rng.uniform(0.2, 0.4, 12)
        if stands:
            load[:20] = rng.uniform(0.1, 0.3, 12)
        recordings.append(rest + sign * load)
    assert starts(recordings)[1] == ()


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("n", [1, 2, 4])
def test_recordings_that_begin_at_rest_get_no_remark_whichever_way_readings_go(sign, n):
    idle = np.full((100, 12), 0.1)
    recordings = [0.5 + sign * np.concatenate([idle, one]) for one in contacts(n)]
    assert starts(recordings) == ((), ())


@pytest.mark.parametrize("n", [1, 2, 5])
def test_a_walk_that_begins_while_both_feet_stand_begins_in_contact(n):
    step = np.maximum(np.sin(np.arange(300) / 8)[:, None], 0) * np.repeat([1.0, 0.0], 6)
    walk = step + np.maximum(np.sin(np.arange(300) / 8 + 2.6)[:, None], 0) * np.repeat([0, 1], 6)
    walk[:40] = 0.4
    assert starts([walk] * n) == (tuple(f"{i}" for i in range(n)), ())
