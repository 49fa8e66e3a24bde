"""Reads the ``metadata.yaml`` of a rosbag2, as far as it can be used: the messages are in the other files."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path, PurePath

from splatam_core.datasets.bag.names import NAME
from splatam_core.datasets.bag.qos import OfferedQos, offered_qos, recorded_qos
from splatam_core.errors import DatasetError
from splatam_core.text_files import parse_yaml, read_text

MAX_BYTES = 2**24  # hundreds of splits and topics take a megabyte


@dataclass(frozen=True, slots=True)
class BagMetadata:
    """What ``metadata.yaml`` states.

    Attributes:
        file_names: the files with the messages.
        num_messages: by topic.
        offered: the QoS of the publishers, by topic; topics without are left out.
        problem: why the file cannot be used; empty if it can.
    """

    file_names: tuple[str, ...] = ()
    num_messages: Mapping[str, int] = field(default_factory=dict)
    offered: Mapping[str, tuple[OfferedQos, ...]] = field(default_factory=dict)
    problem: str = ''


def read_metadata(folder: Path) -> BagMetadata:
    """Read the metadata of a bag; nothing in them is an error, because the files say the same."""
    path = folder / NAME
    if not path.exists():
        return BagMetadata(problem=f'there is no {NAME}, the recording was not closed')
    try:
        content = parse_yaml(read_text(path, DatasetError, MAX_BYTES))['rosbag2_bagfile_information']
        names = tuple(PurePath(name).name for name in content['relative_file_paths'])
        topics = [topic for topic in content.get('topics_with_message_count') or [] if isinstance(topic, dict)]
    except (DatasetError, ValueError, TypeError, KeyError, AttributeError) as error:
        return BagMetadata(problem=f'{NAME} is damaged ({type(error).__name__})')
    num_messages: dict[str, int] = {}
    offered: dict[str, tuple[OfferedQos, ...]] = {}
    for topic in topics:
        described = topic.get('topic_metadata')
        if isinstance(described, dict) and isinstance(name := described.get('name'), str):
            count = topic.get('message_count')
            num_messages[name] = num_messages.get(name, 0) + (count if type(count) is int else 0)
            profiles = recorded_qos(described.get('offered_qos_profiles'))
            offered[name] = offered.get(name, ()) + tuple(map(offered_qos, profiles))
    return BagMetadata(names, num_messages, offered)
