"""Recall of each class, and which classes a program may rely on."""

import json

import numpy as np
import pytest

from adaptfault.bundle.bundle import Bundle
from adaptfault.bundle.journal import Entry
from adaptfault.bundle.known_faults import KnownFaults
from adaptfault.cli import main
from adaptfault.evaluation.class_recall import ClassRecall, class_recalls
from adaptfault.evaluation.scores import prediction_interval
from adaptfault.robot.technician_report import write_report
from diagnostics import Fault


def test_each_class_has_its_recall_and_the_class_it_is_taken_for():
    y = np.array([0, 0, 0, 0, 1, 1, 2, 2, -1])
    predicted = np.array([0, 2, 2, 1, 1, 1, 0, 0, 0])
    recording = np.array([0, 0, 1, 1, 2, 3, 4, 5, 6])
    zero, one, two = class_recalls(y, predicted, recording)
    assert (zero.recall, zero.confused_with, zero.confused) == (0.25, 2, 0.5)
    assert (one.recall, one.confused_with, one.confused) == (1.0, None, 0.0)
    assert (two.recall, two.confused_with, two.n_recordings) == (0.0, 0, 2)
    assert zero.named(("a", "b", "c")).endswith("taken for c in 50.0%")
    assert ClassRecall.from_dict(json.loads(json.dumps(zero.to_dict()))) == zero


def test_the_interval_is_by_recording_and_for_a_share_of_the_new_ones():
    rng = np.random.default_rng(0)
    y = np.repeat([0, 1], 60)
    recording = np.repeat(np.arange(30), 4)
    predicted = np.where(rng.random(120) < 0.8, y, 1 - y)
    for new in (None, 10, np.inf):
        found = class_recalls(y, predicted, recording, new=new)[1]
        own = slice(60, None)
        half = 15 if new is None else new / 2
        wanted = prediction_interval(predicted[own] == 1, recording[own], new=half)
        assert (found.low, found.high) == wanted
    # a recording of which each window is twice there tells no more
    doubled = class_recalls(np.tile(y, 2), np.tile(predicted, 2), np.tile(recording, 2), new=np.inf)
    assert doubled[1].low == pytest.approx(found.low)


def test_one_recording_of_a_class_tells_nothing_of_it():
    (only,) = class_recalls(np.zeros(9, int), np.zeros(9, int), np.zeros(9, int))
    assert (only.low, only.high) == (0.0, 1.0)


def test_a_bundle_allows_a_class_by_the_lower_limit_of_its_recall(bundle):
    recalls = bundle.class_recalls()
    assert [one.label for one in recalls] == [0, 1, 2]
    for one in recalls:
        name = bundle.class_names[one.label]
        assert bundle.allows(name, min_recall=one.low)
        assert not bundle.allows(one.label, min_recall=one.low + 1e-9)
    assert not bundle.allows(7, min_recall=0.1)
    with pytest.raises(ValueError, match="no class 'cheese': nothing, softer, harder"):
        bundle.allows("cheese", min_recall=0.5)
    with pytest.raises(ValueError, match=r"above 0 to 1; got 1\.5"):
        bundle.allows(0, min_recall=1.5)


def test_a_repaired_version_has_the_recalls_of_its_own_validation(bundle):
    adapted = bundle.parts.adapter().adapt([3, 17], method="fill", progress=False)
    bundle.deploy(bundle.write_version(adapted, {"reason": "test"}).number)
    assert bundle.class_recalls() == adapted.recalls
    assert [one.recall for one in adapted.recalls] == pytest.approx(adapted.by_class.tolist())


def test_no_class_is_allowed_while_a_faulty_cell_is_used_unless_that_was_compared(bundle):
    known = KnownFaults(60, (Fault("open", (3,)),)).to_dict()
    easy = ClassRecall(1, 0.9, 0.8, 0.95, None, 0.0, 20)
    bundle.journal.add(Entry("2026-01-01T00:00:00+00:00", "kept", {"knowledge": known}))
    assert bundle.known_faults().fault_set.cells == (3,)
    assert not any(bundle.allows(label, min_recall=0.01) for label in range(3))
    judged = {"version": 1, "exit_code": 1, "reason": "", "fault_set": [3]}
    compared = {"knowledge": known, "judged": {**judged, "classes": [easy.to_dict()]}}
    bundle.journal.add(Entry("2026-01-02T00:00:00+00:00", "kept", compared))
    assert Bundle.open(bundle.path).allows("softer", min_recall=0.8)
    assert not bundle.allows("harder", min_recall=0.01)


def test_the_page_lists_the_classes_the_least_certain_first(bundle, tmp_path):
    text = write_report(tmp_path / "page.html", bundle).read_text()
    table = text[text.index("Which classes to rely on") :]
    ordered = sorted(bundle.class_recalls(), key=lambda one: one.low)
    places = [table.index(f"<td>{bundle.class_names[one.label]}</td>") for one in ordered]
    assert places == sorted(places)


def test_the_command_forecasts_each_class_by_name(bundle, capsys):
    command = ["forecast", str(bundle.path), "--faults", "3,17", "--quiet"]
    assert main([*command, "--classes"]) == 0
    text = capsys.readouterr().out
    assert all(f"  {name}: recall" in text for name in bundle.class_names)
