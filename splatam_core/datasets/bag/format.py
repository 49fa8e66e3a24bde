"""How ROS bags are recognised. ``bag/sequence.py`` reads them; it is imported when one is opened."""

from __future__ import annotations

from pathlib import Path

from splatam_core.datasets.bag.names import is_bag
from splatam_core.datasets.base import Format, ReadOptions, Sequence


def _recognises(source: str) -> bool:
    return is_bag(Path(source))


def _open(source: str, options: ReadOptions) -> Sequence:
    from splatam_core.datasets.bag.sequence import BagSequence  # 6 MB of memory, which folders do not need

    return BagSequence(Path(source), options)


FORMAT = Format(
    'rosbag', 'a rosbag2 folder with metadata.yaml, a .db3 or .mcap file, or a ROS 1 .bag file', _recognises, _open,
    has_topics=True, pairs_by_stamp=True,
)  # fmt: skip
