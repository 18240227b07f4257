"""The rate of a recording comes from all its times, whatever their clock does."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from adaptfault.data.recordings.facts.rates import Elapsed

RATES = (10, 31.25, 50, 60, 100, 120, 500)


def rate_of(times, tick=None, pieces=1):
    elapsed = Elapsed()
    for piece in np.array_split(np.asarray(times, dtype=float), pieces):
        elapsed.add(piece)
    return elapsed.rate(tick)


@pytest.mark.parametrize("rate", RATES)
@pytest.mark.parametrize("written", [np.floor, np.round])
def test_times_in_whole_milliseconds_give_the_true_rate(rate, written):
    times = written(1000 * np.arange(300) / rate)
    assert rate_of(times) == pytest.approx(rate, rel=0.005)
    assert rate_of(times, "ms") == pytest.approx(rate, rel=0.005)


@pytest.mark.parametrize("rate", RATES)
@pytest.mark.parametrize("share", [0.02, 0.2])
def test_jitter_does_not_change_the_rate(rate, share):
    rng = np.random.default_rng(0)
    times = np.sort(np.arange(300) / rate + rng.normal(0, share / rate, 300))
    assert rate_of(times) == pytest.approx(rate, rel=0.01)


@pytest.mark.parametrize("rate", RATES)
def test_lost_frames_repeated_frames_pauses_and_resets_do_not_change_the_rate(rate):
    rng = np.random.default_rng(1)
    times = np.arange(600) / rate
    lost = np.delete(times, rng.choice(600, 60, replace=False))
    assert rate_of(np.floor(1000 * lost), "ms") == pytest.approx(rate, rel=0.02)
    paused = np.concatenate([times, times + times[-1] + 3600])
    assert rate_of(paused, "s") == pytest.approx(rate, rel=0.01)
    elapsed = Elapsed()
    elapsed.add(np.concatenate([times, times]))
    assert elapsed.rate("s") == pytest.approx(rate, rel=0.01)
    assert (elapsed.falls, elapsed.first_fall) == (1, 600)


def test_a_clock_of_whole_seconds_gives_the_rate_of_many_frames_a_second():
    assert rate_of(1_700_000_000 + np.floor(np.arange(2000) / 50)) == pytest.approx(50, rel=0.03)


@settings(max_examples=60, deadline=None)
@given(
    times=st.lists(st.floats(allow_nan=True, allow_infinity=True), max_size=40),
    pieces=st.integers(1, 6),
)
def test_times_that_may_be_anything_give_the_same_in_any_pieces(times, pieces):
    for tick in (None, "ms"):
        rate = rate_of(times, tick)
        assert rate is None or 0 < rate < np.inf
        assert rate_of(times, tick, pieces) == rate


@settings(max_examples=40, deadline=None)
@given(
    swaps=st.sets(st.integers(1, 97), max_size=12),
    rate=st.sampled_from(RATES),
    lost=st.sets(st.integers(2, 97), max_size=5),
)
def test_frames_that_changed_places_are_counted_and_none_of_them_is_lost(swaps, rate, lost):
    times = np.delete(np.arange(100) / rate, sorted(lost))
    kept = [i for i in sorted(swaps) if not swaps & {i - 1, i - 2} and i + 1 < len(times)]
    for i in kept:
        times[[i, i + 1]] = times[[i + 1, i]]
    elapsed = Elapsed()
    elapsed.add(times)
    clock = elapsed.clock()
    assert (clock.late, clock.falls) == (len(kept), 0)
    assert clock.pairs or not clock.late
    assert clock.lost == len(lost)
    assert elapsed.rate("s") == pytest.approx(rate, rel=0.01)


def test_a_recording_takes_as_long_as_its_times_span_with_pauses_and_lost_frames():
    times = np.delete(np.arange(1000) * 20.0, np.arange(401, 900, 2))
    times[300:] += 60_000
    elapsed = Elapsed()
    elapsed.add(times)
    assert elapsed.seconds("ms") == pytest.approx(80, rel=1e-3)
    assert Elapsed.of_all([elapsed, elapsed]).seconds("ms") == pytest.approx(160, rel=1e-3)
