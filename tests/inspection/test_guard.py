"""A training script is stopped, or warned, where touch readings are not fit for it."""

from types import SimpleNamespace

import numpy as np
import pytest

import adaptfault as af
from adaptfault.data.recordings import Recordings, save_npz
from diagnostics import Fault, SensorLayout, inject, line_fault

LAYOUT = SensorLayout(1, 3, 4, full_scale=1.0, unit="V", rate=50.0)


def recordings(*faults: Fault, n: int = 16) -> Recordings:
    rng = np.random.default_rng(0)
    course = np.maximum(np.sin(np.linspace(-0.5, np.pi + 0.5, 60)), 0)[:, None]
    frames = [
        0.1 + course * rng.uniform(0.2, 0.8, 12) + rng.normal(0, 0.002, (60, 12)) for _ in range(n)
    ]
    return Recordings(tuple(inject(one, faults, LAYOUT) for one in frames), LAYOUT)


DEAD = Fault("short", (7,))
ROW = line_fault(LAYOUT, LAYOUT.lines[0], "open")


def test_a_healthy_set_passes_with_what_was_not_checked():
    found = af.guard(recordings())
    assert (found.severity, found.codes) == (0, ())
    assert any("gain" in one.what for one in found.unchecked)
    compared = af.guard(recordings(), reference=recordings())
    assert not any("gain" in one.what for one in compared.unchecked)


def test_a_broken_row_stops_and_a_dead_cell_warns():
    with pytest.raises(af.GuardError, match=r"error TOUCH-101 .* is open") as stopped:
        af.guard(recordings(ROW), reference=recordings())
    assert stopped.value.findings.severity == 2
    with pytest.warns(UserWarning, match=r"warning TOUCH-102 .* is short"):
        found = af.guard(recordings(DEAD), reference=recordings())
    assert found[0].fault is not None
    assert found[0].fault.cells == (7,)


@pytest.mark.parametrize("on", ["warning", "notice", "TOUCH-102", "short", "never,TOUCH-10"])
def test_what_stops_is_chosen(on):
    with pytest.raises(af.GuardError, match="not fit for training"):
        af.guard(recordings(DEAD), reference=recordings(), on=on)


def test_a_set_that_tests_nothing_stops_in_any_case():
    idle = Recordings(tuple(np.full((60, 12), 0.1) for _ in range(4)), LAYOUT)
    with pytest.raises(af.GuardError, match="TOUCH-190"):
        af.guard(idle, on="never")


def test_paths_and_data_sets_with_a_folder_are_read(tmp_path):
    save_npz(tmp_path / "set.npz", recordings(DEAD))
    for given in (tmp_path, [tmp_path / "set.npz"], SimpleNamespace(root=tmp_path)):
        with pytest.warns(UserWarning, match="TOUCH-102"):
            assert af.guard(given).codes == ("TOUCH-102",)
    (tmp_path / "broken.npz").write_bytes(b"PK")
    with pytest.raises(af.GuardError, match="TOUCH-191"):
        af.guard(tmp_path, on="never")


def test_what_cannot_be_meant_is_refused(tmp_path):
    with pytest.raises(ValueError, match="fatal"):
        af.guard(recordings(), on="fatal")
    with pytest.raises(ValueError, match="shape: of recordings in memory nothing is read"):
        af.guard(recordings(), shape="3x4")
    with pytest.raises(ValueError, match="not there"):
        af.guard(tmp_path / "nothing")
