"""With which QoS a recorded topic is played: the user's, else the recorded one, else ROS's default."""

from __future__ import annotations

from collections.abc import Mapping
from enum import IntEnum
from pathlib import Path
from typing import Any

import yaml
from rclpy.duration import Duration, Infinite
from rclpy.qos import DurabilityPolicy, HistoryPolicy, LivelinessPolicy, QoSProfile, ReliabilityPolicy
from rosbags.interfaces import Qos, QosHistory, QosTime

from splatam_ros.player.recording import RecordedTopic
from splatam_ros.process import RosError

IMAGE_DEPTH, OTHER_DEPTH = 50, 1000  # messages kept until they are acknowledged
FOREVER_S = 2**31 - 1  # how recorders write an infinite time, or more than that

POLICIES = {
    'history': HistoryPolicy,
    'reliability': ReliabilityPolicy,
    'durability': DurabilityPolicy,
    'liveliness': LivelinessPolicy,
}
DURATIONS = ('deadline', 'lifespan', 'liveliness_lease_duration')
PLAIN = {'depth': int, 'avoid_ros_namespace_conventions': bool}
SAYS_NOTHING = ('SYSTEM_DEFAULT', 'UNKNOWN', 'BEST_AVAILABLE')

Policies = Mapping[str, Any]
"""Arguments of rclpy's ``QoSProfile``."""


def publisher_qos(topic: RecordedTopic, override: Policies, must_arrive: bool) -> QoSProfile:
    """What to offer on a topic.

    Args:
        topic: as recorded. Where its publishers differ, nobody is imitated.
        override: what the user says about it; may be empty.
        must_arrive: offer reliability where best effort was recorded. Every subscriber that takes the one takes
            the other.
    """
    policies = {
        'depth': max(IMAGE_DEPTH if topic.is_image else OTHER_DEPTH, *(qos.depth for qos in topic.offered), 0),
        'reliability': ReliabilityPolicy.RELIABLE,
        'durability': DurabilityPolicy.TRANSIENT_LOCAL if topic.is_latched else DurabilityPolicy.VOLATILE,
        **_recorded(topic),
    }
    if must_arrive:
        policies['reliability'] = ReliabilityPolicy.RELIABLE
    return QoSProfile(**{**policies, **override})


def read_overrides(path: Path) -> dict[str, Policies]:
    """A YAML file that maps topics to QoS policies, as ``ros2 bag play --qos-profile-overrides-path`` takes it.

    Raises:
        RosError: it cannot be read, or says something about a topic that is no QoS.
    """
    try:
        topics = yaml.safe_load(path.read_text())
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise RosError(f'{path}: cannot be read: {error}') from None
    if not isinstance(topics, dict) or not all(isinstance(policies, dict) for policies in topics.values()):
        raise RosError(f"{path}: expected topics with their policies, for example '/tf_static: {{depth: 1}}'")
    return {
        topic: {name: _policy(f'{path}: {topic}: {name}', name, value) for name, value in policies.items()}
        for topic, policies in topics.items()
    }


def _recorded(topic: RecordedTopic) -> dict[str, Any]:
    """What all of a topic's publishers offered, but for history, and for durability, which is the topic's to say."""
    offered = {qos._replace(history=QosHistory.KEEP_LAST, depth=0) for qos in topic.offered}
    return _policies(offered.pop()) if len(offered) == 1 else {}


def _policies(qos: Qos) -> dict[str, Any]:
    stated = {name: _time(getattr(qos, name)) for name in DURATIONS}
    for name in ('reliability', 'liveliness'):
        word = getattr(qos, name).name
        stated[name] = POLICIES[name].__members__.get(word) if word not in SAYS_NOTHING else None
    return {name: value for name, value in stated.items() if value is not None}


def _time(time: QosTime) -> Duration | None:
    """A recorded duration; None where it states none."""
    if time == QosTime(0, 0):
        return None
    return Infinite if time.sec >= FOREVER_S else Duration(seconds=time.sec, nanoseconds=time.nsec)


def _policy(where: str, name: str, value: object) -> Any:
    if name in POLICIES:
        return _choice(where, POLICIES[name], value)
    if name in DURATIONS:
        return _duration(where, value)
    if name not in PLAIN:
        raise RosError(f'{where} is no QoS policy: expected one of {", ".join([*POLICIES, *DURATIONS, *PLAIN])}')
    if type(value) is not PLAIN[name] or value < 0:
        raise RosError(f'{where} = {value!r}: expected {"a whole number" if PLAIN[name] is int else "true or false"}')
    return value


def _duration(where: str, value: object) -> Duration:
    is_time = isinstance(value, dict) and value.keys() <= {'sec', 'nsec'}
    if not is_time or not all(type(part) is int and part >= 0 for part in value.values()):
        raise RosError(f'{where} = {value!r}: expected {{sec: a whole number, nsec: a whole number}}')
    return _time(QosTime(value.get('sec', 0), value.get('nsec', 0))) or Duration()


def _choice(where: str, policy: type[IntEnum], value: object) -> IntEnum:
    words = [word for word in policy.short_keys() if word not in ('unknown', 'best_available')]  # type: ignore
    if value not in words:
        raise RosError(f'{where} = {value!r}: expected one of {", ".join(words)}')
    return policy[str(value).upper()]
