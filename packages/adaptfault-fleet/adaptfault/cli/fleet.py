"""adaptfault fleet: maintains many robots in parallel, reports what the fleet needs and how its
sensors age."""

from __future__ import annotations

import argparse

from adaptfault.cli.command import Command, Commands, argument, option
from adaptfault.cli.paths import Read, Written, WrittenInto, refuse_overwriting, written_into
from adaptfault.cli.shared_options import Signing, metrics_option, sign_option

_REPORT = "report.json"
_PAGE = "report.html"
_OUT = written_into("ledger.jsonl", "run.lock", _REPORT, _PAGE)

_MAINTAIN = """  adaptfault fleet maintain FLEET.toml --jobs 8
      FLEET.toml lists robots as [[robots]] with name, bundle, recordings
      (and tags, commissioned = 2025-03-01),
      or as bundles = "robots/*/robot.bundle" and recordings = "{bundle_dir}/recordings";
      after a crash the same command continues"""

_SURVIVAL = """  adaptfault fleet survival FLEET.toml --picture survival.png
      from the journals of the bundles: how long wires and cells last,
      and whom to service in the next 30 days"""


class Maintain(Signing):
    """Maintain all robots of a list; exit code 2, 3, 1, 0: the worst of them."""

    example = _MAINTAIN
    decides = True
    continues = True

    fleet: Read = argument("list of the robots", "FLEET.toml")
    jobs: int | None = option("worker processes (default: as many as cores)", "N")
    dask: str | None = option("a Dask scheduler whose workers do it, as tcp://host:8786", "ADDRESS")
    dry_run: bool = option("report only, change nothing")
    budget: float | None = option("seconds that one adaptation may take", "S")
    limit: float | None = option(
        "seconds that one robot may take; past it, it is an error (default: none)", "S"
    )
    out: WrittenInto | None = option(
        "of ledger and reports (default: FLEET.fleet)", "FOLDER", type=_OUT
    )
    metrics: Written | None = metrics_option()
    sign: Read | None = sign_option("each bundle after its run", last=True)

    def run(self) -> int:
        """Maintain; the exit code is that of the worst robot."""
        import json
        from pathlib import Path

        from adaptfault.data.atomic import atomic_write
        from adaptfault.fleet.listing import Fleet
        from adaptfault.fleet.run import maintain_fleet

        fleet = Fleet.read(self.fleet)
        if not self.out:
            self.out = _OUT(Path(self.fleet).with_suffix(".fleet"))
        refuse_overwriting(self, fleet.paths())
        folder = Path(self.out)
        report = maintain_fleet(
            fleet,
            folder,
            jobs=self.jobs,
            dask=self.dask,
            dry_run=self.dry_run,
            budget=self.budget,
            limit=self.limit,
            **self.trusted(),
            sign=self.sign,
            progress=self.progress,
        )
        atomic_write(
            folder / _REPORT, json.dumps(report.to_dict(), indent=1, allow_nan=False).encode()
        )
        if self.metrics:
            from adaptfault.robot.metrics import write_metrics

            write_metrics(self.metrics, report.metrics())
        page = report.write_page(folder / _PAGE)
        self.say(f"report: {page}")
        self.emit(report.to_dict(), str(report))
        return report.exit_code


class Survival(Command):
    """How long wires and cells last, and whom to service next."""

    example = _SURVIVAL

    fleet: Read = argument("list of the robots", "FLEET.toml")
    days: float = option("time ahead (default 30)", "N", default=30.0)
    picture: Written | None = option("write the survival curves as PNG", "FILE")

    def run(self) -> int:
        """Tell how the sensors of a fleet age."""
        from adaptfault.data.atomic import atomic_figure
        from adaptfault.fleet.listing import Fleet
        from adaptfault.prognosis.lifetimes import FleetSurvival

        fleet = Fleet.read(self.fleet)
        refuse_overwriting(self, fleet.paths())
        found = FleetSurvival.of(fleet, self.days)
        if self.picture:
            atomic_figure(self.picture, found.plot(), dpi=150)
        self.emit(found.to_dict(), str(found))
        return 0


def add(commands: Commands) -> None:
    """Add the command."""
    group = commands.add_parser(
        "fleet",
        help="maintain many robots",
        description="Maintain many robots.",
        epilog=f"example:\n{_MAINTAIN}\n{_SURVIVAL}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    inner = group.add_subparsers(dest="fleet_command", required=True, metavar="COMMAND")
    Maintain.add(inner)
    Survival.add(inner)
