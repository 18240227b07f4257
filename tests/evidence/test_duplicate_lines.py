"""Duplicate lines and address aliasing."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from diagnostics import Fault, FaultKind, Line, SensorLayout, bridge, inject, line_fault
from diagnostics.decision.address_aliasing import find_aliasing
from diagnostics.evidence.cold_start import ColdStream
from diagnostics.evidence.duplicate_lines import DuplicateLines, DuplicatePair, informative, pairs
from diagnostics.evidence.reference import Reference
from diagnostics.evidence.usual_duplicates import UsualDuplicates

LAYOUT = SensorLayout(2, 6, 5)
ROW, COLUMN = np.divmod(np.arange(30), 5)


def pressed(seed: int, presses: int = 25) -> np.ndarray:
    """Round presses here and there on both pads, 20 frames each; nothing in between."""
    rng = np.random.default_rng(seed)
    log = []
    force = np.sin(np.linspace(0, np.pi, 20))[:, None]
    for _ in range(presses):
        load = []
        for _ in range(2):
            r = rng.uniform(0, 5)
            c = rng.uniform(0, 4)
            load.append(np.maximum(0, 3 - ((ROW - r) ** 2 + (COLUMN - c) ** 2) / 1.5))
        noise = 1 + rng.normal(0, 0.02, (20, 60))
        log.append(force * np.concatenate(load) * noise)
    return np.concatenate([part for press in log for part in (press, np.zeros((4, 60)))])


def state_after(log: np.ndarray) -> ColdStream:
    stream = ColdStream(LAYOUT, Reference.unknown(LAYOUT))
    stream.extend(log)
    return stream.complete()


def caused(log: np.ndarray) -> list[Fault]:
    stream = state_after(log)
    return find_aliasing(stream, partial(stream.cold.log_likelihood, stream))[0]


def duplicate_pairs(log: np.ndarray) -> list[DuplicatePair]:
    return state_after(log).duplicates.duplicate_pairs(usual=2)


def duplicate_rows(
    first: np.ndarray, second: np.ndarray, noise: np.ndarray
) -> list[tuple[int, int]]:
    """Return the duplicate rows where two rows of pad 0 read ``[t, 5]`` each, and the others are
    unloaded."""
    log = np.zeros((len(first), 2, 6, 5))
    log[:, 0, 2], log[:, 0, 3] = np.stack([first, second]) + noise
    return [
        (j.first, j.second) for j in duplicate_pairs(log.reshape(len(log), 60)) if j.kind == "row"
    ]


# Pairs of lines


def test_all_pairs_that_a_bit_or_a_bridge_can_join_are_watched_each_once():
    assert list(pairs(4)) == [(0, 1), (0, 2), (1, 2), (1, 3), (2, 3)]
    assert len(pairs(1)) == 0
    for count in (2, 5, 11, 16):
        by_bit = {
            tuple(sorted((i, i ^ 1 << b)))
            for i in range(count)
            for b in range(4)
            if i ^ 1 << b < count
        }
        assert set(pairs(count)) == by_bit | {(i, i + 1) for i in range(count - 1)}
        assert len(set(pairs(count))) == len(pairs(count))


@pytest.mark.parametrize("seed", range(4))
def test_healthy_lines_are_no_duplicates(seed: int):
    assert duplicate_pairs(pressed(seed)) == []


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("step", [0.0, 0.005])
def test_what_moves_all_cells_alike_joins_no_lines(seed: int, step: float):
    rng = np.random.default_rng(seed)
    level = 1.2 + np.cumsum(rng.normal(0, 0.002, (2000, 1)), axis=0)
    log = level + rng.normal(0, 0.0015, (2000, 60))
    assert duplicate_pairs(np.round(log / step) * step if step else log) == []


def test_a_bridge_is_found_beside_a_common_drift():
    drift = np.cumsum(np.random.default_rng(0).normal(0, 0.002, (600, 1)), axis=0)
    log = inject(pressed(1)[:600] + 0.5 + drift, [bridge(LAYOUT, Line(1, "row", 2))], LAYOUT)
    assert [(pair.pad, pair.kind, pair.first, pair.second) for pair in duplicate_pairs(log)] == [
        (1, "row", 2, 3)
    ]


def test_unloaded_lines_are_no_duplicates():
    assert duplicate_pairs(np.zeros((300, 60))) == []


def test_lines_stuck_at_the_same_value_are_not_joined():
    log = inject(
        pressed(0), [line_fault(LAYOUT, Line(0, "row", r), FaultKind.SHORT) for r in (2, 3)], LAYOUT
    )
    assert duplicate_pairs(log) == []


def test_lines_that_have_read_alike_since_some_frame_are_dated():
    log = inject(pressed(1), [bridge(LAYOUT, Line(1, "row", 2), onset=200)], LAYOUT)
    (pair,) = duplicate_pairs(log)
    assert (pair.pad, pair.kind, pair.first, pair.second) == (1, "row", 2, 3)
    assert 190 <= pair.since <= 230
    assert pair.since <= pair.seen_by
    assert pair.coincidences > 5


@pytest.mark.parametrize("seed", range(4))
def test_lines_under_equal_loads_are_distinguished_from_one_line_read_twice(seed: int):
    rng = np.random.default_rng(seed)
    force = 1 + 0.2 * np.sin(np.arange(400) / 9)[:, None]
    bar = rng.uniform(0.5, 0.8, 5)  # it lies evenly across two rows
    other = force * (bar + rng.uniform(-0.02, 0.02, 5))
    noise = rng.normal(0, 0.004, (2, 400, 5))
    assert duplicate_rows(force * bar, other, noise) == []
    assert duplicate_rows(force * bar, force * bar, noise) == [(2, 3)]


@pytest.mark.parametrize("seed", range(4))
def test_lines_that_differ_by_what_comes_and_goes_slowly_are_distinguished_from_one_line_read_twice(
    seed: int,
):
    rng = np.random.default_rng(seed)
    force = 1 + 0.2 * np.sin(np.arange(400) / 9)[:, None]
    thing = force * rng.uniform(0.5, 0.8, 5)  # it rocks on two rows: neither has more on the whole
    other = thing + 0.03 * np.sin(np.arange(400)[:, None] / 12 + rng.uniform(0, 6, 5))
    noise = rng.normal(0, 0.004, (2, 400, 5))
    assert duplicate_rows(thing, other, noise) == []
    assert duplicate_rows(thing, thing, noise) == [(2, 3)]


@pytest.mark.parametrize("first", range(29, 33))
def test_a_load_that_comes_with_the_last_frames_of_a_segment_is_compared_before_it_is_a_coincidence(
    first: int,
):
    log = np.zeros((32, 2, 6, 5))
    log[first:, 0, 2] = np.linspace(1.0, 2.0, 5)
    log[first:, 0, 3] = np.linspace(2.0, 3.0, 5)
    stream = state_after(log.reshape(32, 60))
    assert stream.duplicates.most == 0
    assert stream.duplicates.apart_since(0, "row", 2, 3) == (32 if first < 32 else 0)


def test_one_clear_difference_parts_two_lines_again():
    log = inject(pressed(1), [bridge(LAYOUT, Line(1, "row", 2))], LAYOUT, until=500)
    assert duplicate_pairs(log) == []
    assert duplicate_pairs(log[:500]) != []


def test_a_missing_reading_differs_from_nothing_and_a_position_without_a_cell_neither():
    log = inject(pressed(1), [bridge(LAYOUT, Line(1, "row", 2))], LAYOUT)
    log[::3, LAYOUT.cell(1, 2, 2)] = np.nan
    assert len(duplicate_pairs(log)) == 1
    present = np.ones(LAYOUT.shape, bool)
    present[1, 2, 2] = False
    layout = SensorLayout(2, 6, 5, present=present)
    log[:, layout.cell(1, 2, 2)] = 5.0
    stream = ColdStream(layout, Reference.unknown(layout))
    stream.extend(log)
    assert len(stream.complete().duplicates.duplicate_pairs(usual=2)) == 1


def test_lines_that_read_alike_in_the_reference_are_joined_no_more_in_a_log_of_any_length():
    def alike(seed: int) -> np.ndarray:
        log = pressed(seed)
        noise = np.random.default_rng(seed).normal(0, 0.01, (2, len(log), 5))
        row = pressed(seed + 100)[:, LAYOUT.cells_on(Line(1, "row", 2))]
        log[:, LAYOUT.cells_on(Line(0, "row", 2))] = row + noise[0]
        log[:, LAYOUT.cells_on(Line(0, "row", 3))] = row + noise[1]
        return log

    def joined(usual: UsualDuplicates, log: np.ndarray) -> list[DuplicatePair]:
        reference = replace(Reference.unknown(LAYOUT), duplicates=usual)
        stream = ColdStream(LAYOUT, reference)
        stream.extend(log)
        return stream.complete().duplicates.duplicate_pairs(usual.most)

    long_log = np.concatenate([alike(seed) for seed in range(4)])
    scale = Reference.unknown(LAYOUT).scale
    reference = [alike(seed) for seed in range(10, 18)]
    assert not joined(UsualDuplicates.fit(reference, LAYOUT, scale), long_log)
    others = [pressed(seed) for seed in range(10, 18)]
    found = joined(UsualDuplicates.fit(others, LAYOUT, scale), long_log)
    assert [(pair.first, pair.second) for pair in found if pair.kind == "row"] == [(2, 3)]


def test_cells_that_hold_still_or_are_saturated_or_unloaded_are_not_informative():
    scale = Reference.unknown(LAYOUT).scale
    frames = np.zeros((3, 60))
    frames[:, :4] = [[1.0, 1.0, 5.0, 0.01]]
    still = np.arange(60) == 1
    assert np.flatnonzero(informative(frames, still, scale)).tolist() == [0]


def test_the_most_coincidences_of_any_pair_are_kept():
    assert DuplicateLines.begin(LAYOUT).most == 0
    log = inject(pressed(1), [bridge(LAYOUT, Line(1, "row", 2))], LAYOUT, until=500)
    assert state_after(log).duplicates.most >= duplicate_pairs(log[:500])[0].coincidences


# What joins them


@pytest.mark.parametrize("level", [0, 1])
@pytest.mark.parametrize(
    ("kind", "bit"), [("row_address", 0), ("row_address", 1), ("column_address", 0)]
)
def test_a_stuck_address_bit_is_named_with_its_level_and_its_copies(
    kind: str, bit: int, level: int
):
    line = Line(0, kind, bit)
    fault = line_fault(LAYOUT, line, FaultKind.ALIAS, value=level, onset=120)
    (cause,) = caused(inject(pressed(2, 50), [fault], LAYOUT))
    assert cause.line == line
    # With hardly any cell left that reads itself the level may stay open, and both are reported.
    assert cause.value == level or cause.alternatives == (f"{line} is stuck at {level}",)
    assert 100 <= cause.onset <= 160
    if cause.value == level:
        assert set(cause.cells) == set(fault.cells)
        name, lines = ("row", LAYOUT.rows) if kind == "row_address" else ("column", LAYOUT.cols)
        moved = [i for i in range(lines) if i >> bit & 1 != level]
        read = [f"{name} {i ^ 1 << bit}" if i ^ 1 << bit < lines else "nothing" for i in moved]
        copies = ", ".join(
            f"{name} {i} reads {other}" for i, other in zip(moved, read, strict=True)
        )
        assert cause.reason.startswith(
            f"{line} is stuck at {level}: {copies} from frame {cause.onset} on"
        )
    assert 0.9 < cause.probability < 1


def test_its_level_follows_from_the_loads_of_the_intact_lines(grasps, fitted):
    bits = [line for line in grasps.layout.lines if line.kind in ("row_address", "column_address")]
    rng = np.random.default_rng(0)
    blamed = 0
    for level in (0, 1):
        for line in bits:
            log = np.concatenate(
                [grasps.frames[i] for i in rng.choice(np.arange(1, 140, 2), 4, replace=False)]
            )
            fault = line_fault(grasps.layout, line, FaultKind.ALIAS, value=level)
            told = fitted.diagnose(inject(log, [fault], grasps.layout)).faults
            (found,) = [one for one in told if one.line is not None]
            assert found.line == line
            assert found.value == level or found.alternatives  # or it says that it is in doubt
            blamed += len(told) - 1
    assert blamed <= 1  # healthy cells, in all 32 logs


@pytest.mark.parametrize(
    "line", [Line(0, "row", 1), Line(0, "row", 2), Line(1, "column", 1), Line(1, "column", 3)]
)
def test_a_bridge_of_neighbours_is_distinguished_from_a_stuck_bit(line: Line):
    (cause,) = caused(inject(pressed(3), [bridge(LAYOUT, line)], LAYOUT))
    assert (cause.line, cause.value) == (line, line.index + 1)
    assert set(cause.cells) == set(bridge(LAYOUT, line).cells)
    assert cause.alternatives


def test_a_single_line_read_twice_is_distinguished_from_a_stuck_bit():
    cells = tuple(LAYOUT.cells_on(Line(0, "row", 4)).tolist())
    (cause,) = caused(
        inject(pressed(3), [Fault("alias", cells, line=Line(0, "row", 4), value=3)], LAYOUT)
    )
    assert (cause.line, cause.value) == (Line(0, "row", 3), 4)
    assert set(cells) <= set(cause.cells)


def test_two_pads_with_a_fault_each_have_two_causes():
    faults = [
        line_fault(LAYOUT, Line(0, "row_address", 0), FaultKind.ALIAS, value=0),
        bridge(LAYOUT, Line(1, "column", 1)),
    ]
    assert {cause.line for cause in caused(inject(pressed(4, 40), faults, LAYOUT))} == {
        fault.line for fault in faults
    }


@pytest.mark.parametrize("seed", range(4))
def test_a_healthy_log_has_no_aliasing(seed: int):
    assert caused(pressed(seed)) == []
