"""adaptfault simulate: writes simulated grasps, healthy or with injected faults."""

from __future__ import annotations

from adaptfault.cli.command import option
from adaptfault.cli.paths import WrittenRecordings
from adaptfault.cli.reading import Array
from adaptfault.cli.selection import Selecting, select


class Simulate(Selecting, Array):
    """Write simulated grasps to try every command with."""

    example = """  adaptfault simulate --out grasps.npz
  adaptfault simulate --shape 10x10 --full-scale 3.3 --unit V --grasps 40 --out skin.npz
  adaptfault simulate --grasps 5 --seed 1 --inject row:0:3=open --out broken.npz"""

    out: WrittenRecordings = option(
        "X.npz, X.npy, X.bag (ROS 2 bag), or a folder for CSV files", "PATH", required=True
    )
    grasps: int = option("recordings of each class (default 40)", "N", default=40)
    frames: int = option("frames of a recording (default 100)", "T", default=100)
    classes: list[str] | None = option("only these classes (default: all seven)", "NAME")
    seed: int = option("of objects, grasps and noise (default 0)", default=0)
    sensor_seed: int = option("of the gain and offset of each cell (default 0)", default=0)

    def run(self) -> int:
        """Simulate and write."""
        from adaptfault.data.recordings import save
        from adaptfault.data.recordings.facts.sizes import MOST_BYTES
        from adaptfault.data.simulated_grasps import CLASS_NAMES, simulate

        layout = self.stated_layout()
        classes = self.classes or CLASS_NAMES
        if (size := 4 * len(classes) * self.grasps * self.frames * layout.n_cells) > MOST_BYTES:
            raise ValueError(
                f"--grasps {self.grasps} --frames {self.frames}: {size:,} bytes, more than"
                f" {MOST_BYTES:,}"
            )
        self.say(f"simulating {self.grasps} grasps of each class on {layout}")
        recordings = simulate(
            self.grasps,
            layout,
            n_frames=self.frames,
            seed=self.seed,
            classes=classes,
            sensor_seed=self.sensor_seed,
        )
        recordings = select(self, recordings)
        for fact in save(self.out, recordings):
            self.say(f"not stored in this format: {fact}")
        result = {
            "schema": "adaptfault.simulate/1",
            "out": self.out,
            "recordings": len(recordings),
            "layout": recordings.layout.to_dict(),
        }
        self.emit(result, f"{len(recordings)} recordings of {recordings.layout}: {self.out}")
        return 0


add = Simulate.add
