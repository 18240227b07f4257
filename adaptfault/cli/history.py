"""adaptfault history: lists the maintenance runs and versions of a robot, and what drifts over
them."""

from __future__ import annotations

from typing import Any

from adaptfault.cli.command import option
from adaptfault.cli.paths import Read, Written
from adaptfault.cli.shared_options import Trusting, bundle_argument


class History(Trusting):
    """List maintenance runs and versions."""

    example = """  adaptfault history robot.bundle --last 10
  adaptfault history robot.bundle --confirm
      ends the probation of the version that runs
  adaptfault history robot.bundle --trend --picture trend.png
      cells and lines whose gain, offset, noise or blinks drift, and when they cross their limits"""

    bundle: Read = bundle_argument()
    last: int | None = option("only the last N entries", "N")
    confirm: bool = option("end the probation of the version that runs")
    trend: bool = option("what drifts from run to run, in place of the runs")
    picture: Written | None = option("with --trend: write the drifting series as PNG", "FILE")

    def run(self) -> int:
        """List runs and versions."""
        from adaptfault.bundle.pointer import Pointer

        bundle = self.opened(self.bundle)
        if self.picture and not self.trend:
            raise ValueError("--picture shows trends: give --trend, too")
        if self.confirm:
            bundle.confirm()
        if self.trend:
            from adaptfault.prognosis.cell_condition import AgeingTable

            report = AgeingTable.of(bundle).report()
            if self.picture:
                report.write_picture(self.picture)
            self.emit(report.to_dict(), str(report))
            return 0
        pointer = Pointer.read(bundle.path)
        runs = bundle.journal.runs(self.last)
        problems = bundle.problems(repair=False)
        result = {
            "schema": "adaptfault.history/1",
            "version": bundle.active().number,
            "probation": pointer.probation,
            "versions": bundle.versions.numbers,
            "runs": runs,
            "problems": problems,
        }
        state = f", on probation, started {pointer.starts} times" if pointer.probation else ""
        lines = [f"{bundle.active()} runs{state}", *(line(run) for run in runs)]
        self.emit(result, "\n".join([*lines, *(f"damage: {problem}" for problem in problems)]))
        return 0


add = History.add


def line(run: dict[str, Any]) -> str:
    """Return one line of text for a run."""
    about = {
        "confirmed": lambda: f"version {run['version']}",
        "rollback": lambda: f"version {run['from']} -> {run['to']}: {run['reason']}",
    }
    text = about.get(run["what"], lambda: f"version {run['version']}: {run['reason']}")()
    return f"{run['time']}  {run['what']:10s} {text}"
