"""Names the node of ``adaptfault.ros2`` for ``ros2 run adaptfault_ros node``."""

from adaptfault.ros2.__main__ import main

if __name__ == "__main__":
    main()
