import numpy as np
import pytest

from diagnostics import TransportFault, freeze_stream, lose_frames
from diagnostics.preprocessing.transport import TransportState, longest_repetition

CELLS = 10
PRESENT = np.ones(CELLS, bool)
LOADED_FROM = np.full(CELLS, 0.1)
PATIENCE = 20


@pytest.fixture
def log() -> np.ndarray:
    return np.random.default_rng(0).uniform(0.5, 3, (200, CELLS))


def received(frames: np.ndarray, size: int = 1000, present: np.ndarray = PRESENT) -> tuple[TransportState, list[int]]:
    """Feed the frames in chunks; return the stream and the numbers of the frames that carry information."""
    transport, informative = TransportState(), []
    for first in range(0, len(frames), size):
        transport, some = transport.receive(frames[first : first + size], present, PATIENCE)
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
    transport, _ = transport.without(3).receive(log[50:], PRESENT, PATIENCE)
    (fault,) = faults(transport.without(2))
    assert (fault.kind, fault.onset, fault.frames) == ("lost", 50, 5)


@pytest.mark.parametrize("size", [1, 7, 32, 100])
def test_the_stream_is_the_same_however_the_frames_come_in(log, size: int):
    frames = lose_frames(freeze_stream(freeze_stream(log, 30, 80), 120, 190), 0.05, seed=1)
    at_once, in_parts = received(frames), received(frames, size)
    assert in_parts[1] == at_once[1]
    assert faults(in_parts[0]) == faults(at_once[0])
    assert len(faults(at_once[0])) == 3


def test_a_transport_fault_survives_its_dict():
    fault = TransportFault("lost", 3, 2, "why")
    assert TransportFault.from_dict(fault.to_dict()) == fault


def test_the_longest_repetition_counts_how_often_a_frame_came_again(log):
    assert longest_repetition(log) == 0
    assert longest_repetition(freeze_stream(freeze_stream(log, 10, 13), 40, 50)) == 9
    assert longest_repetition(np.full((5, 3), np.nan)) == 4
