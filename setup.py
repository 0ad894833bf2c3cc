"""What pyproject.toml cannot say: all packages found, and the firmware's sources beside them."""

from setuptools import find_packages, setup

setup(packages=[*find_packages(include=["station", "station.*"]), "station.firmware"])
