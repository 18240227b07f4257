"""A cell that reads little of what the cells on both sides of it read is told, whoever is asked."""

import json
import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import adaptfault as af
from adaptfault.cli import main
from adaptfault.data.recordings import Recordings, save_npz
from diagnostics import FaultKind, SelfDiagnosis, SensorLayout
from diagnostics.when import Spans
from diagnostics.when.weak import shares_of_load

LAYOUT = SensorLayout(1, 4, 5, full_scale=1.0, unit="V", rate=50.0)
INNER = [6, 7, 8, 11, 12, 13]
WORN = 7


def contacts(seed: int, n: int = 24, layout: SensorLayout = LAYOUT) -> list[np.ndarray]:
    """Recordings of broad contacts that come and go anywhere."""
    rng = np.random.default_rng(seed)
    places = np.argwhere(np.ones((layout.rows, layout.cols)))
    edge = (layout.rows - 1, layout.cols - 1)
    found = []
    for _ in range(n):
        distance = ((places - rng.uniform((0, 0), edge)) ** 2).sum(axis=1)
        course = np.clip(np.sin(np.linspace(-1, 3 * np.pi, 50)), 0, None)[:, None]
        load = 0.8 * rng.uniform(0.5, 1) * course * np.exp(-distance / 8)
        found.append(0.1 + load + rng.normal(0, 0.002, load.shape))
    return found


def with_gain(recordings: list[np.ndarray], cells: list[int], gain: float) -> list[np.ndarray]:
    """Return the recordings in which cells read a share of their load."""
    worn = []
    for frames in recordings:
        changed = frames.copy()
        changed[:, cells] = 0.1 + gain * (changed[:, cells] - 0.1)
        worn.append(changed)
    return worn


def shares(recordings: list[np.ndarray]) -> np.ndarray:
    low = np.stack([frames.min(axis=0) for frames in recordings])
    high = np.stack([frames.max(axis=0) for frames in recordings])
    return shares_of_load(Spans(low, high), LAYOUT)


@settings(max_examples=30, deadline=None)
@given(
    seed=st.integers(0, 10_000),
    cells=st.lists(st.sampled_from(INNER), min_size=1, max_size=2, unique=True),
    gain=st.floats(0.0, 0.15),
)
def test_the_share_of_worn_cells_is_told_and_of_no_other(seed, cells, gain):
    recordings = contacts(seed)
    assert np.isnan(shares(recordings)).all()
    told = shares(with_gain(recordings, cells, gain))
    assert np.flatnonzero(np.isfinite(told)).tolist() == sorted(cells)
    assert np.abs(told[cells] - gain).max() < 0.2


def test_few_contacts_and_cells_at_the_corners_prove_nothing():
    recordings = contacts(0)
    assert np.isnan(shares(with_gain(recordings, [0, 4, 15, 19], 0.1))).all()
    assert np.isnan(shares(with_gain(recordings[:7], [WORN], 0.1))).all()


def test_readings_that_never_change_say_nothing():
    assert np.isnan(shares([np.full((5, 20), 0.3)] * 12)).all()


@pytest.mark.parametrize("n", [24, 40])
def test_a_worn_cell_is_perhaps_weak_in_a_cold_start_and_a_person_is_told(n):
    """With 40 recordings the log is its own reference, in which the cell reads as little."""
    found = af.inspect(with_gain(contacts(1, n), [WORN], 0.1), SelfDiagnosis(LAYOUT))
    diagnosis = found.diagnosis
    assert not diagnosis.tested[WORN]
    assert not diagnosis.faults
    weak = [fault for fault in diagnosis.possible if fault.kind is FaultKind.WEAK]
    assert [fault.cells for fault in weak] == [(WORN,)]
    assert weak[0].value == pytest.approx(0.1, abs=0.05)
    assert found.severity == 1
    assert "perhaps worn" in str(diagnosis)
    healthy = af.inspect(contacts(1, n), SelfDiagnosis(LAYOUT))
    assert not healthy.diagnosis.possible
    assert healthy.severity == 0


def test_cells_of_a_pad_are_told_in_one_sentence_each_with_its_share():
    recordings = with_gain(with_gain(contacts(1), [WORN], 0.1), [11], 0.2)
    (weak,) = SelfDiagnosis(LAYOUT).diagnose(recordings).possible
    assert weak.cells == (WORN, 11)
    shares = [float(number) for number in re.findall(r"column \d \(([0-9.]+)\)", weak.reason)]
    assert shares == pytest.approx([0.1, 0.2], abs=0.05)


def test_diagnose_says_once_what_may_be_faulty_all_through_the_log(tmp_path, capsys):
    path = tmp_path / "worn.npz"
    recordings = with_gain(with_gain(contacts(1), [WORN], 0.1), [11], 0.2)
    save_npz(path, Recordings(tuple(recordings), LAYOUT, np.zeros(len(recordings), np.int64)))
    assert main(["diagnose", str(path), "--quiet"]) == 1
    told = capsys.readouterr().out
    assert told.count("perhaps worn") == 1
    assert "2 cells may be faulty all through the log, which alone cannot tell" in told


def test_what_a_reference_shows_as_usual_is_not_told():
    recordings = with_gain(contacts(2, 48), [WORN], 0.3)
    found = SelfDiagnosis(LAYOUT).fit(recordings[::2]).diagnose(recordings[1::2])
    assert WORN not in found.fault_set
    assert not found.possible


def test_a_check_tells_why_a_cell_that_moves_little_was_not_tested(tmp_path):
    path = tmp_path / "worn.npz"
    recordings = with_gain(contacts(3), [0], 0.2)
    labels = np.zeros(len(recordings), np.int64)
    save_npz(path, Recordings(tuple(recordings), LAYOUT, labels))
    main(["check", str(path), "--out", str(tmp_path / "check.json"), "--quiet"])
    told = json.loads((tmp_path / "check.json").read_text())["not_checked"]
    assert any(
        "worn or hardly touched" in one["what"] and "column 0" in one["what"] for one in told
    )
