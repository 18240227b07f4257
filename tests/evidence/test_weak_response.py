"""Cells that hardly react, and cells that rest above 0 with noise, are not taken for broken ones in
a cold start."""

import numpy as np
import pytest
from contact_recordings import CELLS, LAYOUT, events

from diagnostics import Fault, FaultKind, SelfDiagnosis, Verdict, inject
from diagnostics.evidence.weak_response import WeakResponse

STEP = 1 / 1023
NEAR = 0.02
NOISE = 0.002
DULL = [LAYOUT.cell(0, r, c) for r, c in ((1, 2), (2, 5), (3, 3))]


def recordings(seed: int, rest: float = 0.0, dull: float = 1.0, count: int = 6) -> list[np.ndarray]:
    """Presses on an array with noise, whose cells rest at 0 to ``rest``; ``dull`` is the gain of
    some of them."""
    rng = np.random.default_rng(seed)
    gain = np.ones(CELLS)
    gain[DULL] = dull
    rests = rest * np.random.default_rng(99).uniform(0, 1, CELLS)
    read = [
        r * gain + rests + NOISE * rng.standard_normal(r.shape) for r in events(seed, count, 160)
    ]
    return [np.clip(np.round(r / STEP), 0, 1023) * STEP for r in read]


def test_of_cells_that_follow_their_neighbours_those_with_a_weak_response_are_untestable():
    frames = np.concatenate(recordings(0, dull=0.01))
    broken = LAYOUT.cell(0, 2, 2), LAYOUT.cell(0, 3, 5)
    frames[:, broken[0]] = 0.3
    frames[:, broken[1]] = 0.3 + NOISE * np.random.default_rng(3).standard_normal(len(frames))
    response = WeakResponse.begin(CELLS)
    for first in range(0, len(frames), 32):
        part = frames[first : first + 32]
        loads = np.where(part > NEAR, part, 0.0)
        loads[:, broken] = 0.0
        response = response.extend(part, loads, LAYOUT)
    untestable = response.untestable(NEAR)
    assert untestable[DULL].all()
    assert not untestable[list(broken)].any()
    pressed = frames.max(axis=0) > 0.3
    assert not untestable[pressed].any()


def test_without_any_reading_or_load_no_cell_is_untestable():
    nothing = np.full((32, CELLS), np.nan)
    response = WeakResponse.begin(CELLS).extend(nothing, np.zeros((32, CELLS)), LAYOUT)
    assert not WeakResponse.begin(CELLS).untestable(NEAR).any()
    assert not response.untestable(NEAR).any()


@pytest.mark.parametrize(("rest", "dull"), [(0.035, 1.0), (0.0, 0.01)])
def test_without_a_reference_no_cell_is_blamed_that_rests_high_or_hardly_reacts(
    rest: float, dull: float
):
    for seed in range(4):
        assert not SelfDiagnosis(LAYOUT).diagnose(recordings(seed, rest, dull)).faults


@pytest.mark.parametrize(("rest", "dull"), [(0.035, 1.0), (0.0, 0.01)])
def test_without_a_reference_broken_cells_are_found_among_them(rest: float, dull: float):
    dead = [LAYOUT.cell(0, 1, 4), LAYOUT.cell(0, 2, 3)]
    faults = [Fault(FaultKind.OPEN, (cell,)) for cell in dead]
    log = [inject(frames, faults, LAYOUT) for frames in recordings(1, rest, dull, count=24)]
    assert set(SelfDiagnosis(LAYOUT).diagnose(log).fault_set) == set(dead)


@pytest.mark.parametrize("moves", ["by itself", "late"])
def test_without_a_reference_what_moves_without_the_cells_around_is_not_alive(moves: str):
    cell = LAYOUT.cell(0, 2, 3)
    for seed in range(3):
        log = recordings(seed)
        assert SelfDiagnosis(LAYOUT).diagnose(log).verdicts[cell] == Verdict.ALIVE
        for frames in log:
            if moves == "late":
                frames[:, cell] = np.roll(frames[:, cell], 40)
            else:
                frames[:, cell] = 0.3 + 0.2 * np.sin(0.7 * np.arange(len(frames)))
        assert SelfDiagnosis(LAYOUT).diagnose(log).verdicts[cell] != Verdict.ALIVE
