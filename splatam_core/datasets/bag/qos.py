"""The quality of service (QoS) that a recorded publisher offered, without types of the bag library."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from rosbags.interfaces import Qos, QosTime
from rosbags.rosbag2.metadata import parse_qos

from splatam_core.text_files import parse_yaml

INFINITE_NS = (2**31 - 1) * 1_000_000_000
"""Durations from this one on mean 'infinite': recorders write it, or a longer one."""

UNSPECIFIED = ('SYSTEM_DEFAULT', 'UNKNOWN', 'BEST_AVAILABLE')


@dataclass(frozen=True, slots=True)
class OfferedQos:
    """What one publisher offered. Policies have the names of rclpy's enums; None = not specified in the recording.

    Attributes:
        depth: length of the publisher's queue; 0 where it is not specified.
        reliability: ``RELIABLE`` or ``BEST_EFFORT``.
        durability: ``VOLATILE`` or ``TRANSIENT_LOCAL``.
        liveliness: ``AUTOMATIC``, ``MANUAL_BY_NODE`` or ``MANUAL_BY_TOPIC``.
        deadline_ns: duration; infinite from ``INFINITE_NS`` on.
        lifespan_ns: duration; infinite from ``INFINITE_NS`` on.
        liveliness_lease_duration_ns: duration; infinite from ``INFINITE_NS`` on.
        avoid_ros_namespace_conventions: True if the DDS topic has no ROS prefix.
    """

    depth: int
    reliability: str | None
    durability: str | None
    liveliness: str | None
    deadline_ns: int | None
    lifespan_ns: int | None
    liveliness_lease_duration_ns: int | None
    avoid_ros_namespace_conventions: bool


def recorded_qos(profiles: Any) -> list[Qos]:
    """Returns the profiles of a topic as recorded, a text or a list; none if they are damaged, because messages do without."""
    try:
        return parse_qos(parse_yaml(profiles) if isinstance(profiles, str) else profiles or [])
    except Exception:  # noqa: BLE001 - the library checks little
        return []


def offered_qos(qos: Qos) -> OfferedQos:
    """Translate the bag library's description of a QoS."""
    reliability, durability, liveliness = (
        None if policy.name in UNSPECIFIED else policy.name for policy in (qos.reliability, qos.durability, qos.liveliness)
    )
    return OfferedQos(
        depth=qos.depth,
        reliability=reliability,
        durability=durability,
        liveliness=liveliness,
        deadline_ns=_nanoseconds(qos.deadline),
        lifespan_ns=_nanoseconds(qos.lifespan),
        liveliness_lease_duration_ns=_nanoseconds(qos.liveliness_lease_duration),
        avoid_ros_namespace_conventions=qos.avoid_ros_namespace_conventions,
    )


def _nanoseconds(duration: QosTime) -> int | None:
    """A recorded duration; zero means that none was specified."""
    return min(duration.sec * 1_000_000_000 + duration.nsec, INFINITE_NS) or None
