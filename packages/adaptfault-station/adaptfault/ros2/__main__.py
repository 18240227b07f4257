"""Runs the node: ``python -m adaptfault.ros2 --ros-args -p bundle:=/home/robot/robot.bundle``."""

from __future__ import annotations

import signal
import sys
from types import FrameType


def main() -> None:
    """Run the node until it is shut down."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, _end)
    try:
        import rclpy  # noqa: F401
    except ImportError as error:
        mend = (
            "source /opt/ros/<distro>/setup.bash, or on Python 3.11 pip install"
            " 'adaptfault-station[ros2]'"
        )
        print(f"no ROS 2 here ({error}): {mend}", file=sys.stderr)
        sys.exit(3)
    from adaptfault.ros2.node import run

    sys.exit(run(sys.argv))


def _end(number: int, frame: FrameType | None) -> None:
    """End without a traceback: SIGINT and SIGTERM are how a node ends, also while it loads."""
    for one in (signal.SIGINT, signal.SIGTERM):
        signal.signal(one, signal.SIG_IGN)  # it ends already
    sys.exit(0)


if __name__ == "__main__":
    main()
