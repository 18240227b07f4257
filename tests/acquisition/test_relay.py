"""adaptfault listen --relay: a consumer that only reads packets gets whole frames, each once and in
order."""

import json
import socket
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from adaptfault.acquisition import FrameRepair, Relay, Station, format_packet, parse_packet
from adaptfault.bundle.versions import Version
from adaptfault.cli import main
from adaptfault.data.calibration import Calibration
from adaptfault.imputation.restorer import Restorer
from diagnostics import Fault, FaultSet, SensorLayout, inject

LAYOUT = SensorLayout(1, 3, 4, full_scale=4000.0, unit="count", rate=100.0)
DEAD = FaultSet((1, 6), 12)


@pytest.fixture(scope="module")
def healthy():
    """Whole counts; each cell is a mixture of three loads."""
    rng = np.random.default_rng(0)
    loads = rng.uniform(0, 1, (400, 3)) @ rng.uniform(0, 1000, (3, 12))
    return np.rint(loads)


@pytest.fixture(scope="module")
def restorer(healthy):
    return Restorer(LAYOUT).fit(healthy)


@pytest.fixture
def consumer():
    """A socket that reads what is sent to it."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as line:
        line.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 20)
        line.bind(("127.0.0.1", 0))
        line.settimeout(10)
        yield line


def address(consumer) -> str:
    return "{}:{}".format(*consumer.getsockname())


def test_a_restored_value_has_a_plus_sign_that_every_reader_of_numbers_ignores():
    data = format_packet("a", 1.0, [1.25, 2.5, 0.0], restored=[False, True, True])
    assert data == b"a,1000,1.25,+2.5,+0"
    packet = parse_packet(data, 3)
    assert packet.restored == (1, 2)
    assert packet.values.tolist() == [float(text) for text in data.decode().split(",")[2:]]
    assert parse_packet(format_packet("a", 1.0, [1.0, np.nan, 1e20]), 3).restored == ()


def test_what_is_not_restored_is_sent_as_it_came_and_the_rest_close_to_the_truth(
    restorer, healthy, consumer
):
    relay = Relay(address(consumer), restorer, DEAD)
    for i, frame in enumerate(healthy[:50]):
        relay.send("a", i / 100, np.where(DEAD.mask, 0, frame), np.where(DEAD.mask, 0, frame))
    relay.close()
    packets = [parse_packet(consumer.recv(1 << 16), 12) for _ in range(50)]
    values = np.array([packet.values for packet in packets])
    np.testing.assert_array_equal(values[:, DEAD.healthy], healthy[:50, DEAD.healthy])
    assert np.abs(values - healthy[:50]).max() < 20
    assert not (values % 1).any()  # as the device, which sends whole numbers
    assert {packet.restored for packet in packets} == {DEAD.cells}
    assert relay.to_dict() == {"to": address(consumer), "sent": 50, "failed": 0, "restored": 50}


def test_fractions_keep_every_digit_and_restored_ones_are_not_rounded(restorer, healthy, consumer):
    relay = Relay(address(consumer), restorer, DEAD)
    frame = healthy[3] + 0.123456789
    relay.send("a", 0.0, frame, frame)
    packet = parse_packet(consumer.recv(1 << 16), 12)
    relay.close()
    np.testing.assert_array_equal(packet.values[DEAD.healthy], frame[DEAD.healthy])
    assert (packet.values[list(DEAD)] % 1).all()


def test_restored_values_come_in_the_unit_of_the_sender(restorer, healthy, consumer):
    raw = np.tile([0.0, 65535.0], (12, 1))
    calibration = Calibration(raw, np.tile([0.0, 4000.0], (12, 1)))
    relay = Relay(address(consumer), restorer, DEAD, calibration=calibration)
    received = np.where(DEAD.mask, 65535, np.rint(healthy[0] * 65535 / 4000))
    relay.send("a", 0.0, received, calibration.apply(received)[0].astype(float))
    packet = parse_packet(consumer.recv(1 << 16), 12)
    relay.close()
    np.testing.assert_array_equal(packet.values[DEAD.healthy], received[DEAD.healthy])
    np.testing.assert_allclose(
        packet.values[list(DEAD)], healthy[0, list(DEAD)] * 65535 / 4000, atol=350
    )


def version(about) -> Version:
    return Version(2, Path("version-2"), LAYOUT, ("a", "b"), 10, DEAD, about)


def test_cells_of_a_replaced_pad_are_sent_as_the_earlier_pad_would_have_read(
    restorer, healthy, consumer
):
    gain = np.ones(12)
    offset = np.zeros(12)
    gain[[0, 6]] = 0.5
    offset[[0, 2]] = 8.0
    relay = Relay(address(consumer), restorer, DEAD)
    received = np.where(DEAD.mask, 0, healthy[5] * gain + offset)
    relay.send(
        "a", 0.0, received, received, version({"gain": gain.tolist(), "offset": offset.tolist()})
    )
    data = consumer.recv(1 << 16)
    relay.close()
    packet = parse_packet(data, 12)
    np.testing.assert_allclose(packet.values[DEAD.healthy], healthy[5, DEAD.healthy], atol=0.5)
    assert np.abs(packet.values - healthy[5]).max() < 20
    assert packet.restored == tuple(DEAD)  # the others were measured


def test_exchanged_cells_are_put_back_before_cells_are_restored(restorer, healthy, consumer):
    source = np.array([3, 1, 2, 0, *range(4, 12)])
    relay = Relay(address(consumer), restorer, DEAD)
    received = np.where(DEAD.mask, 0, healthy[5])[source]  # 0 and 3 exchanged
    relay.send("a", 0.0, received, received, version({"source": source.tolist()}))
    packet = parse_packet(consumer.recv(1 << 16), 12)
    relay.close()
    np.testing.assert_array_equal(packet.values[DEAD.healthy], healthy[5, DEAD.healthy])
    assert np.abs(packet.values - healthy[5]).max() < 20


def test_a_calibration_is_inverted_where_its_tables_rise():
    calibration = Calibration(
        np.array([[0.0, 10, 20], [5, 6, np.nan]]), np.array([[0.0, 1, 4], [0, 8, np.nan]])
    )
    counts = np.array([12.0, 5.25])
    np.testing.assert_allclose(calibration.invert(calibration.apply(counts)[0]), counts, rtol=1e-6)


def test_a_missing_reading_takes_the_last_one_of_its_cell_and_is_marked(restorer, healthy):
    repair = FrameRepair(restorer, FaultSet((), 12))
    gap = healthy[1].copy()
    gap[4] = np.nan
    first, _ = repair(gap)
    assert first[4] == restorer.mean_[4]
    repair(healthy[0])
    whole, restored = repair(gap)
    assert whole[4] == healthy[0, 4]
    assert np.flatnonzero(restored).tolist() == [4]


def test_cells_that_a_monitor_finds_are_restored_besides_the_known_ones(restorer, healthy):
    repair = FrameRepair(restorer, DEAD)
    repair.found(FaultSet((9,), 12))
    assert np.flatnonzero(repair(healthy[0])[1]).tolist() == [1, 6, 9]
    repair.found(FaultSet((), 12))
    assert np.flatnonzero(repair(healthy[0])[1]).tolist() == [1, 6]


def test_a_consumer_that_is_not_there_or_does_not_read_stops_nothing(restorer, healthy, consumer):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as line:
        line.bind(("127.0.0.1", 0))
        nobody = address(line)
    for to in (nobody, address(consumer)):
        relay = Relay(to, restorer, DEAD)
        for i in range(3000):  # more than a socket's buffer holds
            relay.send("a", i / 100, healthy[i % 400], healthy[i % 400])
        relay.close()
        assert relay.relayed.sent + relay.relayed.failed == 3000


@pytest.mark.parametrize(
    "text", ["", "5006", "host:", ":5006", "host:port", "host:0", "host:70000"]
)
def test_an_address_of_another_form_is_refused(text, restorer):
    with pytest.raises(ValueError, match="expected HOST:PORT"):
        Relay(text, restorer, DEAD)


def test_every_frame_is_relayed_once_and_in_order_and_a_cell_that_breaks_is_restored(
    bundle, small_grasps, broken_row, consumer, capsys, monkeypatch, once_bound
):
    layout = bundle.layout
    frames = np.concatenate(small_grasps.frames[60:70]).astype(float)
    broken = inject(frames, [Fault("short", broken_row.cells, onset=100)], layout)
    packets = [format_packet("a", i / layout.rate, frame) for i, frame in enumerate(broken)]
    packets[20:22] = [packets[21], packets[20], packets[20]]  # swapped, and one twice
    told = threading.Event()
    relay_found = Relay.found

    def found(self, device, faulty) -> None:
        relay_found(self, device, faulty)
        if set(broken_row.cells) <= set(faulty):
            told.set()

    def send(port: int) -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as line:
            for i, data in enumerate(packets):
                if i == len(packets) - 100:  # the monitor comes after the relay, and may be slow
                    told.wait(50)
                line.sendto(data, ("127.0.0.1", port))
                time.sleep(0.002)

    sending = once_bound(send)
    options = [
        "--port",
        "0",
        "--relay",
        address(consumer),
        "--frames",
        str(len(frames)),
        "--seconds",
        "60",
    ]
    monkeypatch.setattr(Relay, "found", found)
    assert main(["listen", str(bundle.path), *options, "--json", "--quiet"]) == 0
    sending.join()
    end = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert end["relay"]["sent"] == end["counters"]["kept"] == len(frames)
    relayed = [parse_packet(consumer.recv(1 << 16), layout.n_cells) for _ in frames]
    assert [packet.time for packet in relayed] == [i / layout.rate for i in range(len(frames))]
    assert relayed[99].restored == ()
    assert set(broken_row.cells) <= set(relayed[-1].restored)
    cells = list(broken_row.cells)
    late = np.array([packet.values for packet in relayed[-100:]])
    assert ((late - frames[-100:])[:, cells] ** 2).mean() < 0.2 * (
        (broken - frames)[-100:, cells] ** 2
    ).mean()


def test_frames_are_relayed_before_they_wait_for_the_monitor(made_bundle, consumer):
    station = Station(None, bundle=str(made_bundle), relay=address(consumer), quiet=True)
    d = station.layout.n_cells
    for i in range(3):  # nothing fetches them
        station.receiver.take(format_packet("a", i / station.layout.rate, np.full(d, i + 1.0)), i)
    station._relay.close()
    assert [parse_packet(consumer.recv(1 << 16), d).values[0] for _ in range(3)] == [1, 2, 3]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--relay", "127.0.0.1:5006"], "--relay needs a bundle"),
        (["{bundle}", "--relay", "127.0.0.1"], "expected HOST:PORT"),
        (["{bundle}", "--relay", "127.0.0.1:5005"], "give the consumer another port"),
        (["{bundle}", "--relay", "no.such.host.invalid:5006"], "no.such.host.invalid"),
    ],
)
def test_a_relay_that_cannot_work_is_refused_in_one_line(arguments, message, made_bundle, capsys):
    given = [argument.format(bundle=made_bundle) for argument in arguments]
    assert main(["listen", *given, "--port", "5005", "--quiet"]) == 3
    (line,) = capsys.readouterr().err.splitlines()
    assert message in line
