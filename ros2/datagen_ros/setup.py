"""The package datagen_ros, for colcon."""

from pathlib import Path

from setuptools import find_packages, setup

NAME = "datagen_ros"

setup(
    name=NAME,
    version="0.1.0",
    packages=find_packages(),
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        (f"share/{NAME}/launch", [str(file) for file in Path("launch").glob("*.launch.py")]),
        (f"share/{NAME}/config", [str(file) for file in Path("config").glob("*.yaml")]),
    ],
    install_requires=["setuptools"],
    zip_safe=True,
    maintainer="datagen",
    maintainer_email="maintainers@example.org",
    description="Base poses for grasping, from a robot's depth camera, by a running `datagen serve`.",
    license="Apache-2.0",
    entry_points={"console_scripts": ["base_pose_node = datagen_ros.base_pose_node:main"]},
)
