"""adaptfault info: the content of recordings, and what was inferred about the array."""

from __future__ import annotations

from adaptfault.cli.command import option
from adaptfault.cli.paths import Written
from adaptfault.cli.reading import Reading, report_range


class Info(Reading):
    """Show what is in recordings: shape, range, rate, classes, silent cells."""

    example = """  adaptfault info grasps.npz --picture grasps.png
  adaptfault info today/ --shape 10x10 --full-scale 3.3 --unit V
  adaptfault info today/ --write-layout layout.toml
      with --layout layout.toml, or as layout.toml in the folder, nothing is inferred any more"""

    picture: Written | None = option("write mean and peak of each cell as PNG", "FILE")
    write_layout: Written | None = option(
        "write what was stated and inferred of the array as TOML, for --layout", "FILE"
    )

    def run(self) -> int:
        """Print the summary."""
        from adaptfault.data.summary import summary_of

        opened = self.open(self.recordings)
        summary = summary_of(opened, opened.inferred)
        report_range(opened)
        if self.write_layout:
            from adaptfault.data.recordings.facts.layout_file import write_layout

            write_layout(self.write_layout, opened.layout, opened.inferred)
        if self.picture:
            from adaptfault.data.atomic import atomic_figure

            atomic_figure(self.picture, summary.plot(), dpi=150)
        self.emit(summary.to_dict(), str(summary))
        return 0


add = Info.add
