"""Starts the node: ``ros2 launch adaptfault_ros tactile.launch.py
bundle:=/home/robot/robot.bundle``."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

PARAMETERS = {
    "topic": ("/tactile", str),
    "topic_type": ("std_msgs/msg/Float32MultiArray", str),
    "field": ("", str),
    "bundle": ("", str),
    "trust": ("", str),
    "restored": ("/tactile/restored", str),
    "scan": ("", str),
    "lines_held": ("false", bool),
    "layout": ("", str),
    "full_scale": ("0.0", float),
    "unit": ("", str),
    "rate": ("0.0", float),
    "name": ("tactile", str),
    "hardware_id": ("tactile", str),
    "autostart": ("true", bool),
}


def generate_launch_description() -> LaunchDescription:
    """Return the node with one launch argument a parameter."""
    arguments = [
        DeclareLaunchArgument(name, default_value=value) for name, (value, _) in PARAMETERS.items()
    ]
    values = {
        name: ParameterValue(LaunchConfiguration(name), value_type=kind)
        for name, (_, kind) in PARAMETERS.items()
    }
    return LaunchDescription(
        [*arguments, Node(package="adaptfault_ros", executable="node", parameters=[values])]
    )
