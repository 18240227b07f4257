"""adaptfault reproduce: the paper's figures and claims, on simulated grasps or on the user's own
recordings."""

from __future__ import annotations

from pathlib import Path

from adaptfault.cli.command import option
from adaptfault.cli.paths import Read, WrittenFolder
from adaptfault.cli.reading import Reading, recordings_option
from adaptfault.cli.shared_options import chosen_device, device_option


class Reproduce(Reading):
    """Repeat the paper's experiments: figures, claims, a page."""

    example = """  adaptfault reproduce --quick
  adaptfault reproduce --figure 6 --recordings grasps.npz --out real
      after a crash the same command continues"""
    one_of = ("quick", "full")
    continues = True

    recordings: list[Read] = recordings_option()
    figure: list[int] | None = option(
        "only this figure of the paper (7: its future work); may be given several times",
        choices=(2, 3, 4, 5, 6, 7),
        action="append",
    )
    quick: bool = option("about 14 minutes on two free cores (default)")
    full: bool = option("as the paper: 50 epochs, 200k samples; for a GPU")
    seeds: list[int] | None = option("default 0 1 2")
    grasps: int | None = option("simulated grasps of each class (default 200)")
    epochs: int | None = option("of the fault-free network")
    samples: list[int] | None = option(
        "windows added in fault-aware training (--quick: 10000)", "N"
    )
    device: str = device_option()
    out: WrittenFolder = option("default adaptfault-paper", "FOLDER", default="adaptfault-paper")

    def run(self) -> int:
        """Measure, draw, write the page."""
        import sys
        from dataclasses import replace

        from adaptfault.paper.settings import Settings

        if self.recordings:
            recordings = self.load(self.recordings, labelled=True)
            source = Path(self.recordings[0]).name
        if self.samples and min(self.samples) < 1:
            raise ValueError(
                f"--samples {min(self.samples)}: fault-aware training adds 1 window or more"
            )
        settings = Settings.full() if self.full else Settings.quick(simulated=not self.recordings)
        settings = replace(
            settings,
            seeds=tuple(self.seeds or settings.seeds),
            grasps=self.grasps or settings.grasps,
            epochs=self.epochs or settings.epochs,
            samples=tuple(sorted(set(self.samples or settings.samples))),
        )
        if not self.recordings:
            from adaptfault.data.simulated_grasps import simulate

            self.say(f"simulating {settings.grasps} grasps of each class")
            recordings = simulate(settings.grasps)
            source = "simulated grasps"
        self.say("loading torch")

        from adaptfault.paper.run import FIGURES, reproduce

        page = reproduce(
            recordings,
            settings,
            Path(self.out),
            figures=tuple(sorted(set(self.figure))) if self.figure else FIGURES,
            source=source,
            command=" ".join(["adaptfault", *sys.argv[1:]]),
            device=chosen_device(self.device),
            progress=self.progress,
            say=self.say,
        )
        self.emit({"schema": "adaptfault.reproduce/1", "page": str(page)}, f"page: {page}")
        return 0


add = Reproduce.add
