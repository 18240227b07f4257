from copy import copy

import numpy as np
import pytest

from adaptfault.data.recordings import Recordings
from diagnostics import (
    FaultKind,
    Line,
    SensorLayout,
    bridge,
    freeze_stream,
    inject,
    line_fault,
    lose_frames,
)
from diagnostics.evidence.cold_start import ColdStream
from diagnostics.evidence.reference import Reference
from diagnostics.faults import Fault

LAYOUT = SensorLayout(2, 6, 5)
ROW, COLUMN = np.divmod(np.arange(30), 5)
UNKNOWN = Reference.unknown(LAYOUT)


def pressed(presses: int, seed: int = 0) -> np.ndarray:
    """Round presses here and there, 20 frames each, with pauses."""
    rng = np.random.default_rng(seed)
    force = np.sin(np.linspace(0, np.pi, 20))[:, None]
    log = []
    for _ in range(presses):
        at = [(rng.uniform(0, 5), rng.uniform(0, 4)) for _ in range(2)]
        load = [np.maximum(0, 3 - ((ROW - r) ** 2 + (COLUMN - c) ** 2) / 1.5) for r, c in at]
        log += [
            force * np.concatenate(load) * (1 + rng.normal(0, 0.02, (20, 60))),
            np.zeros((int(rng.integers(3, 9)), 60)),
        ]
    return np.concatenate(log)


def remembered(
    log: np.ndarray, size: int | None = None, reference: Reference = UNKNOWN
) -> ColdStream:
    stream = ColdStream(LAYOUT, reference)
    for first in range(0, len(log), size or len(log)):
        stream.extend(log[first : first + (size or len(log))])
    return stream.complete()


def differences(a: ColdStream, b: ColdStream) -> list[str]:
    """Return the names of what two states hold differently."""
    pairs = {}
    for part, names in {
        "runs": ("start", "length", "low", "high", "last", "same"),
        "intermittency": ("blinking", "noisy", "blinks", "high", "blinks_since", "noisy_since"),
        "transport": ("seen", "lost", "first_lost", "last", "repeats"),
    }.items():
        for name in names:
            pairs[f"{part}.{name}"] = [getattr(getattr(state, part), name) for state in (a, b)]
    pairs["received"] = [a.received, b.received]
    pairs["accumulated"] = [a.cold.accumulated, b.cold.accumulated]
    for kind in a.duplicates.of:
        for name in ("since", "seen_by", "coincidences", "sums"):
            pairs[f"duplicates.{kind}.{name}"] = [
                getattr(state.duplicates.of[kind], name) for state in (a, b)
            ]
    pairs["repetitions"] = [
        [(r.onset, r.frames) for r in state.transport.repetitions] for state in (a, b)
    ]
    pairs["parts"] = [
        [[(p.first, p.n) for p in event.parts] for event in state.cold.events.of[0].kept]
        for state in (a, b)
    ]
    found = [
        name for name, (of_a, of_b) in pairs.items() if name != "parts" and not equal(of_a, of_b)
    ]
    if pairs["parts"][0] != pairs["parts"][1]:
        return [*found, "parts"]
    events = zip(a.cold.events.of[0].kept, b.cold.events.of[0].kept, strict=True)
    alike = [equal(t.whole.features(), u.whole.features()) for t, u in events]
    return found if all(alike) else [*found, "features"]


def equal(a: object, b: object) -> bool:
    a = np.asarray(a)
    b = np.asarray(b)
    return np.array_equal(a, b, equal_nan=np.issubdtype(a.dtype, np.floating))


def broken() -> np.ndarray:
    """Faults of all kinds in one log, lost frames, and a frozen stream."""
    faults = [
        line_fault(LAYOUT, Line(0, "row", 2), FaultKind.OPEN, onset=700),
        Fault("stuck", (45,), value=2.2, onset=300),
        Fault("intermittent", (12,)),
        Fault("noisy", (38,), onset=100),
        bridge(LAYOUT, Line(1, "column", 0), onset=1000),
    ]
    log = inject(pressed(90), faults, LAYOUT, seed=0, dither=0.004)
    return lose_frames(freeze_stream(log, 1500, 1600), 0.06, seed=0)


@pytest.mark.parametrize("size", [1, 7, 32, 1000])
def test_it_is_the_same_however_the_frames_come_in(size: int):
    log = broken()
    at_once = remembered(log)
    assert differences(remembered(log, size), at_once) == []
    assert len(at_once.cold.events.of[0].kept) > 10
    assert at_once.transport.repetitions
    assert at_once.intermittency.blinks[12] > 0


def test_states_of_other_frames_differ():
    log = broken()
    other = broken()
    other[800] = np.nan  # lost
    other[1700:, 12] = other[1699, 12]
    found = differences(remembered(log), remembered(other))
    assert {"runs.length", "transport.lost", "intermittency.blinks"} <= set(found)


def test_looking_at_it_in_between_changes_nothing():
    log = broken()[:1800]
    stream = ColdStream(LAYOUT, UNKNOWN)
    for first in range(0, 1800, 29):
        stream.extend(log[first : first + 29])
        completed = stream.complete()
        completed.cold.spatial(completed)
    assert differences(stream.complete(), remembered(log)) == []


def test_completing_a_state_leaves_it_as_it_was():
    log = pressed(3)[:50]
    stream = ColdStream(LAYOUT, UNKNOWN)
    stream.extend(log)
    before = stream.runs
    assert stream.complete().runs.length.max() == 50
    assert stream.runs is before
    assert before.length.max() < 50


def test_a_copy_takes_in_frames_of_its_own():
    log = broken()[:500]
    stream = ColdStream(LAYOUT, UNKNOWN)
    stream.extend(log[:50])
    copy(stream).extend(log[200:300])
    stream.extend(log[50:])
    assert differences(stream.complete(), remembered(log)) == []


def test_it_stays_of_constant_size_over_a_long_log():
    log = pressed(40)
    stream = ColdStream(LAYOUT, UNKNOWN)
    most = []
    for _ in range(20):
        stream.extend(log)
        most.append(len(stream.cold.events.of[0].kept))
    assert stream.transport.seen == 20 * len(log)
    assert max(most) < 100
    assert max(most[10:]) <= max(most[:10]) + 5
    assert all(len(event.parts) <= 4 for event in stream.cold.events.of[0].kept)
    assert len(stream.transport.repetitions) < 100


def test_evidence_of_dropped_events_still_counts():
    cell = LAYOUT.cell(0, 2, 2)
    log = inject(pressed(200), [Fault("open", (cell,))], LAYOUT)
    stream = remembered(log)
    assert stream.cold.events.of[0].kept[0].first > 1000
    assert stream.cold.accumulated[cell] > 10
    few = remembered(log[stream.cold.events.of[0].kept[0].first :])
    evidence, without = (m.cold.spatial(m).surprisal[cell] for m in (stream, few))
    assert evidence > without + 5


def test_accumulated_evidence_ends_with_its_constant_run():
    cell = LAYOUT.cell(0, 2, 2)
    log = inject(pressed(250), [Fault("open", (cell,))], LAYOUT, until=5500)
    stream = remembered(log[:5500])
    assert stream.cold.accumulated[cell] > 10
    assert remembered(log).cold.accumulated[cell] < 3


def test_missed_frames_are_counted_and_are_no_evidence_about_cells():
    log = pressed(10)
    stream = ColdStream(LAYOUT, UNKNOWN)
    stream.extend(log[:100])
    stream.miss(5)
    stream.miss(0)
    stream.miss(-3)
    stream.extend(log[100:])
    assert stream.transport.lost == 5
    np.testing.assert_array_equal(stream.complete().runs.start, remembered(log).runs.start)


def test_a_cell_that_delivers_a_reading_now_and_then_was_heard():
    log = pressed(20)[:320]
    log[:, 7] = np.nan
    # silent at the end of each segment
    log[:, 8] = np.where(np.arange(len(log)) % 32 < 30, log[:, 8], np.nan)
    assert remembered(log).received.tolist() == [cell != 7 for cell in range(60)]


def test_a_frozen_stream_makes_no_cell_constant(grasps: Recordings):
    layout = grasps.layout
    log = np.concatenate([grasps.frames[i] for i in (30, 50, 70)]).astype(float)
    stream = ColdStream(layout, Reference.unknown(layout))
    frozen = np.concatenate([log, np.repeat(log[-1:], 3000, axis=0)])
    stream.extend(frozen)
    assert stream.complete().runs.length[log[-1] > 0.3].max() < 200
