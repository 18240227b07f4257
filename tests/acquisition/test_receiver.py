"""The receiver: real sockets on loopback, hostile datagrams, bounded memory."""

import asyncio
import importlib.util
import socket
import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from adaptfault.acquisition import Counters, Receiver, Station, format_packet, read_key
from diagnostics import SensorLayout

SMALL = SensorLayout(1, 2, 3, rate=1000.0)
FAULTS = ("malformed", "oversized", "refused", "duplicates", "late", "strays", "held")


def example(name: str):
    """Import a script of the examples."""
    path = Path(__file__).parents[2] / "examples" / f"{name}.py"
    spec = importlib.util.spec_from_file_location(name, path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def taken(datagrams, layout=SMALL, **options) -> tuple[Receiver, list]:
    """Hand datagrams to a receiver without a socket; return it and the frames."""

    async def run():
        receiver = Receiver(layout, **options)
        for i, data in enumerate(datagrams):
            receiver.take(data, i / layout.rate)
        receiver.close()
        return receiver, [frame async for frame in receiver]

    return asyncio.run(run())


def packets(count, device="a", layout=SMALL):
    return [
        format_packet(device, i / layout.rate, np.full(layout.n_cells, i % 5)) for i in range(count)
    ]


def received(packets_per_second, *, count, seconds=20.0, queue=4096, **mischief):
    """Play a recording over loopback as the example does; return (what was sent, counters,
    frames)."""
    sender = example("esp32_sender")

    async def run():
        frames = []
        async with Receiver(SMALL, queue=queue) as receiver:
            stream = sender.stream(
                np.arange(count * 6.0).reshape(count, 6) % 5, SMALL.rate, "esp32", **mischief
            )
            sending = asyncio.create_task(
                asyncio.to_thread(
                    sender.send, stream, "127.0.0.1", receiver.port, packets_per_second
                )
            )

            async def listen():
                async for frame in receiver:
                    frames.append(frame)

            listening = asyncio.create_task(listen())
            sent = await asyncio.wait_for(sending, seconds)
            for _ in range(100):
                if receiver.counters.received >= sent.packets:
                    break
                await asyncio.sleep(0.02)
            receiver.close()
            await asyncio.wait_for(listening, seconds)
        return sent, receiver.counters, frames

    return asyncio.run(run())


def test_what_is_played_over_the_network_arrives_in_order():
    sent, counters, frames = received(2000, count=500)
    assert (sent.packets, sent.good) == (500, 500)
    assert (counters.received, counters.kept, counters.lost, counters.devices) == (500, 500, 0, 1)
    values = np.stack([frame.values for frame in frames])
    np.testing.assert_allclose(values, np.arange(3000.0).reshape(500, 6) % 5)
    np.testing.assert_allclose(np.diff([frame.time for frame in frames]), 0.001, atol=1e-9)


def test_every_good_packet_is_kept_among_garbage_doubles_and_packets_out_of_order():
    sent, counters, frames = received(
        2000, count=2000, garbage=0.1, reorder=0.05, duplicates=0.05, seed=1
    )
    assert sent.garbage > 100
    assert counters.received == sent.packets
    assert counters.kept == len(frames) == sent.good == 2000
    assert counters.malformed + counters.oversized == sent.garbage
    assert counters.duplicates == sent.duplicates
    assert counters.lost == counters.late == counters.strays == counters.dropped == 0


def test_lost_packets_are_counted_exactly():
    sent, counters, frames = received(2000, count=1000, loss=0.1, reorder=0.05, seed=2)
    assert counters.kept == len(frames) == sent.good == 1000 - sent.lost
    inner = round((frames[-1].time - frames[0].time) * SMALL.rate) + 1
    assert counters.lost == inner - len(frames) == sum(frame.lost for frame in frames)


def test_several_devices_are_kept_apart():
    mixed = [one for pair in zip(packets(100, "a"), packets(100, "b"), strict=True) for one in pair]
    receiver, frames = taken(mixed)
    assert receiver.counters.devices == 2
    for name in ("a", "b"):
        assert [frame.values[0] for frame in frames if frame.device == name] == [
            i % 5 for i in range(100)
        ]
        assert receiver.arrivals[name].kept == 100


def test_devices_are_limited_and_those_that_are_not_wanted_refused():
    flood = [packets(1, f"dev{i}")[0] for i in range(500)]
    receiver, frames = taken(flood + packets(3, "dev0"), most_devices=4)
    assert (receiver.counters.devices, receiver.counters.refused) == (4, 496)
    receiver, frames = taken(flood + packets(5, "glove"), devices=["glove"])
    assert (receiver.counters.refused, len(frames)) == (500, 5)


def test_a_device_is_bound_to_its_address_until_it_is_silent():
    async def run():
        receiver = Receiver(SensorLayout(1, 2, 3, rate=10.0))
        for i in range(3):
            receiver.take(format_packet("a", i / 10, np.ones(6)), i / 10, "10.0.0.1")
            receiver.take(format_packet("a", 5 + i / 10, np.zeros(6)), i / 10, "10.0.0.66")
        # restarted with another address
        receiver.take(format_packet("a", 0.3, np.ones(6)), 20.0, "10.0.0.2")
        receiver.close()
        return receiver.counters, [frame async for frame in receiver]

    counters, frames = asyncio.run(run())
    assert (counters.kept, counters.refused) == (4, 3)
    assert all((frame.values == 1).all() for frame in frames)


def offered(arrivals, **options):
    """Hand (device, time stamp, address, arrival) to a receiver; return it and the frames."""

    async def run():
        receiver = Receiver(SensorLayout(1, 2, 3, rate=10.0), **options)
        for device, stamp, address, now in arrivals:
            receiver.take(
                format_packet(device, stamp, np.ones(6), key=options.get("key")), now, address
            )
        receiver.close()
        return receiver, [frame async for frame in receiver]

    return asyncio.run(run())


def steadily(name, begin, end, each, address="10.0.0.66"):
    """Return arrivals of a name that sends every ``each`` seconds."""
    times = np.arange(begin, end, each)
    return [(name, float(at), address, float(at)) for at in times]


INVENTED = {
    "sixteen names at once": [(f"x{i}", 0.0, "10.0.0.66", 0.0) for i in range(16)],
    "thirty a second": [(f"x{i}", 0.0, "10.0.0.66", i / 30) for i in range(360)],
    "a thousand a second": [(f"x{i}", 0.0, "10.0.0.66", i / 1000) for i in range(12_000)],
    "names that send twice": [
        (f"x{i // 2}", float(i % 2), "10.0.0.66", i / 60) for i in range(720)
    ],
    "sixteen names kept alive": [
        one for i in range(16) for one in steadily(f"x{i}", i / 10, 12.0, 1.9)
    ],
    "its own name, from elsewhere": [
        *((f"x{i}", 0.0, "10.0.0.66", 0.0) for i in range(15)),
        *steadily("robot", 0.05, 12.0, 1.0),
    ],
}


@pytest.mark.parametrize("how", INVENTED)
def test_invented_names_do_not_lock_a_device_out(how):
    robot = steadily("robot", 2.0, 12.0, 0.1, "10.0.0.1")
    arrivals = sorted(INVENTED[how] + robot, key=lambda one: one[3])
    receiver, frames = offered(arrivals, queue=20_000)
    assert sum(frame.device == "robot" for frame in frames) >= 95  # of 100
    counters = receiver.counters
    assert (counters.received, counters.devices) == (len(arrivals), 16)
    assert counters.received == sum(getattr(counters, name) for name in ("kept", *FAULTS))


def test_a_device_that_pauses_while_names_are_invented_is_back_at_once():
    robot = steadily("robot", 0.0, 5.0, 0.1, "10.0.0.1")
    robot += steadily("robot", 12.0, 17.0, 0.1, "10.0.0.1")
    invented = [(f"x{i}", 0.0, "10.0.0.66", 5 + i / 30) for i in range(300)]
    invented += [one for i in range(16) for one in steadily(f"y{i}", 5.05, 17.0, 0.5)]
    _, frames = offered(sorted(robot + invented, key=lambda one: one[3]), queue=5000)
    assert sum(frame.device == "robot" for frame in frames) == 100


def test_devices_that_send_keep_their_places_whoever_comes_and_how_often():
    arrivals = [one for i in range(16) for one in steadily(f"d{i}", 0.003 * i, 20.0, 0.1)]
    late = steadily("late", 0.05, 20.0, 0.02, "10.0.0.9")
    receiver, frames = offered(sorted(arrivals + late, key=lambda one: one[3]), queue=5000)
    assert {frame.device for frame in frames} == {f"d{i}" for i in range(16)}
    assert receiver.counters.refused == len(late)


def test_a_device_that_sends_is_not_evicted():
    arrivals = [("robot", i / 10, "10.0.0.1", i / 10) for i in range(600)]
    arrivals += [(f"invented{i}", 0.0, "10.0.0.66", i / 10 + 0.05) for i in range(600)]
    receiver, _ = offered(sorted(arrivals, key=lambda one: one[3]), queue=1200)
    assert receiver.arrivals["robot"].kept == 600
    assert receiver.counters.received == 1200 == receiver.counters.kept + receiver.counters.refused


def test_a_device_with_a_configured_address_may_send_from_there_only():
    arrivals = [("robot", i / 10, f"10.0.0.{1 + i % 2}", i / 10) for i in range(10)]
    arrivals += [("hand", 0.0, "10.0.0.9", 0.0), ("other", 0.0, "10.0.0.2", 0.0)]
    receiver, frames = offered(arrivals, devices=["robot@10.0.0.2", "hand"])
    assert [frame.device for frame in frames].count("robot") == 5
    assert {frame.device for frame in frames} == {"robot", "hand"}
    assert receiver.counters.refused == 6
    with pytest.raises(ValueError, match="no IP address; expected NAME or NAME@ADDRESS"):
        Receiver(SMALL, devices=["robot@here"])


def test_with_a_key_only_packets_that_are_signed_with_it_arrive_and_none_twice():
    key = b"0123456789abcdef"
    other = b"0123456789abcdeF"
    good = [format_packet("a", i / 10, np.ones(6), key=key) for i in range(20)]
    forged = [
        format_packet("a", 2.0, np.ones(6)),
        format_packet("a", 2.0, np.ones(6), key=other),
        good[3].replace(b",1,", b",2,", 1),
        good[3][:-1],
        good[3].split(b"*")[0] + b"*",
    ]

    async def run():
        receiver = Receiver(SensorLayout(1, 2, 3, rate=10.0), key=key)
        for i, data in enumerate(good):
            receiver.take(data, i / 10)
        for i, data in enumerate(forged + good):  # replayed long after
            receiver.take(data, 1000.0 + i)
        receiver.close()
        return receiver.counters, [frame async for frame in receiver]

    counters, frames = asyncio.run(run())
    assert (len(frames), counters.kept, counters.forged, counters.restarts) == (20, 20, 5, 0)
    assert counters.received == 45 == 20 + 5 + counters.duplicates + counters.late + counters.strays


def test_a_key_is_read_from_a_file_and_a_short_one_refused(tmp_path):
    (tmp_path / "key").write_text("0123456789abcdef0123\n")
    assert read_key(tmp_path / "key") == b"0123456789abcdef0123"
    (tmp_path / "key").write_text("secret")
    with pytest.raises(ValueError, match="a key of 6 bytes, expected 16 or more"):
        read_key(tmp_path / "key")


def test_a_station_that_is_told_to_quit_drops_what_it_has_no_time_for(monkeypatch):
    now = [0.0]
    monkeypatch.setattr("adaptfault.acquisition.station.time.monotonic", lambda: now[0])
    station = Station(SMALL, on_event=lambda event: None, quiet=True)
    # as a slow classifier
    monkeypatch.setattr(station, "_take", lambda frame: now.__setitem__(0, now[0] + 0.1))
    for i, data in enumerate(packets(1000)):
        station.receiver.take(data, i / SMALL.rate)
    station.receiver.close()
    asyncio.run(station._take_all())
    assert now[0] < 1
    assert station.receiver.counters.dropped > 980


def test_when_nobody_fetches_the_oldest_frames_go_and_are_counted():
    receiver, frames = taken(packets(300), queue=100)
    assert (receiver.counters.dropped, receiver.counters.kept) == (200, 100)
    assert [round(frame.time * 1000) for frame in frames] == list(range(200, 300))


def test_whatever_is_sent_every_datagram_is_counted_once():
    generator = np.random.default_rng(3)
    sender = example("esp32_sender")
    values = np.zeros((1000, 6))
    stream = sender.stream(
        values, SMALL.rate, "a", garbage=0.3, loss=0.1, duplicates=0.2, reorder=0.2, seed=3
    )
    datagrams = [data for _, data in stream]
    for i in range(0, len(datagrams), 3):
        if generator.random() < 0.3:
            datagrams[i] = format_packet("a", float(generator.uniform(0, 1e6)), np.zeros(6))
    receiver, _ = taken(datagrams)
    counters = receiver.counters
    assert (
        counters.received
        == len(datagrams)
        == counters.kept + sum(getattr(counters, name) for name in FAULTS)
    )


def test_hostile_datagrams_leave_no_trace_in_memory():
    generator = np.random.default_rng(4)
    hostile = [generator.bytes(int(generator.integers(0, 2000))) for _ in range(100)]
    hostile += [
        b"a,1," + b"9" * 60000,
        b"," * 65000,
        b"a" * 65000,
        b"a,1e999,1,1,1,1,1,1",
        b"a,1,nan,nan,nan,nan,nan,nan",
    ]
    hostile += [format_packet("a", at, np.full(6, 3e38)) for at in (0, 1e12, 5, 1e15, 1e3)]

    async def run():
        receiver = Receiver(SMALL, queue=50, most_devices=3)
        sizes = []
        for round_ in range(3):
            for i in range(1500):
                receiver.take(hostile[i % len(hostile)], i / 100)
                receiver.take(format_packet(f"d{i}", i, np.zeros(6)), i / 100)
            receiver.poll(1e6 + round_)
            sizes.append(tracemalloc.get_traced_memory()[0])
        return sizes

    tracemalloc.start()
    sizes = asyncio.run(run())
    tracemalloc.stop()
    assert sizes[2] - sizes[1] < 20_000


def test_a_port_in_use_is_an_os_error_and_nothing_is_left_open():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("127.0.0.1", 0))

        async def run():
            async with Receiver(SMALL, other.getsockname()[1]):
                pass

        with pytest.raises(OSError, match="in use"):
            asyncio.run(run())


def test_counters_print_only_what_happened():
    assert (
        str(Counters(received=5, kept=4, malformed=1, devices=1))
        == "5 received = 4 kept + 1 malformed; 1 device"
    )
    assert Counters().to_dict()["received"] == 0


def test_packets_that_are_dropped_are_told_when_they_come_and_then_counted_every_10_s():
    heard = []
    receiver = Receiver(SMALL, on_trouble=lambda device, text: heard.append((device, text)))
    for i in range(250):
        receiver.take(b"a,1,2", i / 10, "10.0.0.7")
    receiver.poll(40.0)
    expected = "1 values after device and time stamp, expected 6 (from 10.0.0.7)"
    assert heard == [
        ("", f"a packet is dropped: {expected}"),
        ("", f"100 more packets are dropped, the last: {expected}"),
        ("", f"100 more packets are dropped, the last: {expected}"),
        ("", f"49 more packets are dropped, the last: {expected}"),
    ]
    assert receiver.counters.malformed == 250


def test_devices_beyond_the_limit_are_told_with_what_to_do():
    heard = []
    receiver = Receiver(SMALL, most_devices=2, on_trouble=lambda device, text: heard.append(text))
    for i in range(150):
        for name in ("a", "b", "c", "d"):
            receiver.take(format_packet(name, i / 10, np.ones(6)), i / 10, "10.0.0.7")
    told = "2 devices send, and no more are taken; --device NAME takes the named ones alone"
    assert heard == [
        f"a packet is dropped: {told} (from 10.0.0.7)",
        f"200 more packets are dropped, the last: {told} (from 10.0.0.7)",
    ]
    assert receiver.counters.refused == 300


def test_the_counts_of_the_last_line_add_up_where_frames_were_dropped():
    receiver, _ = taken([*packets(300), b"garbage", b"a" * 60000, *packets(1)], queue=100)
    text = str(receiver.counters)
    total, _, parts = text.partition(";")[0].partition(" received = ")
    assert int(total) == sum(int(part.split()[0]) for part in parts.split(" + ")) == 303
    assert "100 kept + 200 dropped + 1 malformed + 1 oversized" in text
