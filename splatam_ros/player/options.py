"""How to play a recording: the command line, resolved against what the recording holds."""

from __future__ import annotations

import argparse
import re
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass

from splatam_core.datasets.bag.recording import Recording
from splatam_core.datasets.bag.typestore import IMAGES
from splatam_ros.player.offered_qos import Policies, read_overrides
from splatam_ros.player.playable import PlayableTopics
from splatam_ros.process import RosError

LONG_SILENCE_NS = 24 * 3600 * 10**9  # from the first message to the first image
ANSWER_TOPICS = ('/splatam/pose', '/splatam/processed')
"""Where ``splatam_node`` answers frames: those that get a pose, and those that get none."""


@dataclass(frozen=True, slots=True)
class Options:
    """How to play.

    Attributes:
        topics: names of the topics to play, as recorded.
        remap: from recorded names to names on the graph.
        qos: by recorded name, the QoS policies that the user sets.
        must_arrive: True to offer reliability even if best effort was recorded.
        start_ns: recording time at which to start.
        end_ns: recording time at which to stop, inclusive.
        rate: recording seconds per wall second; None = as fast as the listeners allow.
        delay_s: wall time before the first message, in every loop.
        loop: True to start over at the end.
        clock_hz: rate at which to publish ``/clock``; None = not periodically.
        clock_topics: recorded topics before whose messages ``/clock`` is published.
        start_paused: True to wait for a key or a service before the first message.
        read_ahead: largest number of messages to read before they are due.
        wait_for: topics that answer frames. The first must exist, the others need not. Empty = the transport's
            acknowledgements answer.
        max_ahead: number of frames that may be published beyond the newest answer.
        wait_timeout_s: longest wait for an answer.
        acknowledge_timeout_s: longest wait, at the end, until subscribers have received everything.
        wait_for_subscribers: True to wait until the images have subscribers, and to stop when these leave.
        discovery_timeout_s: longest wait for subscribers and for the answer topic.
        max_interval_ns: largest distance of the colour and depth image of a frame, as the node pairs them; None adapts it to the
            rate.
    """

    topics: tuple[str, ...]
    remap: Mapping[str, str]
    qos: Mapping[str, Policies]
    must_arrive: bool
    start_ns: int
    end_ns: int
    rate: float | None
    delay_s: float
    loop: bool
    clock_hz: float | None
    clock_topics: frozenset[str]
    start_paused: bool
    read_ahead: int
    wait_for: tuple[str, ...]
    max_ahead: int
    wait_timeout_s: float
    acknowledge_timeout_s: float
    wait_for_subscribers: bool
    discovery_timeout_s: float
    max_interval_ns: int | None


def make_options(args: argparse.Namespace, recording: Recording, playable: PlayableTopics) -> Options:
    """Resolve the command line against a recording.

    Args:
        args: from the parser in ``main``.
        recording: what to play.
        playable: its topics that can be published.

    Raises:
        RosError: a named topic is not in the recording, nothing is left to play, or the QoS file cannot be used.
    """
    remap = dict(args.remap)
    qos = read_overrides(args.qos_profile_overrides_path) if args.qos_profile_overrides_path else {}
    named = [*(args.topics or []), *args.exclude_topics, *args.clock_topics, *remap, *qos]
    _require_known(named, recording)
    topics = _choose_topics(args, recording, playable)
    start_ns, end_ns = _cut(args, recording)
    wait_for = ANSWER_TOPICS if args.wait_for == ANSWER_TOPICS[0] else (args.wait_for,) if args.wait_for else ()
    return Options(
        topics=topics,
        remap=remap,
        qos=qos,
        must_arrive=bool(wait_for) or not args.rate,
        start_ns=start_ns,
        end_ns=end_ns,
        rate=args.rate or None,
        delay_s=args.delay,
        loop=args.loop,
        clock_hz=args.clock,
        clock_topics=frozenset(topics if args.clock_topics_all else args.clock_topics),
        start_paused=args.start_paused,
        read_ahead=args.read_ahead_queue_size,
        wait_for=wait_for,
        max_ahead=args.max_ahead,
        wait_timeout_s=args.wait_timeout,
        acknowledge_timeout_s=_acknowledge_timeout_s(args),
        wait_for_subscribers=not args.no_wait_for_subscribers,
        discovery_timeout_s=args.discovery_timeout,
        max_interval_ns=round(args.max_interval * 1e9) or None,
    )


def _require_known(names: Iterable[str], recording: Recording) -> None:
    for name in names:
        if name not in recording.topics:
            raise RosError(f'{name} is not in {recording.path}, which holds {", ".join(sorted(recording.topics))}')


def _choose_topics(args: argparse.Namespace, recording: Recording, playable: PlayableTopics) -> tuple[str, ...]:
    """Choose the named and matching topics, or all; leave out the excluded ones, and a recorded clock if one is published."""
    makes_clock = args.clock or args.clock_topics or args.clock_topics_all
    excluded = {*args.exclude_topics, *(['/clock'] if makes_clock else [])}
    chosen = tuple(
        name
        for name in playable.topics
        if _is_asked_for(name, args.topics, args.regex)
        and name not in excluded
        and not (args.exclude_regex and args.exclude_regex.search(name))
    )
    if not chosen:
        raise RosError(f'{recording.path}: no topic is left to play of {", ".join(sorted(playable.topics)) or "none"}')
    return chosen


def _is_asked_for(name: str, topics: Collection[str] | None, regex: re.Pattern[str] | None) -> bool:
    if topics is None and regex is None:
        return True
    return name in (topics or ()) or (regex is not None and regex.search(name) is not None)


def _cut(args: argparse.Namespace, recording: Recording) -> tuple[int, int]:
    """Returns the recording times of start and end."""
    duration_s = (recording.end_ns - _first_ns(recording)) / 1e9
    if args.start_offset > duration_s:
        raise RosError(f'--start-offset {args.start_offset:g}: the recording lasts {duration_s:.1f} s')
    start_ns = _first_ns(recording) + round(args.start_offset * 1e9)
    end_ns = recording.end_ns
    if args.duration is not None:
        end_ns = min(end_ns, start_ns + round(args.duration * 1e9))
    if args.until_ns is not None:
        end_ns = min(end_ns, args.until_ns)
    if end_ns < start_ns:
        raise RosError(f'--playback-until {args.until_ns / 1e9:.9f} s: playback starts at {start_ns / 1e9:.9f} s of the recording')
    return start_ns, end_ns


def _first_ns(recording: Recording) -> int:
    """Returns the time of recording at which a recording begins.

    RealSense Viewer records camera infos at time 0, and images at the time of day. The images then are the beginning.
    """
    images = recording.topics_of(*IMAGES)
    first = next(recording.messages(images), None) if images else None
    is_long = first is not None and first.time_ns - recording.start_ns > LONG_SILENCE_NS
    return first.time_ns if first is not None and is_long else recording.start_ns


def _acknowledge_timeout_s(args: argparse.Namespace) -> float:
    if args.wait_for_all_acked is None:
        return args.wait_timeout
    return args.wait_for_all_acked / 1e3 or float('inf')
