"""The ROS 2 package of the node in ``adaptfault.ros2``."""
