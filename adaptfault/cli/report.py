"""adaptfault report: the technician's page about a robot's skin."""

from __future__ import annotations

from adaptfault.cli.command import option
from adaptfault.cli.paths import Read, WrittenFolder
from adaptfault.cli.shared_options import Trusting, bundle_argument, count_from_option


class Report(Trusting):
    """Write the technician's report: what is broken, what to check."""

    example = "  adaptfault report robot.bundle --out report.html"

    bundle: Read = bundle_argument()
    out: WrittenFolder = option("default report.html", "FILE", default="report.html")
    name: str | None = option("of the robot (default: of the bundle or its folder)", "NAME")
    count_from: int = count_from_option()

    def run(self) -> int:
        """Write the page."""
        from adaptfault.robot.technician_report import write_report

        bundle = self.opened(self.bundle)
        path = write_report(self.out, bundle, name=self.name, count_from=self.count_from)
        self.emit({"schema": "adaptfault.report/1", "report": str(path)}, f"report: {path}")
        return 0


add = Report.add
