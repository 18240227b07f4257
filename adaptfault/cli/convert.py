"""adaptfault convert: recordings of any readable format into .npz, .npy, CSV files or a ROS 2
bag."""

from __future__ import annotations

from adaptfault.cli.command import option
from adaptfault.cli.paths import WrittenRecordings
from adaptfault.cli.reading import Reading
from adaptfault.cli.selection import Selecting, select


class Convert(Selecting, Reading):
    """Write recordings in another format, with their layout."""

    example = """\
  adaptfault convert raw/ --shape 10x10 --full-scale 3.3 --unit V --rate 50 --out grasps.npz
      the archive states the layout: no later command needs these options
  adaptfault convert grasps.npz --out grasps-csv --times
  adaptfault convert grasps.npz --take ::5 --inject row:0:3=open --out broken.npz"""

    out: WrittenRecordings = option(
        "X.npz, X.npy, X.bag (ROS 2 bag), or a folder for CSV files", "PATH", required=True
    )
    times: bool = option("CSV files begin with a header and a column time_ms of whole milliseconds")

    def run(self) -> int:
        """Read, select, write."""
        from adaptfault.data.recordings import save

        recordings = select(self, self.load(self.recordings))
        lost = save(self.out, recordings, times=self.times)
        for fact in lost:
            self.say(f"not stored in this format: {fact}")
        result = {
            "schema": "adaptfault.convert/1",
            "out": self.out,
            "recordings": len(recordings),
            "layout": recordings.layout.to_dict(),
            "not_stored": list(lost),
        }
        self.emit(result, f"{len(recordings)} recordings of {recordings.layout}: {self.out}")
        return 0


add = Convert.add
