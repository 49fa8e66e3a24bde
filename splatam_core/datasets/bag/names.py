"""The names of a bag's files."""

from __future__ import annotations

from pathlib import Path

NAME = 'metadata.yaml'
SUFFIX = '.zstd'  # of a packed file
ROS1_SUFFIX = '.bag'
ROSBAG2_SUFFIXES = ('.db3', '.mcap')
FILE_ENDINGS = (*ROSBAG2_SUFFIXES, *(f'{suffix}{SUFFIX}' for suffix in ROSBAG2_SUFFIXES))


def storage_files(folder: Path) -> list[str]:
    """Returns the names of the files in a folder that hold messages, sorted."""
    return sorted(file.name for file in folder.iterdir() if file.name.endswith(FILE_ENDINGS) and file.is_file())


def is_bag(path: Path) -> bool:
    """Returns True if a path has the name of a bag or a folder has the files of one; nothing is opened."""
    if path.is_dir():
        return (path / NAME).is_file() or bool(storage_files(path))
    return path.name.endswith((*FILE_ENDINGS, ROS1_SUFFIX)) and path.is_file()
