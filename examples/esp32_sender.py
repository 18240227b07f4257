"""Plays a recording over UDP as the paper's ESP32 does (Section II), and as badly as Wi-Fi and
strangers can.

    python examples/esp32_sender.py [RECORDING] [--port 5005] [--loss 0.01] [--garbage 0.1] ...

Without a recording it plays a simulated grasp: `adaptfault listen --port 5005` in another terminal
shows it arrive.
"""

import argparse
import socket
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass

import numpy as np

from adaptfault.acquisition import PacketError, format_packet, parse_packet, read_key


@dataclass
class Sent:
    """What was sent: ``packets`` = ``good`` + ``garbage`` + ``duplicates``."""

    packets: int = 0
    good: int = 0
    garbage: int = 0
    duplicates: int = 0
    lost: int = 0


def stream(
    frames: np.ndarray,
    rate: float,
    device: str,
    *,
    loss: float = 0.0,
    reorder: float = 0.0,
    duplicates: float = 0.0,
    garbage: float = 0.0,
    seed: int = 0,
    start: float = 0.0,
    key: bytes | None = None,
) -> Iterator[tuple[str, bytes]]:
    """Yield ("good" | "garbage" | "duplicates" | "lost", datagram) for each frame of ``[T, D]``,
    with mischief between.

    Args:
        frames, rate, device: what is played; time stamps are milliseconds from ``start`` (seconds)
        on. loss, duplicates, garbage: shares; ``reorder``: share of neighbours that change places.
        seed: of the mischief.
        start: see above.
        key: authenticates the packets.
    """
    rng = np.random.default_rng(seed)
    waiting: bytes | None = None
    for i, frame in enumerate(frames):
        packet = format_packet(device, start + i / rate, frame, key=key)
        while rng.random() < garbage:
            yield "garbage", rubbish(packet, len(frame), rng)
        if rng.random() < loss:
            yield "lost", packet
            continue
        if waiting is None and i > 0 and rng.random() < reorder:
            waiting = packet
            continue
        yield "good", packet
        if rng.random() < duplicates:
            yield "duplicates", packet
        if waiting is not None:
            yield "good", waiting
            waiting = None
    if waiting is not None:
        yield "good", waiting


def rubbish(packet: bytes, n_cells: int, rng: np.random.Generator) -> bytes:
    """Return a datagram that is no packet of this array."""
    while True:
        cut = int(rng.integers(1, len(packet)))
        kinds = (
            rng.bytes(int(rng.integers(0, 2000))),
            packet[:cut],  # cut off
            packet[:cut] + rng.bytes(8) + packet[cut:],  # damaged
            packet + b",1.0" * int(rng.integers(1, 50)),  # of another array
            b"a" * 60000,  # oversized
            packet.replace(b",", b";"),
        )
        data = kinds[rng.integers(len(kinds))]
        try:
            parse_packet(data, n_cells)
        except PacketError:
            return data


def send(packets: Iterator[tuple[str, bytes]], host: str, port: int, rate: float) -> Sent:
    """Send packets, ``rate`` a second; return what was sent."""
    sent = Sent()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as line:
        line.connect((host, port))
        began = time.perf_counter()
        for kind, data in packets:
            setattr(sent, kind, getattr(sent, kind) + 1)
            if kind == "lost":
                continue
            wait = began + sent.packets / rate - time.perf_counter()
            if wait > 0:
                time.sleep(wait)
            try:
                line.send(data)
            except ConnectionRefusedError:  # nobody listens yet: an ESP32 would not care
                line.send(data)
            sent.packets += 1
    return sent


def recording(path: str | None, frames: int | None) -> tuple[np.ndarray, float]:
    """Return frames ``[T, D]``, repeated until there are enough, and their rate."""
    if path is None:
        from adaptfault import simulate

        recordings = simulate(1, seed=0)
    else:
        from adaptfault import load

        recordings = load(path).recordings
    played = np.concatenate(recordings.frames[:20])
    wanted = len(played) if frames is None else frames
    return np.tile(played, (-(-wanted // len(played)), 1))[:wanted], recordings.layout.rate


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("recording", nargs="?", help=".npz, .csv, ...; without: a simulated grasp")
    parser.add_argument("--host", default="127.0.0.1")
    parser.add_argument("--port", type=int, default=5005)
    parser.add_argument("--device", default="esp32-1")
    parser.add_argument("--frames", type=int, default=100, help="how many (default 100)")
    parser.add_argument(
        "--rate", type=float, default=100.0, help="packets per second (default 100; the ESP32: 10)"
    )
    for name in ("loss", "reorder", "duplicates", "garbage"):
        parser.add_argument(f"--{name}", type=float, default=0.0, help="share of the packets")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--key", help="file with the key that authenticates the packets")
    args = parser.parse_args()
    frames, rate = recording(args.recording, args.frames)
    mischief = {
        name: getattr(args, name) for name in ("loss", "reorder", "duplicates", "garbage", "seed")
    }
    key = None if args.key is None else read_key(args.key)
    start = 0.0 if key is None else time.time()  # never goes back, so that replays are refused
    sent = send(
        stream(frames, rate, args.device, start=start, key=key, **mischief),
        args.host,
        args.port,
        args.rate,
    )
    print(
        f"{args.host}:{args.port}:",
        ", ".join(f"{count} {name}" for name, count in asdict(sent).items()),
    )


if __name__ == "__main__":
    main()
