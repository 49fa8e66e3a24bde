"""The QoS with which a recorded topic is played: the user's, else the recorded one, else ROS's default."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from enum import IntEnum
from pathlib import Path
from typing import Any

from rclpy.duration import Duration, Infinite
from rclpy.qos import DurabilityPolicy, HistoryPolicy, LivelinessPolicy, QoSProfile, ReliabilityPolicy

from splatam_core.datasets.bag.qos import INFINITE_NS, OfferedQos
from splatam_core.datasets.bag.recording import RecordedTopic
from splatam_core.text_files import read_yaml
from splatam_ros.process import RosError

IMAGE_DEPTH, OTHER_DEPTH = 50, 1000  # messages kept until they are acknowledged
STATIC_TRANSFORMS = '/tf_static'

POLICIES: Mapping[str, type[IntEnum]] = {
    'history': HistoryPolicy,
    'reliability': ReliabilityPolicy,
    'durability': DurabilityPolicy,
    'liveliness': LivelinessPolicy,
}
DURATIONS = ('deadline', 'lifespan', 'liveliness_lease_duration')
PLAIN = {'depth': int, 'avoid_ros_namespace_conventions': bool}
NOT_IN_FILES = ('unknown', 'best_available')

Policies = Mapping[str, Any]
"""Arguments of rclpy's ``QoSProfile``."""


def is_latched(topic: RecordedTopic) -> bool:
    """Returns True if late subscribers also get the last messages; for ``/tf_static`` that is always expected."""
    if topic.name == STATIC_TRANSFORMS:
        return True
    return bool(topic.offered) and all(qos.durability == 'TRANSIENT_LOCAL' for qos in topic.offered)


def publisher_qos(topic: RecordedTopic, override: Policies, must_arrive: bool) -> QoSProfile:
    """Choose the QoS to offer on a topic.

    Args:
        topic: as recorded. If its publishers offered different policies, the defaults are taken instead of theirs.
        override: the policies that the user sets for this topic; may be empty.
        must_arrive: True to offer reliability even if best effort was recorded. Every subscriber that accepts best
            effort accepts reliability too.
    """
    policies = {
        'depth': max(IMAGE_DEPTH if topic.is_image else OTHER_DEPTH, *(qos.depth for qos in topic.offered), 0),
        'reliability': ReliabilityPolicy.RELIABLE,
        'durability': DurabilityPolicy.TRANSIENT_LOCAL if is_latched(topic) else DurabilityPolicy.VOLATILE,
        **_recorded(topic),
    }
    if must_arrive:
        policies['reliability'] = ReliabilityPolicy.RELIABLE
    return QoSProfile(**{**policies, **override})


def read_overrides(path: Path) -> dict[str, Policies]:
    """Read a YAML file that maps topics to QoS policies, as ``ros2 bag play --qos-profile-overrides-path`` takes it.

    Raises:
        RosError: it cannot be read, or has an entry that is no QoS policy.
    """
    topics = read_yaml(path, RosError)
    if not isinstance(topics, dict) or not all(isinstance(policies, dict) for policies in topics.values()):
        raise RosError(f"{path}: expected topics with their policies, for example '/tf_static: {{depth: 1}}'")
    return {
        topic: {name: _policy(f'{path}: {topic}: {name}', name, value) for name, value in policies.items()}
        for topic, policies in topics.items()
    }


def _recorded(topic: RecordedTopic) -> dict[str, Any]:
    """The policies that all publishers of a topic offered alike, without depth and durability, which depend on the topic."""
    offered = {replace(qos, depth=0) for qos in topic.offered}
    return _policies(offered.pop()) if len(offered) == 1 else {}


def _policies(qos: OfferedQos) -> dict[str, Any]:
    policies = {
        'deadline': _duration(qos.deadline_ns),
        'lifespan': _duration(qos.lifespan_ns),
        'liveliness_lease_duration': _duration(qos.liveliness_lease_duration_ns),
        'reliability': ReliabilityPolicy.__members__.get(qos.reliability or ''),
        'liveliness': LivelinessPolicy.__members__.get(qos.liveliness or ''),
    }
    return {name: value for name, value in policies.items() if value is not None}


def _duration(nanoseconds: int | None) -> Duration | None:
    if nanoseconds is None:
        return None
    return Infinite if nanoseconds >= INFINITE_NS else Duration(nanoseconds=nanoseconds)


def _policy(where: str, name: str, value: Any) -> Any:
    """Check and convert one entry of a file; ``where`` begins the error message."""
    if name in POLICIES:
        return _choice(where, POLICIES[name], value)
    if name in DURATIONS:
        return _stated_duration(where, value)
    if name not in PLAIN:
        raise RosError(f'{where} is no QoS policy: expected one of {", ".join([*POLICIES, *DURATIONS, *PLAIN])}')
    if not (isinstance(value, int) and type(value) is PLAIN[name] and value >= 0):
        raise RosError(f'{where} = {value!r}: expected {"a whole number" if PLAIN[name] is int else "true or false"}')
    return value


def _stated_duration(where: str, value: Any) -> Duration:
    is_time = isinstance(value, dict) and value.keys() <= {'sec', 'nsec'}
    if not is_time or not all(type(part) is int and part >= 0 for part in value.values()):
        raise RosError(f'{where} = {value!r}: expected {{sec: a whole number, nsec: a whole number}}')
    return _duration(value.get('sec', 0) * 1_000_000_000 + value.get('nsec', 0)) or Duration()


def _choice(where: str, policy: type[IntEnum], value: object) -> IntEnum:
    words = [word for word in policy.short_keys() if word not in NOT_IN_FILES]  # type: ignore[attr-defined]  # rclpy's own
    if value not in words:
        raise RosError(f'{where} = {value!r}: expected one of {", ".join(words)}')
    return policy[str(value).upper()]
