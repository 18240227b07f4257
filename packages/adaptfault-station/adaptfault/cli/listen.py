"""adaptfault listen: monitors, classifies and records frames that sensors send over UDP."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from adaptfault.cli.command import argument, option
from adaptfault.cli.paths import Read, Written, WrittenFolder
from adaptfault.cli.reading import CalibratedArray
from adaptfault.cli.shared_options import Trusting, lines_held_option, metrics_option

if TYPE_CHECKING:
    from adaptfault.acquisition import Station


_WHEN = (
    "always | command (on stdin) | contact or contact:X (cells above X in the array's unit, default"
    " 5 %% of full scale) | HH:MM-HH:MM (local time); default contact"
)
_DEVICE = "listen to this one only, ID or ID@ADDRESS; may be repeated"


def _ticks(text: str) -> float:
    from adaptfault.acquisition.clock import UNITS

    try:
        return UNITS[text] if text in UNITS else float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(
            f"{text!r}: expected {', '.join(UNITS)} or a number of ticks a second"
        ) from None


class Listen(Trusting, CalibratedArray):
    """Monitor, classify and record frames that sensors send over UDP."""

    example = """  adaptfault listen robot.bundle --port 5005 --record today/ --when contact
      packets: device_id,timestamp,one value a cell;
      without a bundle cells are monitored, nothing is classified
  adaptfault listen robot.bundle --port 5005 --relay 127.0.0.1:5006
      a consumer on port 5006 reads whole frames in the same format:
      faulty cells are restored from the healthy ones
  adaptfault listen robot.bundle --port 5005 --view today.mcap
      frames, restored frames, states and faults as adaptfault view writes them;
      --view rerun serves them to: rerun rerun+http://127.0.0.1:9876/proxy
      on stdin: record, stop, auto (as --when states), quit"""

    bundle: Read | None = argument("the robot's bundle, to classify as well", "BUNDLE", nargs="?")
    port: int = option("UDP port; 0 takes a free one and prints it", required=True)
    host: str = option(
        "address to listen on; 0.0.0.0: the whole network (default: this machine only)",
        default="127.0.0.1",
    )
    device: list[str] | None = option(_DEVICE, "ID", action="append")
    key: Read | None = option("accept only packets that are authenticated with this key", "FILE")
    ticks: float = option(
        "unit of the time stamps: s, ms, us, ns, or ticks a second (default ms)",
        "UNIT",
        default=1000.0,
        type=_ticks,
    )
    accumulate: bool = option("tell the class of a whole contact, not of each window; needs BUNDLE")
    sets: float | None = option(
        "tell the set of classes of each window, too, that holds the true one with"
        " probability 1 - ALPHA; needs BUNDLE",
        "ALPHA",
    )
    record: WrittenFolder | None = option("record into this folder, CSV", "FOLDER")
    relay: str | None = option(
        "send repaired packets on; restored values have a plus sign; needs BUNDLE", "HOST:PORT"
    )
    view: Written | None = option(
        "show all frames: FILE.mcap for Foxglove, FILE.rrd for Rerun, or rerun (rerun:PORT)"
        " to serve live viewers of Rerun",
        "FILE",
    )
    when: str | None = option(_WHEN, "WHEN")
    seconds: float | None = option("end after so long", "S")
    frames: int | None = option("end after so many frames", "N")
    metrics: Written | None = metrics_option()
    lines_held: bool = lines_held_option()

    def run(self) -> int:
        """Listen until the end that the options or stdin give; files are closed in any case."""
        import asyncio

        asyncio.run(_station(self).listen())
        return 0


add = Listen.add


def _station(args: Listen) -> Station:
    from adaptfault.acquisition import Station, read_key
    from adaptfault.data.calibration import Calibration

    if args.when and not args.record:
        raise ValueError("--when needs --record FOLDER: it chooses when to record")
    if args.trust and not args.bundle:
        raise ValueError("--trust needs BUNDLE: its signature is checked")
    if args.accumulate and not args.bundle:
        raise ValueError("--accumulate needs BUNDLE: its model classifies the windows")
    if not 0 <= args.port < 65536:
        raise ValueError(f"--port {args.port}: expected 0 to 65535")
    if not 0 < args.ticks < float("inf"):
        raise ValueError(f"--ticks {args.ticks:g}: expected a number above 0")
    for name in ("seconds", "frames"):
        if (end := getattr(args, name)) is not None and not end > 0:
            raise ValueError(f"--{name} {end:g}: expected a number above 0")
    tables = None
    if args.calibration:
        tables = Calibration.read(args.calibration)
    elif args.bundle:
        from adaptfault.bundle.bundle import Bundle

        tables = Bundle.open(args.bundle, **args.trusted()).parts.calibration
    layout = (
        args.stated_layout()
        if tables is None
        else args.stated_layout(full_scale=tables.full_scale, unit="N")
    )
    return Station(
        None if args.bundle else layout,
        args.port,
        bundle=args.bundle,
        **args.trusted(),
        host=args.host,
        devices=args.device,
        ticks=args.ticks,
        key=None if args.key is None else read_key(args.key),
        record=args.record,
        relay=args.relay,
        when=args.when or "contact",
        metrics=args.metrics,
        view=args.view,
        seconds=args.seconds,
        frames=args.frames,
        calibration=tables,
        accumulate=args.accumulate,
        sets=args.sets,
        lines_held=args.lines_held or None,
        as_json=args.json,
        quiet=args.quiet,
    )
