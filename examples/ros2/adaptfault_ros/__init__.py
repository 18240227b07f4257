"""ROS 2 node that publishes the diagnosis of a tactile array."""
