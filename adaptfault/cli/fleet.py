"""adaptfault fleet: maintains many robots in parallel, reports what the fleet needs and how its
sensors age."""

from __future__ import annotations

import argparse

from adaptfault.cli.options import (
    Commands,
    add_metrics,
    add_sign,
    add_trust,
    command,
    emit,
    progress,
    say,
    trust,
)
from adaptfault.cli.paths import Read, Written, refuse_overwriting, written_into

_REPORT = "report.json"
_PAGE = "report.html"
_OUT = written_into("ledger.jsonl", "run.lock", _REPORT, _PAGE)

_EXAMPLE = """  adaptfault fleet maintain FLEET.toml --jobs 8
      FLEET.toml lists robots as [[robots]] with name, bundle, recordings
      (and tags, commissioned = 2025-03-01),
      or as bundles = "robots/*/robot.bundle" and recordings = "{bundle_dir}/recordings";
      after a crash the same command continues"""

_SURVIVAL = """  adaptfault fleet survival FLEET.toml --picture survival.png
      from the journals of the bundles: how long wires and cells last,
      and whom to service in the next 30 days"""


def add(commands: Commands) -> None:
    """Add the command."""
    group = commands.add_parser(
        "fleet",
        help="maintain many robots",
        description="Maintain many robots.",
        epilog=f"example:\n{_EXAMPLE}\n{_SURVIVAL}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    inner = group.add_subparsers(dest="fleet_command", required=True, metavar="COMMAND")
    parser = command(
        inner,
        "maintain",
        "maintain all robots of a list; exit code 2, 3, 1, 0: the worst of them",
        _EXAMPLE,
    )
    parser.add_argument("fleet", type=Read, metavar="FLEET.toml", help="list of the robots")
    parser.add_argument(
        "--jobs", type=int, metavar="N", help="worker processes (default: as many as cores)"
    )
    parser.add_argument(
        "--dask", metavar="ADDRESS", help="a Dask scheduler whose workers do it, as tcp://host:8786"
    )
    parser.add_argument("--dry-run", action="store_true", help="report only, change nothing")
    parser.add_argument(
        "--budget", type=float, metavar="S", help="seconds that one adaptation may take"
    )
    parser.add_argument(
        "--limit",
        type=float,
        metavar="S",
        help="seconds that one robot may take; past it, it is an error (default: none)",
    )
    parser.add_argument(
        "--out",
        type=_OUT,
        metavar="FOLDER",
        help="of ledger and reports (default: FLEET.fleet)",
    )
    add_metrics(parser)
    add_trust(parser)
    add_sign(parser, "each bundle after its run")
    parser.set_defaults(run=run, decides=True, continues=True)
    parser = command(
        inner, "survival", "how long wires and cells last, and whom to service next", _SURVIVAL
    )
    parser.add_argument("fleet", type=Read, metavar="FLEET.toml", help="list of the robots")
    parser.add_argument(
        "--days", type=float, default=30.0, metavar="N", help="time ahead (default 30)"
    )
    parser.add_argument(
        "--picture", type=Written, metavar="FILE", help="write the survival curves as PNG"
    )
    parser.set_defaults(run=survival)


def run(args: argparse.Namespace) -> int:
    """Maintain; the exit code is that of the worst robot."""
    import json
    from pathlib import Path

    from adaptfault.data.atomic import atomic_write
    from adaptfault.fleet.listing import Fleet
    from adaptfault.fleet.run import maintain_fleet

    fleet = Fleet.read(args.fleet)
    if not args.out:
        args.out = _OUT(Path(args.fleet).with_suffix(".fleet"))
    refuse_overwriting(args, fleet.paths())
    folder = Path(args.out)
    report = maintain_fleet(
        fleet,
        folder,
        jobs=args.jobs,
        dask=args.dask,
        dry_run=args.dry_run,
        budget=args.budget,
        limit=args.limit,
        **trust(args),
        sign=args.sign,
        progress=progress(args),
    )
    atomic_write(folder / _REPORT, json.dumps(report.to_dict(), indent=1, allow_nan=False).encode())
    if args.metrics:
        from adaptfault.robot.metrics import write_metrics

        write_metrics(args.metrics, report.metrics())
    page = report.write_page(folder / _PAGE)
    say(args, f"report: {page}")
    emit(args, report.to_dict(), str(report))
    return report.exit_code


def survival(args: argparse.Namespace) -> int:
    """Tell how the sensors of a fleet age."""
    from adaptfault.data.atomic import atomic_figure
    from adaptfault.fleet.listing import Fleet
    from adaptfault.prognosis.lifetimes import FleetSurvival

    fleet = Fleet.read(args.fleet)
    refuse_overwriting(args, fleet.paths())
    found = FleetSurvival.of(fleet, args.days)
    if args.picture:
        atomic_figure(args.picture, found.plot(), dpi=150)
    emit(args, found.to_dict(), str(found))
    return 0
