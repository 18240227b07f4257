"""adaptfault selftest: the fewest recordings of the robot's repertoire that test its skin."""

from __future__ import annotations

import json

from adaptfault.cli.command import argument, option
from adaptfault.cli.paths import Read, Written
from adaptfault.cli.reading import Reading
from adaptfault.cli.shared_options import Trusting


class SelfTest(Trusting, Reading):
    """Choose the fewest recordings whose repetition tests the cells that matter."""

    example = """\
  adaptfault selftest robot.bundle grasps/ --number 4 --out routine.json
      the four recordings whose repetition tests most of what matters for the accuracy
  adaptfault selftest robot.bundle grasps/ --seconds 20"""

    bundle: Read = argument("folder that the robot carries", "BUNDLE")
    number: int | None = option("largest number of recordings (default: as needed)", "N")
    seconds: float | None = option("longest time of all of them", "S")
    out: Written | None = option("write the routine as JSON", "FILE")

    def run(self) -> int:
        """Plan the routine."""
        from adaptfault.cli.trained_model import open_bundle
        from adaptfault.data.atomic import atomic_write
        from adaptfault.robot.selftest import plan_selftest

        bundle = open_bundle(self, self.bundle)
        assert bundle is not None  # the path was checked
        repertoire = self.load(self.recordings, layout=bundle.layout)
        routine = plan_selftest(bundle, repertoire, seconds=self.seconds, n=self.number)
        if self.out:
            atomic_write(self.out, json.dumps(routine.to_dict(), allow_nan=False).encode())
        self.emit(routine.to_dict(), str(routine))
        return 0


add = SelfTest.add
