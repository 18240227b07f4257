from dataclasses import replace

import numpy as np
import pytest

from diagnostics.events.constant_runs import ConstantRuns
from diagnostics.events.contact_events import EventLog, Summary, count_repeats
from diagnostics.preprocessing.scale import Scale

CELLS = 12
SCALE = Scale(np.zeros(CELLS), 0.05, 5.0)
HAND = np.array([0, 0, 1, 2, 3, 3, 2, 1, 0, 0, 0, 0], float)
ELSEWHERE = HAND[::-1]
SHAKY = np.random.default_rng(0).normal(0, 0.02, (5000, CELLS))


def held(frames: int, load: np.ndarray = HAND) -> np.ndarray:
    """A grasp: closes in 5 frames, holds with a little tremor, opens in 5."""
    force = np.concatenate([np.linspace(0.2, 1, 5), np.ones(frames), np.linspace(1, 0.05, 5)])[
        :, None
    ]
    return np.maximum(0, force * (load + (load > 0) * SHAKY[: len(force)]))


def idle(frames: int) -> np.ndarray:
    return np.zeros((frames, CELLS))


def events_of(log: np.ndarray, size: int = 32) -> EventLog:
    """Return the events of a log."""
    events = EventLog()
    runs = ConstantRuns.begin(log.shape[1])
    for first in range(0, len(log), size):
        frames = log[first : first + size]
        numbers = np.arange(first, first + len(frames))
        runs = runs.extend(frames, numbers, 0.025)
        events = events.extend(SCALE.root_load(frames), numbers, SCALE.root_near, runs.start)
    return events


def loaded(events: EventLog) -> list[set[int]]:
    """Return the cells that each event loaded."""
    return [set(np.flatnonzero(t.whole.loaded).tolist()) for t in events.kept]


@pytest.mark.parametrize("frames", [60, 300, 3000])
def test_a_static_hold_is_one_event_however_long(frames: int):
    log = np.concatenate([idle(10), held(frames)])
    assert loaded(events_of(log)).count({2, 3, 4, 5, 6, 7}) == 1


@pytest.mark.parametrize("times", [2, 3, 5])
def test_release_and_grasp_again_are_two(times: int):
    log = np.concatenate([part for _ in range(times) for part in (held(50), idle(20))])
    assert loaded(events_of(log)).count({2, 3, 4, 5, 6, 7}) == times


def test_a_load_that_moves_elsewhere_without_a_release_is_another_event():
    log = np.concatenate(
        [held(60, HAND * [1, 1, 1, 1, 1, 0, 0, 0, 0, 0, 0, 0])[:64], held(60, ELSEWHERE)[4:]]
    )
    assert len(events_of(log).kept) == 2


@pytest.mark.parametrize("frames", [50, 64, 77])
def test_a_load_that_is_elsewhere_from_one_frame_to_the_next_begins_another_event_with_that_frame(
    frames: int,
):
    log = np.concatenate(
        [np.tile(load, (frames, 1)) for load in (HAND, np.roll(HAND, 3), HAND, np.roll(HAND, -2))]
    )
    assert [t.first for t in events_of(log).kept] == [0, frames, 2 * frames, 3 * frames]


SEATED = np.array([0, 1, 2, 3, 3, 2, 1, 0, 0, 2, 3, 2], float)


@pytest.mark.parametrize("frames", [50, 64, 77])
def test_another_posture_on_a_seat_begins_another_event(frames: int):
    postures = SEATED, 0.2 * SEATED + 0.8 * np.roll(SEATED, 2), SEATED
    log = np.concatenate([np.tile(load, (frames, 1)) for load in postures])
    assert [t.first for t in events_of(log).kept] == [0, frames, 2 * frames]


@pytest.mark.parametrize("onset", [120, 128, 150])
def test_cells_that_break_all_at_once_under_a_static_hold_begin_no_event(onset: int):
    log = np.concatenate([np.tile(load, (100, 1)) for load in (np.roll(SEATED, 3), SEATED)])
    log[onset:, [3, 10]] = 0.0, 5.0
    assert [t.first for t in events_of(log).kept] == [0, 100]


@pytest.mark.parametrize("amplitude", [0.2, 0.5, 1.0])
def test_breathing_on_a_seat_ends_no_event(amplitude: float):
    breath = np.zeros((200, CELLS))
    breath[:, [1, 6]] = amplitude * np.sin(np.arange(200) / 4)[:, None]
    log = np.concatenate([np.tile(np.roll(SEATED, 3), (100, 1)), SEATED + breath])
    assert [t.first for t in events_of(log).kept] == [0, 100]


@pytest.mark.parametrize("end", [100, 113, 126])
@pytest.mark.parametrize("then", [np.roll(SEATED, 5), 0.2 * SEATED])
def test_what_is_held_since_a_slow_change_of_posture_has_not_outlasted_the_event_before(
    end: int, then: np.ndarray
):
    share = np.clip((np.arange(250)[:, None] - end + 15) / 15, 0, 1)
    log = (1 - share) * SEATED + share * then
    events = events_of(log).kept
    assert len(events) == 2
    assert events[1].since <= end


@pytest.mark.parametrize("onset", range(1, 18, 4))
def test_cells_that_break_all_at_once_do_not_hide_the_short_contacts_after(onset: int):
    light = 0.2 * HAND * [1, 1, 1, 1, 1, 0, 0, 0, 0, 0, 0, 0]
    broken = (5, 6, 7, 8, 9)
    log = np.concatenate([np.tile(load, (4, 1)) for load in (light, np.roll(light, 8)) * 4])
    usual = [t.first for t in events_of(log).kept]
    log[onset:, broken] = 5.0
    assert [t.first for t in events_of(log).kept] == usual == list(range(0, 32, 4))


def test_cells_that_blink_at_the_edge_of_a_contact_begin_no_event():
    log = np.concatenate([held(50), idle(20), held(300)])
    usual = [t.first for t in events_of(log).kept]
    log[80:, 8:] = np.random.default_rng(1).choice([0.0, 0.07], (len(log) - 80, 4))
    assert [t.first for t in events_of(log).kept] == usual


@pytest.mark.parametrize("broken", [(0,), (0, 1), (0, 1, 9, 10)])
def test_cells_stuck_at_full_scale_do_not_hide_a_release(broken: tuple[int, ...]):
    log = np.concatenate([part for _ in range(4) for part in (held(50), idle(20))])
    log[:, broken] = 5.0
    grasped = [cells for cells in loaded(events_of(log)) if {3, 4, 5} <= cells]
    assert len(grasped) == 4


def test_noise_is_no_event_beside_a_real_one():
    log = np.concatenate([held(50), np.abs(SHAKY[:400]) * 0.1, held(50)])
    assert loaded(events_of(log)).count({2, 3, 4, 5, 6, 7}) == 2
    assert len(events_of(log).kept) <= 4


def test_an_event_keeps_at_most_6_parts_and_they_add_up_to_all_its_frames():
    hold = held(490)[:-5]
    (event,) = events_of(hold).kept
    assert 1 < len(event.parts) <= 6
    assert sum(part.n for part in event.parts) == 495
    assert [part.first for part in event.parts][1:] == np.cumsum([part.n for part in event.parts])[
        :-1
    ].tolist()
    whole = event.whole
    at_once = Summary.of(SCALE.root_load(hold), 0, SCALE.root_near)
    np.testing.assert_allclose(whole.features(), at_once.features(), atol=1e-5)


def test_each_suffix_of_an_event_summarises_it_from_that_part_on():
    hold = held(190)[:-5]
    (event,) = events_of(hold).kept
    for suffix in event.suffixes():
        later = Summary.of(SCALE.root_load(hold[suffix.first :]), suffix.first, SCALE.root_near)
        assert suffix.n == later.n
        np.testing.assert_allclose(suffix.features(), later.features(), atol=1e-5)


def test_what_rests_is_unloaded_wherever_it_rests_and_a_missing_reading_rests():
    scale = Scale(np.array([0.0, 2.0, 1.0]), 0.05, 5.0)
    root = scale.root_load(np.array([[1.25, 2.0, np.nan], [5.0, 1.9, 1.02]]))
    assert root[0].tolist() == pytest.approx([0.5, 0, 0])
    assert ((root > scale.root_near) == [[True, False, False], [True, False, False]]).all()


def test_splitting_divides_the_events_in_time_order():
    events = events_of(np.concatenate([part for _ in range(6) for part in (held(50), idle(20))]))
    old, new = events.split(2)
    assert len(new.kept) == 2
    assert [t.first for t in old.kept + new.kept] == [t.first for t in events.kept]
    assert old.kept[-1].first < new.kept[0].first


def test_events_that_load_the_same_cells_are_counted_as_repeats_even_with_others_between():
    far = np.roll(HAND, 5)
    pats = [part for load in (HAND, HAND, far, HAND, far) for part in (held(50, load), idle(20))]
    events = [event for event in events_of(np.concatenate(pats)).kept if event.mean().any()]
    assert count_repeats(events).tolist() == [0, 1, 0, 2, 1]
    stuck = np.isin(np.arange(CELLS), [0, 11])
    broken = [
        replace(
            event, parts=tuple(replace(p, total=p.total + 2 * p.n * stuck) for p in event.parts)
        )
        for event in events
    ]
    assert count_repeats(broken).tolist() == [0, 1, 2, 3, 4]
    assert count_repeats(broken, among=~stuck).tolist() == [0, 1, 0, 2, 1]
    assert count_repeats(()).tolist() == []
