"""Build of the ROS 2 package: ``colcon build --packages-select adaptfault_ros``."""

from setuptools import setup

NAME = "adaptfault_ros"

setup(
    name=NAME,
    version="0.1.0",
    packages=[NAME],
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        (f"share/{NAME}/launch", ["launch/tactile.launch.py"]),
    ],
    install_requires=["setuptools", "adaptfault-station"],
    zip_safe=True,
    entry_points={"console_scripts": [f"node = {NAME}.node:main"]},
)
