"""A consumer that only reads frames, behind ``adaptfault listen --relay``: frames lost, and added
latency.

    python examples/relay.py [robot.bundle] [--seconds 5] [--rate 100]

Without a bundle, one is made from simulated grasps (a minute). A sensor with a broken row sends to
the relay, and at the same time to this consumer: the difference of both arrivals is the added
latency. It ends with exit code 1 where a frame is lost, comes twice, or out of order.
"""

import argparse
import select
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

import adaptfault as af
from adaptfault.acquisition import format_packet, parse_packet
from diagnostics import Line, SelfDiagnosis, inject, line_fault


def make_bundle(path: Path) -> af.Bundle:
    """Return a bundle of a briefly trained network."""
    grasps = af.simulate(6, seed=0)
    train, validation, test = af.split(af.make_windows(grasps.frames, grasps.labels, grasps.layout))
    model = af.TactileTransformer(grasps.layout, len(grasps.class_names))
    af.train(model, train, validation, epochs=1)
    diagnoser = SelfDiagnosis(grasps.layout).fit(grasps.frames)
    return af.Bundle.create(
        path, model, af.Adapter(model, train, validation), diagnoser, check=test
    )


def udp() -> socket.socket:
    """Return a socket on a free port of this machine."""
    line = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    line.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4 << 20)
    line.bind(("127.0.0.1", 0))
    return line


def consume(
    relayed: socket.socket, direct: socket.socket, packets: list[bytes], port: int, rate: float
) -> list[dict]:
    """Send packets at a rate, directly and to the relay; return what came on both ways: time stamp
    to arrival."""
    arrivals: dict[socket.socket, list] = {relayed: [], direct: []}
    began = time.perf_counter()
    sent = 0
    last = 0.0
    while sent < len(packets) or time.perf_counter() < last + 2:
        due = began + sent / rate if sent < len(packets) else last + 2
        for line in select.select([relayed, direct], [], [], max(0.0, due - time.perf_counter()))[
            0
        ]:
            data = line.recv(1 << 16)
            now = time.perf_counter()
            arrivals[line].append((int(data.split(b",", 2)[1]), now, data))
        if sent < len(packets) and time.perf_counter() >= due:
            for to in (("127.0.0.1", port), direct.getsockname()):
                relayed.sendto(packets[sent], to)
            sent = sent + 1
            last = time.perf_counter()
        if len(arrivals[relayed]) >= len(packets):
            break
    return [arrivals[relayed], arrivals[direct]]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("bundle", nargs="?")
    parser.add_argument("--seconds", type=float, default=5.0)
    parser.add_argument("--rate", type=float, default=100.0, help="frames per second")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder, udp() as relayed, udp() as direct, udp() as free:
        bundle = (
            af.Bundle.open(args.bundle)
            if args.bundle
            else make_bundle(Path(folder) / "robot.bundle")
        )
        layout = bundle.layout
        frames = bundle.parts.check_windows().x.reshape(-1, layout.n_cells) * layout.full_scale
        frames = np.resize(frames, (round(args.seconds * args.rate), layout.n_cells)).astype(float)
        broken = inject(
            frames, [line_fault(layout, Line(0, "row", layout.rows // 2), "short")], layout
        )
        packets = [format_packet("skin", i / args.rate, frame) for i, frame in enumerate(broken)]
        port = free.getsockname()[1]
        free.close()
        to = "{}:{}".format(*relayed.getsockname())
        command = [
            sys.executable,
            "-m",
            "adaptfault",
            "listen",
            str(bundle.path),
            "--port",
            str(port),
            "--relay",
            to,
        ]
        station = subprocess.Popen(
            [*command, "--frames", str(len(packets)), "--seconds", str(args.seconds + 60)],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        with station:
            while (said := station.stderr.readline()) and not said.startswith("listening"):
                pass
            through, past = consume(relayed, direct, packets, port, args.rate)
            station.terminate()
            out, problems = station.communicate()
    stamps = [stamp for stamp, _, _ in through]
    wanted = [round(1000 * i / args.rate) for i in range(len(packets))]
    arrived = {stamp: at for stamp, at, _ in past}
    added = np.array([at - arrived[stamp] for stamp, at, _ in through if stamp in arrived])
    restored = sum(bool(parse_packet(data, layout.n_cells).restored) for _, _, data in through)
    print(out.rstrip(), problems.rstrip(), sep="\n")
    print(
        f"{len(packets)} frames sent at {args.rate:g} a second, {len(set(wanted) - set(stamps))}"
        " lost"
    )
    print(f"{restored} frames came with restored cells, the others before the broken row was found")
    print(
        f"added latency: median {1e3 * np.median(added):.2f} ms, 99 % within"
        f" {1e3 * np.quantile(added, 0.99):.1f} ms"
    )
    return 0 if stamps == wanted else 1


if __name__ == "__main__":
    sys.exit(main())
