"""Malformed documents, frames and folders end in one line of error, never in a traceback of another
kind."""

import copy
import json
import os
from pathlib import Path

import numpy as np
import pytest

from adaptfault.bundle.bundle import Bundle
from adaptfault.bundle.checksummed_json import (
    Damaged,
    hash_file,
    write_checksummed,
    write_with_copy,
)
from adaptfault.prediction.predictor import Predictor
from diagnostics import Diagnosis, Fault, FaultSet, Line, SensorLayout

JUNK = [
    None,
    True,
    -1,
    0,
    10**30,
    1.5,
    "",
    "x",
    [],
    [None],
    ["x"],
    [[]],
    [-1],
    [10**9],
    {},
    {"x": 1},
    {1: 2, "y": 3},
]
LAYOUT = SensorLayout(1, 2, 3, present=np.arange(6) != 4)
DIAGNOSIS = Diagnosis(
    LAYOUT,
    (
        Fault("open", (0, 1, 2), line=Line(0, "row", 0), probability=0.9, evidence=3),
        Fault("stuck", (5,), value=2.5),
    ),
    np.full(6, 0.25),
    np.ones(6, bool),
    n_frames=7,
    n_recordings=2,
    evidence={"spatial": np.zeros(6)},
)


def places(document, at=()):
    """Yield the path of every value in a document."""
    yield at
    items = (
        document.items()
        if isinstance(document, dict)
        else enumerate(document)
        if isinstance(document, list)
        else ()
    )
    for key, value in items:
        yield from places(value, (*at, key))


def replaced(document, at, value):
    if not at:
        return value
    changed = copy.deepcopy(document)
    inner = changed
    for key in at[:-1]:
        inner = inner[key]
    inner[at[-1]] = value
    return changed


def without(document, at):
    changed = copy.deepcopy(document)
    inner = changed
    for key in at[:-1]:
        inner = inner[key]
    del inner[at[-1]]
    return changed


@pytest.mark.parametrize(
    ("read", "document"),
    [(SensorLayout.from_dict, LAYOUT.to_dict()), (Diagnosis.from_dict, DIAGNOSIS.to_dict())],
)
def test_a_malformed_document_is_a_value_error(read, document):
    read(document)
    refused = 0
    for at in places(document):
        variants = [replaced(document, at, junk) for junk in JUNK] + (
            [without(document, at)] if at else []
        )
        for variant in variants:
            try:
                result = read(variant)
            except ValueError:
                refused += 1
            else:
                json.dumps(result.to_dict(), allow_nan=False)
                str(result)
    assert refused > 200


@pytest.mark.parametrize("n_cells", [-3, 2.5, True, None, "4"])
def test_a_fault_set_needs_a_number_of_cells(n_cells):
    with pytest.raises(ValueError, match="number of cells"):
        FaultSet((), n_cells)


def test_transposed_frames_and_times_that_are_no_numbers_are_refused(bundle):
    predictor = Predictor.load(bundle.path)
    with pytest.raises(
        ValueError, match=r"expected a frame \[60\] or \[2, 6, 5\], got \[5, 6, 2\]"
    ):
        predictor.stream(np.zeros((5, 6, 2)))
    for time in (np.nan, np.inf):
        with pytest.raises(ValueError, match="expected seconds"):
            predictor.stream(np.zeros(60), time)
    assert predictor.stream(np.zeros((2, 6, 5)), 1.0).label is None


def problems(path: Path) -> list[str]:
    try:
        return Bundle.open(path).problems(repair=False)
    except Damaged as error:
        return [str(error)]


@pytest.mark.parametrize("key", ["layout", "class_names", "parts"])
def test_a_malformed_bundle_document_with_a_right_checksum_is_damaged(bundle, key):
    assert problems(bundle.path) == []
    # any list may hold names
    for junk in (None, 3, [3], {"x": 3})[: 2 if key == "class_names" else 4]:
        write_with_copy(bundle.path / "bundle.json", {**bundle.about, key: junk})
        assert problems(bundle.path), junk


def test_a_malformed_version_gives_way_to_the_one_before(bundle):
    adaptation = bundle.parts.adapter().adapt(FaultSet((3,), 60), method="fill")
    version = bundle.write_version(adaptation, {})
    bundle.deploy(version.number)
    weights = next(version.folder.glob("*.safetensors"))
    weights.write_bytes(b"\xff" * 200)
    about = json.loads((version.folder / "version.json").read_text())
    del about["sha256"]
    files = {
        path.name: hash_file(path)
        for path in version.folder.iterdir()
        if path.name != "version.json"
    }
    write_checksummed(version.folder / "version.json", {**about, "files": files})
    assert Predictor.load(bundle.path).version == 1
    write_checksummed(version.folder / "version.json", {**about, "files": files, "fault_set": "x"})
    assert bundle.active().number == 1


@pytest.mark.parametrize("name", ["bundle.json", "current.json"])
def test_a_document_that_is_a_pipe_or_nests_too_deep_gives_way_to_its_copy(bundle, name):
    path = bundle.path / name
    path.write_text("[" * 100_000)
    assert bundle.active().number == Bundle.open(bundle.path).active().number == 1
    path.unlink()
    assert bundle.active().number == Bundle.open(bundle.path).active().number == 1
    os.mkfifo(path)
    assert bundle.active().number == Bundle.open(bundle.path).active().number == 1


def test_stray_files_where_folders_are_expected_are_passed_over(bundle, later_grasps):
    versions = bundle.path / "versions"
    (versions / "0007").write_text("stray")
    (versions / ".unfinished-0009").write_text("stray")
    assert bundle.versions.numbers == [1]
    adaptation = bundle.parts.adapter().adapt(FaultSet((3,), 60), method="fill")
    assert bundle.write_version(adaptation, {}).number == 8
    (bundle.path / "current.json").unlink()
    (bundle.path / "current.json").mkdir()
    assert bundle.active().number == 1


def test_temporary_files_of_crashes_are_swept_once_they_are_old(bundle):
    litter = bundle.path / ".current.json.abcd1234"
    for path in (litter, bundle.path / ".current.json.fresh123", bundle.path / ".keep"):
        path.write_text("")
        os.utime(path, (0, 0))
    os.utime(bundle.path / ".current.json.fresh123")
    bundle.sweep()
    assert sorted(p.name for p in bundle.path.glob(".*")) == [".current.json.fresh123", ".keep"]


def test_damage_of_a_part_that_prediction_does_not_need_does_not_stop_it(bundle):
    for name in ("adapter", "check", "reference"):
        part = next((bundle.path / "parts" / name).glob("*.safetensors"))
        data = bytearray(part.read_bytes())
        data[-1] ^= 1
        part.write_bytes(bytes(data))
    assert Predictor.load(bundle.path).version == 1
    assert Bundle.open(bundle.path).diagnoser().reference_ is not None  # from the copy
    assert len(Bundle.open(bundle.path).problems(repair=True)) == 1
    problems = Bundle.open(bundle.path).problems(repair=False)
    assert "reference" not in problems[0]
