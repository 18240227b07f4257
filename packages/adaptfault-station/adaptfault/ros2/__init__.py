"""The ROS 2 node: ``python -m adaptfault.ros2`` monitors a topic of tactile frames and publishes
restored ones."""
