import numpy as np
import pytest

from diagnostics import TransportFault, freeze_stream, lose_frames
from diagnostics.preprocessing.transport import Patience, TransportState, repetitions

CELLS = 10
PRESENT = np.ones(CELLS, bool)
LOADED_FROM = np.full(CELLS, 0.1)
PATIENCE = 20
LIMIT = Patience(PATIENCE, PATIENCE, LOADED_FROM)


@pytest.fixture
def log() -> np.ndarray:
    return np.random.default_rng(0).uniform(0.5, 3, (200, CELLS))


def received(frames: np.ndarray, size: int = 1000, present: np.ndarray = PRESENT, patience=LIMIT):
    """Feed the frames in chunks; return the stream and the numbers of the frames that carry
    information."""
    transport = TransportState()
    informative = []
    for first in range(0, len(frames), size):
        transport, some = transport.receive(frames[first : first + size], present, patience)
        informative += (some + first).tolist()
    return transport, informative


def faults(transport: TransportState, working: np.ndarray = PRESENT) -> tuple[TransportFault, ...]:
    return transport.faults(LOADED_FROM, working, rate=10)


def test_frames_that_all_arrive_are_all_informative_and_there_is_no_fault(log):
    transport, informative = received(log)
    assert informative == list(range(200))
    assert transport.seen == 200
    assert faults(transport) == ()


def test_a_frozen_stream_is_dated_and_counted_and_its_frames_are_not_informative(log):
    transport, informative = received(freeze_stream(log, 60, 160))
    (fault,) = faults(transport)
    assert (fault.kind, fault.onset, fault.frames) == ("frozen", 60, 100)
    assert "frozen" in fault.reason
    assert informative == [*range(60 + PATIENCE + 1), *range(160, 200)]


def test_an_idle_pad_that_repeats_zeros_is_no_fault(log):
    log[60:160] = 0
    assert faults(received(log)[0]) == ()


def test_full_scale_cells_that_are_themselves_broken_do_not_make_an_idle_pad_frozen(log):
    log[60:160] = 0
    log[:, :4] = 5
    transport = received(log)[0]
    assert faults(transport, np.arange(CELLS) >= 4) == ()
    assert [fault.kind for fault in faults(transport)] == ["frozen"]


def test_a_frame_that_comes_again_a_few_times_is_no_fault(log):
    transport, informative = received(freeze_stream(log, 60, 60 + PATIENCE))
    assert faults(transport) == ()
    assert len(informative) == 200


def test_lost_frames_are_counted_and_the_first_is_named(log):
    lossy = lose_frames(log, 0.1, seed=0)
    transport, informative = received(lossy)
    lost = np.flatnonzero(np.isnan(lossy).all(axis=1))
    (fault,) = faults(transport)
    assert (fault.kind, fault.onset, fault.frames) == ("lost", lost[0], 20)
    assert informative == sorted(set(range(200)) - set(lost.tolist()))


def test_a_position_without_a_cell_does_not_make_a_lost_frame_arrive(log):
    log[50:60, 1:] = np.nan
    transport, _ = received(log, present=np.arange(CELLS) > 0)
    assert [(fault.kind, fault.frames) for fault in faults(transport)] == [("lost", 10)]
    assert faults(received(log)[0]) == ()


def test_frames_that_were_never_received_count_as_lost(log):
    transport, _ = received(log[:50])
    transport, _ = transport.without(3).receive(log[50:], PRESENT, LIMIT)
    (fault,) = faults(transport.without(2))
    assert (fault.kind, fault.onset, fault.frames) == ("lost", 50, 5)


@pytest.mark.parametrize("size", [1, 7, 32, 100])
def test_the_stream_is_the_same_however_the_frames_come_in(log, size: int):
    frames = lose_frames(freeze_stream(freeze_stream(log, 30, 80), 120, 190), 0.05, seed=1)
    at_once = received(frames)
    in_parts = received(frames, size)
    assert in_parts[1] == at_once[1]
    assert faults(in_parts[0]) == faults(at_once[0])
    assert len(faults(at_once[0])) == 3


def test_a_transport_fault_survives_its_dict():
    fault = TransportFault("lost", 3, 2, "why")
    assert TransportFault.from_dict(fault.to_dict()) == fault


def test_a_frame_with_load_is_frozen_sooner_than_an_idle_one(log):
    log[:100] = 0
    patience = Patience(150, PATIENCE, LOADED_FROM)
    transport, informative = received(freeze_stream(log, 120, 160), patience=patience)
    (fault,) = faults(transport)
    assert (fault.kind, fault.onset, fault.frames) == ("frozen", 120, 40)
    assert informative == [*range(120 + PATIENCE + 1), *range(160, 200)]


def test_a_stream_that_never_moved_is_frozen_or_its_cells_are_stuck(log):
    transport, _ = received(np.repeat(log[:1], 60, axis=0))
    (fault,) = transport.faults(LOADED_FROM, PRESENT, rate=10, moved=False)
    assert (fault.kind, fault.onset, fault.frames) == ("frozen", 0, 60)
    assert "10 cells are loaded" in fault.reason
    assert "frozen, or these cells are stuck" in fault.reason


def test_patience_is_twice_the_longest_repetition_with_load_and_without(log):
    idle = log.copy()
    loaded = freeze_stream(log, 10, 25)
    idle[50:90] = 0
    idle[:, :2] = 5  # two loaded cells may be broken
    patience = Patience.fit([idle, loaded, log], LOADED_FROM, 5)
    assert (patience.idle, patience.loaded) == (2 * 39, 2 * 14)
    patience = Patience.fit([log], LOADED_FROM, 5)
    assert (patience.idle, patience.loaded) == (5, 5)
    np.testing.assert_array_equal(patience.loaded_from, LOADED_FROM)


def test_each_frame_is_counted_how_often_it_came_again(log):
    assert not repetitions(log).any()
    assert repetitions(freeze_stream(log, 40, 44))[38:46].tolist() == [0, 0, 0, 1, 2, 3, 0, 0]
    assert repetitions(np.full((5, 3), np.nan)).tolist() == [0, 1, 2, 3, 4]
    assert not len(repetitions(np.empty((0, 3))))


@pytest.mark.parametrize("size", [1, 7, 1000])
@pytest.mark.parametrize("highest", [0.6, 5.0])
def test_a_sensor_that_rests_high_is_not_frozen_while_nothing_touches_it(size, highest):
    rng = np.random.default_rng(1)
    rest = rng.uniform(0.5, 1, CELLS) * highest
    untouched = np.tile(rest, (400, 1))
    for first in range(100, 400, 60):  # a contact of 20 frames on some cells
        untouched[first : first + 20] -= rng.uniform(0, 0.5, (20, CELLS)) * (
            rng.random(CELLS) < 0.6
        )
    transport, _ = received(untouched, size)
    assert [one.kind for one in transport.faults(LOADED_FROM, PRESENT, 10)] == ["frozen"] * 6
    assert transport.faults(LOADED_FROM, PRESENT, 10, falls=None) == ()


def test_a_frozen_stream_is_told_also_where_nothing_says_whether_readings_fall(log):
    transport, _ = received(freeze_stream(log, 60, 160))
    assert [one.kind for one in transport.faults(LOADED_FROM, PRESENT, 10, falls=None)] == [
        "frozen"
    ]
