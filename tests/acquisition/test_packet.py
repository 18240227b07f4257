"""The paper's packets: what is written is read, and nothing else gets through."""

import numpy as np
import pytest

from adaptfault.acquisition import PacketError, format_packet, parse_packet
from adaptfault.acquisition.packet import longest_packet

rng = np.random.default_rng(0)


def good(cells=220) -> bytes:
    return format_packet("esp32-1", 12.3, np.linspace(0, 5, cells))


def test_what_is_written_is_read_back():
    for ticks, time in ((1000.0, 4321.987), (1e6, 1700000000.123456), (1.0, 77.0)):
        values = rng.uniform(0, 5, 220)
        values[[3, 219]] = np.nan
        packet = parse_packet(
            format_packet("A4:CF:12", time, values, ticks=ticks), 220, ticks=ticks
        )
        assert packet.device == "A4:CF:12"
        assert packet.time == pytest.approx(time, abs=0.5 / ticks)
        np.testing.assert_allclose(packet.values, values, rtol=1e-5)


def test_counts_come_through_exactly():
    counts = rng.integers(0, 65536, 156)
    np.testing.assert_array_equal(parse_packet(format_packet("a", 0, counts), 156).values, counts)


@pytest.mark.parametrize("end", [b"\n", b"\r\n", b",", b",\r\n", b"\0", b" "])
def test_line_ends_and_a_last_comma_do_no_harm(end: bytes):
    np.testing.assert_array_equal(
        parse_packet(good() + end, 220).values, parse_packet(good(), 220).values
    )


@pytest.mark.parametrize(
    ("data", "expected"),
    [
        (b"", "0 values"),
        (b"esp32", "0 values"),
        (b"esp32,1", "0 values after device and time stamp, expected 3"),
        (b"esp32,1,2,3", "2 values"),
        (b"esp32,1,2,3,4,5", "4 values"),
        (b"esp32,1,2,3,4,,", "5 values"),
        (b",1,2,3,4", "device ''"),
        (b"../../etc/passwd,1,2,3,4", "device"),
        (b"..,1,2,3,4", "device"),
        (b"a b,1,2,3,4", "device"),
        (b"x" * 65 + b",1,2,3,4", "device"),
        (b"a\nb,1,2,3,4", "device"),
        (b"esp32,,2,3,4", "'' is not a number"),
        (b"esp32,now,2,3,4", "'now' is not a number"),
        (b"esp32,-1,2,3,4", "time stamp '-1'"),
        (b"esp32,nan,2,3,4", "time stamp 'nan'"),
        (b"esp32,inf,2,3,4", "time stamp 'inf'"),
        (b"esp32,1e30,2,3,4", "time stamp"),
        (b"esp32,1_0,2,3,4", "'1_0' is not a number"),
        (b"esp32,1,2,x,4", "'x' is not a number"),
        (b"esp32,1,2,1_0,4", "'1_0' is not a number"),
        (b"esp32,1,2,inf,4", "infinite or too large"),
        (b"esp32,1,2,-1e39,4", "infinite or too large"),
        (b"esp32,1,2,0x10,4", "'0x10' is not a number"),
        ("esp32,1,2,٣,4".encode(), "not ASCII"),
        (b"\xff\xfe\x00", "not ASCII"),
        (b"esp32,1,2,3," + b"4" * 300, "expected|bytes"),
    ],
)
def test_what_is_no_packet_is_refused_in_one_line(data: bytes, expected: str):
    with pytest.raises(PacketError, match=expected.replace("(", r"\(")) as caught:
        parse_packet(data, 3)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 120


def test_random_bytes_and_damaged_packets_raise_nothing_but_packet_errors():
    data = bytearray(good())
    for _ in range(3000):
        damaged = data.copy()
        for place in rng.integers(0, len(data), 3):
            damaged[place] = rng.integers(0, 256)
        for candidate in (
            bytes(damaged),
            rng.bytes(int(rng.integers(0, 3000))),
            bytes(data[: rng.integers(0, 900)]),
        ):
            try:
                packet = parse_packet(candidate, 220)
            except PacketError:
                continue
            assert packet.values.shape == (220,)
            assert not np.isinf(packet.values).any()


def test_the_longest_packet_is_longer_than_any_that_a_sender_writes():
    assert len(format_packet("x" * 64, 1e15, -rng.uniform(1e-30, 1e-29, 220))) < longest_packet(220)
    oversized = good() + b"0" * longest_packet(220)
    with pytest.raises(PacketError, match="bytes; 220 values take"):
        parse_packet(oversized, 220)


def test_a_name_that_could_not_be_read_back_is_not_sent():
    with pytest.raises(ValueError, match="device 'a,b'"):
        format_packet("a,b", 0, np.zeros(3))
