"""The check of the unit of time stamps."""

import pytest

from adaptfault.acquisition import Receiver
from adaptfault.acquisition.clock import ClockCheck
from diagnostics import SensorLayout


def told(stamps, *, ticks=1000.0, rate=10.0):
    """Feed one time stamp (in ticks) every 1/rate seconds; return what was told."""
    check = ClockCheck(ticks)
    texts = [check.push(stamp / ticks, i / rate) for i, stamp in enumerate(stamps)]
    return [text for text in texts if text]


@pytest.mark.parametrize(
    ("ticks", "a_second", "text"),
    [
        (1e3, 1, "time stamps advance 1,000 times too slowly; are they seconds? --ticks s"),
        (1e3, 1e6, "time stamps advance 1,000 times too fast; are they microseconds? --ticks us"),
        (1e3, 1e9, "1,000,000 times too fast; are they nanoseconds? --ticks ns"),
        (1e6, 1, "1,000,000 times too slowly; are they seconds? --ticks s"),
        (1.0, 1e3, "1,000 times too fast; are they milliseconds? --ticks ms"),
        (60.0, 60e3, "1,000 times too fast, expected 60 ticks a second; --ticks states another"),
    ],
)
def test_another_unit_of_time_stamps_is_told_once_with_the_option_that_mends_it(
    ticks, a_second, text
):
    (only,) = told([int(i / 10 * a_second) for i in range(200)], ticks=ticks)
    assert text in only


@pytest.mark.parametrize("pace", [1.0, 0.5, 2.0, 30.0])
def test_time_stamps_in_the_stated_unit_are_not_told_also_when_a_recording_is_played_faster(pace):
    assert told([i * 100 * pace for i in range(300)]) == []


def test_a_clock_that_is_set_once_is_not_told():
    stamps = [i * 100 for i in range(60)]
    assert told([*stamps, *(stamp + 3_000_000 for stamp in stamps)]) == []
    assert told([*stamps, *stamps]) == []  # restarted


def test_the_receiver_tells_each_device_once():
    heard = []
    receiver = Receiver(
        SensorLayout(1, 1, 2), on_trouble=lambda device, text: heard.append((device, text))
    )
    for i in range(100):
        for device in ("a", "b"):
            receiver.take(f"{device},{i / 10},1,2".encode(), i / 10)
    assert [device for device, _ in heard] == ["a", "b"]
    assert all("are they seconds? --ticks s" in text for _, text in heard)
