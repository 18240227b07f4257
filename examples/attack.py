"""Attacks a bundle, the readers of recordings and the receiver, and prints what held: attack.py
[--small]

One table: the attack, how often it was tried, how often it held. A damaged bundle holds when it
predicts as before or is refused with one line; a malformed recording when it is read or refused;
packets when every valid one arrives.
"""

from __future__ import annotations

import argparse
import asyncio
import io
import logging
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import redirect_stdout
from pathlib import Path
from unittest import mock

import numpy as np
import power_cut
from esp32_sender import rubbish

import adaptfault as af
from adaptfault.acquisition import Receiver, format_packet
from adaptfault.data.recordings import save_npz
from diagnostics import SensorLayout

Outcome = Iterator[bool]  # whether it held, for each attempt


def damaged(data: bytes, rng: np.random.Generator) -> bytes:
    """Return the content with a flipped bit, cut off, with zeros at its end, or with bytes
    inserted."""
    at = int(rng.integers(len(data)))
    flipped = bytearray(data)
    flipped[at] ^= 1 << int(rng.integers(8))
    return (
        bytes(flipped),
        data[:at],
        data[:at] + bytes(len(data) - at),
        data[:at] + rng.bytes(9) + data[at:],
    )[rng.integers(4)]


def bundles(count: int, home: Path, rng: np.random.Generator) -> Outcome:
    """Damage a file of the bundle; one that is refused has to say so in one line."""
    with power_cut.small_versions(), mock.patch.object(os, "fsync", return_value=None):
        whole = power_cut.make(home)
        x = whole.parts.check_windows().x
        expected = af.Predictor.load(whole.path).predict(x)
        files = [
            path for path in sorted(whole.path.rglob("*")) if path.is_file() and path.stat().st_size
        ]
        for _ in range(count):
            path = files[rng.integers(len(files))]
            with tempfile.TemporaryDirectory(dir=home) as place:
                copy = Path(place) / "copy.bundle"
                shutil.copytree(whole.path, copy)
                (copy / path.relative_to(whole.path)).write_bytes(damaged(path.read_bytes(), rng))
                yield held(lambda copy=copy: (af.Predictor.load(copy).predict(x) == expected).all())


def recordings(count: int, home: Path, rng: np.random.Generator) -> Outcome:
    """Damage a recording; it is read in part or refused."""
    layout = SensorLayout(1, 2, 3)
    frames = rng.uniform(0, 5, (50, 6)).astype(np.float32)
    save_npz(home / "a.npz", af.Recordings((frames,), layout))
    np.savetxt(home / "a.csv", frames, delimiter=",", fmt="%.4f")
    for i in range(count):
        name = ("a.npz", "a.csv")[i % 2]
        (home / "bad").mkdir(exist_ok=True)
        (home / "bad" / name).write_bytes(damaged((home / name).read_bytes(), rng))
        yield held(
            lambda name=name: len(af.load(home / "bad" / name, layout=layout).recordings.frames) > 0
        )


def packets(count: int, home: Path, rng: np.random.Generator) -> Outcome:
    """Send what is no packet; each valid packet between arrives."""
    receiver = Receiver(SensorLayout(1, 2, 3), queue=count)
    for i in range(count):
        packet = format_packet("robot", i / 10, np.ones(6))
        receiver.take(rubbish(packet, 6, rng), i / 10, "10.0.0.66")
        receiver.take(packet, i / 10, "10.0.0.1")
        yield receiver.counters.kept == i + 1


def names(count: int, home: Path, rng: np.random.Generator) -> Outcome:
    """Invent device names; the robot that comes after them is received within 3 s."""
    for _ in range(count):
        receiver = Receiver(SensorLayout(1, 2, 3))
        for i in range(16):
            receiver.take(format_packet(f"invented{i}", 0, np.ones(6)), 0.0, "10.0.0.66")
        for i in range(31):
            receiver.take(format_packet("robot", i / 10, np.ones(6)), i / 10, "10.0.0.1")
        yield receiver.arrivals["robot"].kept > 0


def replays(count: int, home: Path, rng: np.random.Generator) -> Outcome:
    """Replay old packets from the device's own address while it sends; none is taken for a
    restart."""
    receiver = Receiver(SensorLayout(1, 2, 3), queue=count + 100)
    for i in range(count + 100):
        now = i / 10
        receiver.take(format_packet("robot", 1000 + i / 10, np.ones(6)), now, "10.0.0.1")
        if i >= 100:
            for old in (i - 100, i - 99, i - 98):
                receiver.take(format_packet("robot", 1000 + old / 10, np.ones(6)), now, "10.0.0.1")
            yield receiver.counters.restarts == 0 and receiver.counters.kept == i + 1


def storms(count: int, home: Path, rng: np.random.Generator) -> Outcome:
    """Send as fast as the machine can; the receiver ends within a second."""
    import socket
    import threading

    async def one() -> float:
        stop = threading.Event()

        def storm(port: int) -> None:
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as line:
                i = 0
                while not stop.is_set():
                    line.sendto(format_packet("robot", i / 10, np.ones(6)), ("127.0.0.1", port))
                    i += 1

        station = af.Station(
            SensorLayout(1, 2, 3), on_event=lambda event: None, quiet=True, seconds=0.3
        )
        listening = asyncio.create_task(station.listen())
        while not station.receiver.port:
            await asyncio.sleep(0.01)
        sender = threading.Thread(target=storm, args=(station.receiver.port,))
        sender.start()
        while not station.receiver.closed:
            await asyncio.sleep(0.01)
        began = time.perf_counter()
        await listening
        took = time.perf_counter() - began
        stop.set()
        sender.join()
        return took

    for _ in range(count):
        with redirect_stdout(io.StringIO()):
            took = asyncio.run(one())
        yield took < 1


def kills(count: int, home: Path, rng: np.random.Generator) -> Outcome:
    """Kill maintenance with kill -9, see kill_maintenance.py."""
    script = Path(__file__).with_name("kill_maintenance.py")
    done = subprocess.run(
        [sys.executable, script, "--kills", str(count)], capture_output=True, check=False
    )
    yield from [done.returncode == 0] * count


def power_cuts(count: int, home: Path, rng: np.random.Generator) -> Outcome:
    """Cut the power, see power_cut.py; 0 tries every state."""
    tried, wrong = power_cut.run(sample=count or None, home=home, say=lambda text: None)
    yield from [False] * len(wrong) + [True] * (tried - len(wrong))


def held(call: Callable[[], object]) -> bool:
    """Return whether a call gives what is right, or is refused with one line."""
    try:
        return bool(call())
    except (ValueError, FileNotFoundError) as error:
        return "\n" not in str(error)
    except Exception:
        return False


# The attack, how often it is tried, and how often with --small.
ATTACKS: dict[str, tuple[Callable[[int, Path, np.random.Generator], Outcome], int, int]] = {
    "damaged bundle": (bundles, 1000, 8),
    "malformed recording": (recordings, 5000, 40),
    "malformed packet": (packets, 20_000, 200),
    "16 invented device names": (names, 100, 2),
    "replayed packets": (replays, 5000, 50),
    "quitting in a packet storm": (storms, 10, 1),
    "kill -9 during maintenance": (kills, 20, 0),
    "power cut": (power_cuts, 0, 2),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--small", action="store_true", help="a few of each, and no kills")
    args = parser.parse_args()
    logging.getLogger("adaptfault").setLevel(logging.ERROR)
    failed = 0
    print(f"{'attack':28} {'tried':>7} {'held':>7}")
    for name, (attack, many, few) in ATTACKS.items():
        if args.small and not few:
            continue
        with tempfile.TemporaryDirectory() as home:
            outcomes = list(
                attack(few if args.small else many, Path(home), np.random.default_rng(0))
            )
        failed += outcomes.count(False)
        print(f"{name:28} {len(outcomes):7} {outcomes.count(True):7}", flush=True)
    raise SystemExit(failed > 0)


if __name__ == "__main__":
    main()
