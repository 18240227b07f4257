"""What is told of a data set uses its own names: features, episodes, frames within them."""

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from adaptfault.data.recordings import open_recordings
from adaptfault.inspection.changed_readings import ChangedReadings
from adaptfault.inspection.leave_out import LeaveOut
from adaptfault.inspection.naming import Naming
from adaptfault.inspection.result import Finding, Inspection
from diagnostics import Diagnosis, Fault, Line, SensorLayout, Verdict

LAYOUT = SensorLayout(2, 3, 4, full_scale=1.0, unit="V", rate=50.0)
EPISODES = ("episode 3", "episode 4", "episode 7")

lengths = st.lists(st.integers(1, 50), min_size=1, max_size=6)


def diagnosis(*faults: Fault, n: int = 3, states: np.ndarray | None = None) -> Diagnosis:
    nothing = np.zeros(24)
    return Diagnosis(LAYOUT, faults, nothing, nothing > 0, 60, n, states=states)


@given(lengths, st.data())
def test_a_frame_of_all_is_a_frame_of_its_recording(each, data):
    naming = Naming((), tuple(map(str, range(len(each)))), tuple(each))
    which = data.draw(st.integers(0, len(each) - 1))
    frame = data.draw(st.integers(0, each[which] - 1))
    assert naming.place(sum(each[:which]) + frame) == (str(which), frame)
    assert naming.place(sum(each)) is None


@pytest.mark.parametrize(
    ("sentence", "told"),
    [
        ("pad 1, row 2 is open", "right, row 2 is open"),
        ("press pad 0, rows 0-1", "press left, rows 0-1"),
        ("(in recordings 0 to 1, 2)", "(in episodes 3 to 4, 7)"),
        ("frame 12 of recording 2 of pad 1", "frame 12 of episode 7 of right"),
        ("it shows in recording 1", "it shows in episode 4"),
        ("fewer than 3 recordings", "fewer than 3 recordings"),
        ("recordings 1 to 9", "recordings 1 to 9"),
        ("pad 7", "pad 7"),
    ],
)
def test_pads_and_recordings_of_a_sentence_are_called_by_their_names(sentence, told):
    assert Naming(("left", "right"), EPISODES, (20, 20, 20)).text(sentence) == told


@pytest.mark.parametrize("name", ["log.npz, recording {}", "episode {}", "{}.csv"])
@given(st.sets(st.integers(0, 8), min_size=1).map(sorted))
def test_a_sentence_that_has_the_names_stays_as_it_is(name: str, numbers):
    naming = Naming((), tuple(name.format(i) for i in range(9)), (20,) * 9)
    named = naming.text(f"is open (in recordings {', '.join(map(str, numbers))})")
    assert naming.text(named) == named
    assert all(name.format(number).split()[-1] in named for number in numbers)


def test_recordings_that_are_files_are_called_so():
    naming = Naming((), ("a.csv", "b 2.csv", "c.csv"), (20, 20, 20))
    assert naming.text("in recordings 0 to 1, 2") == "in recordings a.csv to b 2.csv, c.csv"
    assert naming.told("stuck from frame 25 on (0.5 s)", 25) == "stuck from frame 5 of b 2.csv on"
    assert naming.told("frame 25, in which", 25) == "frame 5 of b 2.csv, in which"


def test_of_one_recording_frames_keep_their_numbers():
    assert Naming((), ("a",), (60,)).told("from frame 25 on (0.5 s)", 25) == (
        "from frame 25 on (0.5 s)"
    )


def test_an_inspection_and_its_diagnosis_tell_the_same():
    stuck = Fault("stuck", (13,), onset=25, reason="pad 1, row 0 is stuck from frame 25 on (1.2 s)")
    found = diagnosis(stuck)
    finding = Finding("fault", 1, stuck.reason, stuck)
    class_ = Finding("coincides", 1, "pad 1, row 0 coincides with class a")
    inspection = Inspection(ChangedReadings(None, None, [], found), (finding, class_))
    naming = Naming(("left", "right"), EPISODES, (20, 20, 20))
    named = naming.of_inspection(inspection)
    told = "right, row 0 is stuck from frame 5 of episode 4 on"
    assert [one.reason for one in named.diagnosis.faults] == [told]
    assert [one.reason for one in named.findings] == [told, "right, row 0 coincides with class a"]
    assert named.findings[0].fault == named.diagnosis.faults[0]
    assert named.diagnosis.by_recording.names == EPISODES
    assert Naming(("left", "right"), EPISODES[:2], (20, 20)).of_inspection(inspection) is inspection
    assert naming.pads_of((13,), LAYOUT) == ["right"]
    assert Naming().pads_of((13, 2), LAYOUT) == ["0", "1"]


@pytest.mark.parametrize(
    ("features", "pads"),
    [
        (["observation.tactile.left", "observation.tactile.right"], ("left", "right")),
        (["tactile.left.raw", "tactile.right.raw"], ("left", "right")),
        (["tactile.left.a.raw", "tactile.right.b.raw"], ("left.a", "right.b")),
        (["tactile.0", "tactile.1"], ("tactile.0", "tactile.1")),
        (["observation.tactile.left"], ("left",)),
        (["observation.tactile.0"], ("observation.tactile.0",)),
    ],
)
def test_pads_are_called_after_what_tells_their_features_apart(features, pads, tmp_path):
    pa = pytest.importorskip("pyarrow")
    pq = pytest.importorskip("pyarrow.parquet")
    rng = np.random.default_rng(0)
    (tmp_path / "meta").mkdir()
    (tmp_path / "data").mkdir()
    about = {name: {"dtype": "float32", "shape": [2, 3]} for name in features}
    (tmp_path / "meta/info.json").write_text(json.dumps({"fps": 30, "features": about}))
    columns = {name: rng.random((8, 2, 3)).tolist() for name in features}
    columns |= {"episode_index": np.repeat([3, 4], 4)}
    pq.write_table(pa.table(columns), tmp_path / "data/file-001.parquet")
    naming = Naming.of(open_recordings(tmp_path))
    assert naming.pads == pads
    assert naming.recordings == ("episode 3", "episode 4")


shown = st.integers(1, 6).flatmap(
    lambda n: st.lists(
        st.lists(st.sampled_from([0, 1, 2]), min_size=24, max_size=24), min_size=n, max_size=n
    )
)


@given(shown)
def test_without_what_is_left_out_no_fault_is_left_and_nothing_more_is_left_out(states):
    code = np.array(states, dtype=np.uint8)
    left = LeaveOut.of(diagnosis(n=len(code), states=code))
    faulty = code == int(Verdict.FAULTY)
    assert set(left.cells) == set(np.flatnonzero(faulty.all(axis=0)))
    kept = np.delete(np.arange(len(code)), left.recordings)
    others = np.delete(np.arange(24), left.cells)
    assert not faulty[np.ix_(kept, others)].any()
    for number in left.recordings:
        assert faulty[number, others].any()
    assert set(left.partly) == set(others[faulty[:, others].any(axis=0)])
    assert bool(left.sentences) == faulty.any()


def test_what_to_leave_out_is_told_in_sentences():
    code = np.zeros((4, 24), np.uint8)
    code[:, 5] = int(Verdict.FAULTY)
    code[2:, [7, 8]] = int(Verdict.FAULTY)
    assert LeaveOut.of(diagnosis(n=4, states=code)).sentences == [
        "1 cell is faulty in every recording: train without its readings",
        "without recordings 2 to 3 (2 of 4) no other fault that was found is left; or leave out"
        " the readings of 2 cells there, which --write-valid marks",
    ]
    row = Fault("open", tuple(range(4)), line=Line(0, "row", 0), reason="")
    assert LeaveOut.of(diagnosis(row)).to_dict(EPISODES) == {
        "cells": [0, 1, 2, 3],
        "recordings": [],
        "partly": [],
    }
