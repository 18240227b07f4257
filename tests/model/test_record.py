"""The record of a log: every frame in one piece, no piece across recordings."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from diagnostics.model.record import UNIT, Record, Recorder, frames_of_piece, record_of

LENGTHS = st.lists(st.integers(1, 40), min_size=1, max_size=5)


def readings(lengths: list[int], seed: int) -> list[np.ndarray]:
    rng = np.random.default_rng(seed)
    return [rng.normal(size=(n, 3)).astype(np.float32) for n in lengths]


@given(LENGTHS, st.integers(1, 8), st.integers(0, 9))
def test_a_piece_holds_the_frames_between_its_beginning_and_the_next(lengths, length, seed):
    log = readings(lengths, seed)
    record = record_of(log, length)
    whole = np.concatenate(log)
    of_frame = np.repeat(np.arange(len(log)), lengths)
    for i, (begin, end) in enumerate(zip(record.begins, record.ends(), strict=True)):
        assert set(of_frame[begin:end]) == {record.recording[i]}
        np.testing.assert_array_equal(record.low[i], whole[begin:end].min(axis=0))
        np.testing.assert_array_equal(record.high[i], whole[begin:end].max(axis=0))
        np.testing.assert_allclose(record.mean[i], whole[begin:end].mean(axis=0), atol=1e-5)
    assert record.ends()[-1] == record.n_frames == len(whole)


@given(LENGTHS, st.integers(1, 8))
def test_a_unit_is_a_few_successive_pieces_of_one_recording(lengths, length):
    record = record_of(readings(lengths, 0), length)
    for unit in np.unique(record.of_unit):
        pieces = np.flatnonzero(record.of_unit == unit)
        assert len(pieces) <= UNIT
        assert (np.diff(pieces) == 1).all()
        assert len(set(record.recording[pieces])) == 1
    values = np.arange(len(record), dtype=np.float32)[:, None]
    assert record.sum_of_units(values).sum() == values.sum()


def test_where_nothing_was_received_a_piece_reads_as_the_one_before():
    frames = np.arange(12.0).reshape(12, 1)
    frames[4:8] = np.nan
    record = record_of([frames], 4)
    np.testing.assert_array_equal(record.received[:, 0], [True, False, True])
    np.testing.assert_array_equal(record.mean[:, 0], [1.5, 1.5, 9.5])


def test_a_recording_that_begins_without_a_reading_takes_none_of_the_one_before():
    before = 5.0 + np.arange(4)[:, None]
    after = np.array([[np.nan]] * 4 + [[30.0], [31.0], [32.0], [33.0]])
    record = record_of([before, after], 4)
    assert not record.received[1, 0]
    assert record.mean[1, 0] < 5.0


def test_frames_that_repeat_the_one_before_tell_nothing():
    fresh = np.arange(24.0)[:, None]
    repeated = np.repeat(fresh, 5, axis=0)
    one = record_of([fresh, fresh], 4)
    other = record_of([repeated, repeated], 4)
    np.testing.assert_array_equal(one.mean, other.mean)
    np.testing.assert_array_equal(5 * one.begins, other.begins)


@pytest.mark.parametrize(("frames", "length"), [(1, 1), (12, 2), (60, 8), (1000, 8)])
def test_a_short_recording_has_some_pieces_too(frames, length):
    assert frames_of_piece([np.zeros((frames, 1))]) == length


def joined(seed: int) -> np.ndarray:
    """Two recordings of contacts elsewhere, one behind the other, ``[60, 20]``."""
    rng = np.random.default_rng(seed)
    frames = rng.normal(0, 1, (60, 20))
    frames[:30, :6] += 100 * np.sin(np.linspace(0.3, 1.5, 30))[:, None]
    frames[30:, 10:16] += 100 * np.sin(np.linspace(1.5, 0.3, 30))[:, None]
    return frames


def in_one(frames: np.ndarray, longest: int) -> Record:
    """Return the record of frames that came as one recording."""
    numbers = np.arange(len(frames))
    return Recorder(8, 10.0, longest=longest).extend(frames, numbers).record(len(frames))


def test_recordings_that_were_joined_begin_with_a_cut():
    record = in_one(joined(0), longest=30)
    assert record.begins[record.first].tolist() == [0, 30]
    assert set(record.recording) == {0}


def test_a_recording_as_long_as_those_of_the_reference_has_no_cut():
    record = in_one(joined(0), longest=31)
    assert record.begins[record.first].tolist() == [0]


def test_noise_is_no_cut():
    frames = joined(0) + 200 * np.random.default_rng(1).normal(size=(60, 20))
    record = in_one(frames, longest=1)
    assert record.first.sum() <= 2  # the first of all may be one


@pytest.mark.parametrize("size", [1, 7, 20, 31])
def test_a_record_is_the_same_however_the_frames_come_in_and_whoever_reuses_their_memory(size):
    frames = joined(2)
    whole = Recorder(4, 10.0, longest=30).extend(frames, np.arange(60)).record(60)
    recorder = Recorder(4, 10.0, longest=30)
    memory = np.empty((size, 20))
    for begin in range(0, 60, size):
        some = frames[begin : begin + size]
        memory[: len(some)] = some
        first = np.arange(begin, begin + len(some)) == 0
        recorder = recorder.extend(memory[: len(some)], begin + np.arange(len(some)), begins=first)
    parts = recorder.record(60)
    np.testing.assert_array_equal(parts.begins, whole.begins)
    np.testing.assert_array_equal(parts.first, whole.first)
    np.testing.assert_allclose(parts.mean, whole.mean)
