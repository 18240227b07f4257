"""Names that anybody invents on the network: a station reads nothing for them."""

import numpy as np
import power_cut
import pytest

from adaptfault.acquisition import Station, format_packet
from adaptfault.acquisition import station as station_module
from adaptfault.acquisition.newcomers import TRIAL, Newcomers
from adaptfault.acquisition.ordering import Frame
from adaptfault.prediction.predictor import Predictor
from diagnostics import Monitor, SensorLayout

SMALL = SensorLayout(1, 2, 3)


def frame(device: str, at: float = 0.0) -> Frame:
    return Frame(device, at, np.zeros(6))


def test_the_first_name_and_listed_ones_are_watched_at_once_and_others_after_a_while():
    newcomers = Newcomers(10.0, ["listed"])
    assert [one.device for one in newcomers.take(frame("first"), 0.0)] == ["first"]
    assert [one.device for one in newcomers.take(frame("listed"), 0.0)] == ["listed"]
    assert newcomers.take(frame("third", 1.0), 5.0) == []
    assert newcomers.take(frame("third", 1.5), 5.5) == []
    taken = newcomers.take(frame("third", 2.0), 5.0 + TRIAL)
    assert [one.time for one in taken] == [1.0, 1.5, 2.0]
    assert newcomers.rest() == []


def test_names_that_do_not_last_are_told_together_and_hold_few_frames():
    newcomers = Newcomers(10.0, None)
    newcomers.take(frame("first"), 0.0)
    assert newcomers.forget([], 0.0) is None
    for i in range(30):
        newcomers.take(frame(f"invented {i}"), 1.0)
    assert newcomers.forget([], 1.5).startswith(
        "30 names sent for less than 1 s and went unwatched"
    )
    newcomers.take(frame("more"), 2.0)
    assert newcomers.forget([], 2.5) is None
    assert newcomers.forget([], 12.0).startswith("1 name sent")
    for i in range(1000):
        newcomers.take(frame("fast", i / 1000), 20.0)
    assert len(newcomers.rest()) <= 64


@pytest.fixture
def station(linear_bundle, monkeypatch):
    """A station with a bundle, what it loaded, its events, and a clock."""
    loaded = []
    load = Predictor.load.__func__

    def counted(cls, *args, **options):
        loaded.append(args)
        return load(cls, *args, **options)

    monkeypatch.setattr(Predictor, "load", classmethod(counted))
    now = [0.0]
    monkeypatch.setattr(station_module.time, "monotonic", lambda: now[0])
    events = []
    made = Station(None, bundle=str(linear_bundle), quiet=True, on_event=events.append)
    return made, loaded, events, now


def take_all(station: Station) -> None:
    """Take the frames that wait."""
    while station.receiver._queue:
        station._take(station.receiver._queue.popleft())


def test_thirty_invented_names_a_second_load_nothing_and_take_no_frame_of_a_real_device(station):
    made, loaded, events, now = station
    assert len(loaded) == 1
    values = np.zeros(power_cut.LAYOUT.n_cells)
    watched = set()
    for step in range(200):  # 20 s
        now[0] = step / 10
        names = ["real", *(f"x{step}-{i}" for i in range(3))]
        if step > 50:
            names.append("second")
        for name in names:
            made.receiver.take(format_packet(name, step / 10, values), now[0], name)
        take_all(made)
        watched |= set(made._sessions.of)
    assert watched == {"real", "second"}
    assert len(loaded) == 1
    told = [event.text for event in events if event.kind == "trouble"]
    for said in ("went unwatched; --device NAME", "16 devices send, and no more are taken"):
        assert 1 <= sum(said in text for text in told) <= 2
    assert len(told) <= 4


def test_a_second_device_is_watched_by_itself_and_shares_the_model(station):
    made, _, _, now = station
    rng = np.random.default_rng(0)
    for step in range(60):
        now[0] = step / 10
        for name in ("first", "second"):
            values = rng.uniform(0, 1, power_cut.LAYOUT.n_cells)
            made.receiver.take(format_packet(name, step / 10, values), now[0], name)
        take_all(made)
    first = made._sessions.of["first"].watcher
    second = made._sessions.of["second"].watcher
    assert first._running is second._running
    assert first._monitor is not second._monitor
    assert isinstance(second._monitor, Monitor)
    assert (first._frames != second._frames).any()
    assert second.version == 1
