"""adaptfault demo: training, faults, diagnosis and repair on simulated grasps or on the user's
recordings."""

from __future__ import annotations

from pathlib import Path

from adaptfault.cli.command import option
from adaptfault.cli.inject_option import INJECT_HELP, parse_faults
from adaptfault.cli.paths import Read, WrittenFolder
from adaptfault.cli.reading import Reading, recordings_option

# The paper has 200 grasps a class and up to 50 epochs at 1e-4. The demo has fewer grasps, a higher
# learning rate and unpadded convolutions, a third of the cost, so that it ends within about a
# minute.
SIMULATED_PER_CLASS = 160
QUICK = {"epochs": 2, "learning_rate": 2e-4, "network": {"padding": "valid", "init": "glorot"}}
_EPOCHS = 20


class Demo(Reading):
    """Train, break the sensor, diagnose, repair, write a report."""

    example = """  adaptfault demo
  adaptfault demo --recordings grasps.npz --epochs 20 --inject random:5=short"""

    recordings: list[Read] = recordings_option()
    out: WrittenFolder = option("default adaptfault-demo", "FOLDER", default="adaptfault-demo")
    epochs: int | None = option("of training (default: 2 simulated, 20 on recordings)")
    seed: int = option("random seed of the whole run (default 0)", default=0)
    inject: list[str] | None = option(INJECT_HELP, "FAULT", action="append")

    def run(self) -> int:
        """Run the demo and write the report."""
        import json

        import numpy as np

        if self.recordings:
            recordings = self.load(self.recordings, labelled=True)
        else:
            from adaptfault.data.simulated_grasps import simulate

            recordings = simulate(SIMULATED_PER_CLASS, seed=self.seed)
        faults = None
        if self.inject:
            faults = parse_faults(self.inject, recordings.layout, np.random.default_rng(self.seed))
        self.say("loading torch")

        from adaptfault.data.atomic import atomic_write
        from adaptfault.evaluation.demo import run_demo
        from adaptfault.evaluation.html_report import write_report

        out = Path(self.out)
        out.mkdir(parents=True, exist_ok=True)
        checkpoint = out / "training.safetensors"
        if checkpoint.exists():
            self.say(f"continuing the training in {checkpoint}")
        result = run_demo(
            recordings,
            faults,
            **({"epochs": _EPOCHS} if self.recordings else QUICK)
            | ({"epochs": self.epochs} if self.epochs else {}),
            seed=self.seed,
            checkpoint=checkpoint,
            progress=self.progress,
            say=(lambda text: self.say(text))
            if self.json
            else lambda text: print(text, flush=True),
        )
        report = write_report(out / "report.html", result)
        checkpoint.unlink(missing_ok=True)
        atomic_write(out / "result.json", json.dumps(result.to_dict(), allow_nan=False).encode())
        if self.json:
            print(json.dumps(result.to_dict(), indent=1, allow_nan=False))
        else:
            print(f"report       {report}")
        return 0


add = Demo.add
