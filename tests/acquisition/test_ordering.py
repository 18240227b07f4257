"""Packets in order: loss, reordering, doubles, leaps and restarts of one device."""

import numpy as np
import pytest

from adaptfault.acquisition import Ordering
from adaptfault.acquisition.packet import Packet

RATE = 10.0
rng = np.random.default_rng(0)


def packet(number: float, start: float = 0.0) -> Packet:
    """The ``number``-th packet of a device that was switched on ``start`` seconds before; its value
    tells which."""
    return Packet("a", round(start + number / RATE, 3), np.array([float(number)]))


def played(packets, *, flush=True, rate=RATE):
    """Push packets as they would come; return the ordering and the frames."""
    ordering = Ordering("a", rate)
    frames = []
    for i, one in enumerate(packets):
        frames += ordering.push(one, i / RATE)
    return ordering, frames + (ordering.flush() if flush else [])


def numbers(frames) -> list[int]:
    return [int(frame.values[0]) for frame in frames]


def test_packets_in_order_are_given_on_at_once():
    ordering = Ordering("a", RATE)
    for i in range(50):
        (frame,) = ordering.push(packet(i), i / RATE)
        assert (frame.time, frame.lost, frame.restarted) == (pytest.approx(i / RATE), 0, False)
    assert ordering.arrivals.kept == 50


def test_packets_that_changed_places_are_put_in_order_and_none_is_lost():
    order = np.arange(300)
    for i in range(1, 298, 3):
        order[i : i + 3] = rng.permutation(order[i : i + 3])
    ordering, frames = played(packet(i) for i in order)
    assert numbers(frames) == list(range(300))
    assert ordering.arrivals.lost == ordering.arrivals.late == 0


def test_lost_packets_are_counted_and_hold_the_others_up_no_longer_than_the_window():
    ordering = Ordering("a", RATE, window=3)
    frames = [ordering.push(packet(i), i / RATE) for i in (0, 1, 4, 5, 6, 7, 8)]
    assert [numbers(some) for some in frames] == [[0], [1], [], [], [], [4, 5, 6, 7], [8]]
    assert frames[5][0].lost == 2
    assert ordering.arrivals.lost == 2


def test_a_packet_that_waits_for_a_lost_one_is_given_on_in_time_though_no_other_comes():
    ordering = Ordering("a", RATE, window=3)
    ordering.push(packet(0), 0.0)
    assert ordering.push(packet(2), 0.2) == []
    assert ordering.overdue(0.3) == []
    assert numbers(ordering.overdue(0.65)) == [2]


def test_doubles_are_known_again_whether_they_wait_or_are_gone():
    ordering, frames = played(packet(i) for i in (0, 0, 1, 3, 3, 1, 2, 2, 3, 4))
    assert numbers(frames) == [0, 1, 2, 3, 4]
    assert ordering.arrivals.duplicates == 5


def test_a_packet_that_comes_too_late_is_dropped_and_counted():
    ordering, frames = played(packet(i) for i in (0, 2, 3, 4, 5, 1, 6))
    assert numbers(frames) == [0, 2, 3, 4, 5, 6]
    assert (ordering.arrivals.late, ordering.arrivals.lost) == (1, 1)


def test_a_device_that_starts_anew_goes_on_and_time_keeps_rising():
    packets = [packet(i, start=500.0) for i in range(20)] + [packet(i) for i in range(20)]
    ordering = Ordering("a", RATE)
    frames = []
    for i, one in enumerate(packets):
        # it takes a second to start
        frames += ordering.push(one, i / RATE + (1.0 if i >= 20 else 0.0))
    assert numbers(frames) == [*range(20), *range(20)]
    assert [frame.restarted for frame in frames].index(True) == 20
    assert ordering.arrivals.restarts == 1
    assert (np.diff([frame.time for frame in frames]) > 0).all()


def test_replayed_packets_of_a_device_that_still_sends_are_no_restart_and_are_dropped():
    packets = [packet(i, start=500.0) for i in range(200)]
    ordering = Ordering("a", RATE)
    frames = []
    for i, one in enumerate(packets):
        frames += ordering.push(one, i / RATE)
        if i > 100:
            for old in packets[i - 100 : i - 95]:  # a burst of old packets after each
                frames += ordering.push(old, i / RATE + 0.01)
    assert numbers(frames) == list(range(200))
    arrivals = ordering.arrivals
    assert (arrivals.restarts, arrivals.strays + arrivals.duplicates, arrivals.lost) == (
        0,
        99 * 5,
        0,
    )


def test_where_clocks_never_go_back_old_packets_are_dropped_however_long_the_device_is_silent():
    ordering = Ordering("a", RATE, restarts=False)
    for i in range(20):
        ordering.push(packet(i, start=500.0), i / RATE)
    assert not [frame for i in range(10) for frame in ordering.push(packet(i), 1000.0 + i)]
    assert numbers(ordering.push(packet(20, start=500.0), 2000.0)) == [20]


def test_after_a_restart_the_time_that_it_took_is_counted():
    ordering = Ordering("a", RATE)
    ordering.push(packet(0, start=100.0), 50.0)
    ordering.push(packet(0), 53.0)
    frames = ordering.push(packet(1), 53.1)
    assert [frame.time for frame in frames] == pytest.approx([103.0, 103.1])


def test_one_wild_time_stamp_changes_nothing():
    for wild in (1e9, 0.0, 5000.0):
        packets = [packet(i, start=100.0) for i in range(30)]
        packets[15:15] = [Packet("a", wild, np.array([-1.0]))]
        ordering, frames = played(packets)
        assert numbers(frames) == list(range(30))
        assert (ordering.arrivals.strays, ordering.arrivals.restarts, ordering.arrivals.lost) == (
            1,
            0,
            0,
        )


def test_a_device_that_was_silent_for_long_goes_on_and_what_is_missing_is_counted():
    ordering, frames = played(
        [*(packet(i) for i in range(5)), *(packet(i) for i in range(6000, 6005))]
    )
    assert numbers(frames) == [*range(5), *range(6000, 6005)]
    assert ordering.arrivals.lost == 5995


def test_whatever_comes_time_rises_every_packet_is_counted_once_and_memory_stays_bounded():
    for seed in range(10):
        generator = np.random.default_rng(seed)
        ordering = Ordering("a", RATE)
        frames = []
        at = 0.0
        number = 0
        for _ in range(400):
            number = int(
                generator.choice(
                    [number + 1, number, number - 2, number + 3, 0, number + 500, 10**9]
                )
            )
            frames += ordering.push(packet(max(0, number)), at)
            at += float(generator.uniform(0, 0.5))
            frames += ordering.overdue(at) if generator.random() < 0.2 else []
            now = ordering.arrivals
            assert now.held <= ordering.window + 1
            assert now.received == now.kept + now.duplicates + now.late + now.strays + now.held
        frames += ordering.flush()
        assert ordering.arrivals.held == 0
        assert len(frames) == ordering.arrivals.kept
        assert (np.diff([frame.time for frame in frames]) > 0).all()
        assert sum(frame.restarted for frame in frames) == ordering.arrivals.restarts
