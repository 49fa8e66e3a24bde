"""``splatam_bag_player``: plays a rosbag2 recording onto the ROS graph."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from rclpy.node import Node

from splatam_core.errors import SplatamError
from splatam_ros.keyboard import Keyboard
from splatam_ros.player import Interrupted, Options, PlaybackError, Player
from splatam_ros.process import RosError, StopRequest, ros, split_arguments
from splatam_ros.recording import Recording

PROGRAM = 'splatam_bag_player'
ANSWERS = ('/splatam/pose', '/splatam/processed')
EXIT_PLAYBACK, EXIT_USAGE = 1, 2


def make_parser() -> argparse.ArgumentParser:
    """The parser of the command line."""
    parser = argparse.ArgumentParser(
        PROGRAM,
        usage='%(prog)s BAG [options]',
        description='Play a rosbag2 recording onto the ROS graph. The space key pauses.',
        epilog='Exit code: 0 all played and taken, 1 a frame was not answered or a listener left, '
        '2 recording or arguments cannot be used, 128 + n stopped by signal n.',
    )
    add = parser.add_argument
    add('bag', type=Path, metavar='BAG', help='a rosbag2: folder, .db3 or .mcap')
    add('--rate', type=_rate, default=1.0, metavar='R', help="speed; 'max' or 0 = as fast as listeners allow")
    add('--start-offset', type=_seconds, default=0.0, metavar='S', help='skip the first seconds')
    add('--duration', type=_seconds, metavar='S', help='play that many seconds')
    add('--loop', action='store_true', help='start over at the end, stamps included, until stopped')
    add('--clock', type=_positive, nargs='?', const=40.0, metavar='HZ', help='publish /clock (default: 40 Hz)')
    add('--remap', type=_remap, nargs='+', action='extend', default=[], metavar='A:=B', help='publish topic A as B')
    add('--topics', nargs='+', action='extend', metavar='TOPIC', help='play these topics only')
    add('--exclude', nargs='+', action='extend', default=[], metavar='TOPIC', help='leave these topics out')
    add('--start-paused', action='store_true', help='wait for the space key')
    add(
        '--wait-for', nargs='?', const=ANSWERS[0], metavar='TOPIC',
        help='never be more than N frames ahead of the newest stamp on TOPIC, whatever its type '
        f'(default: {ANSWERS[0]}, with {ANSWERS[1]} for frames that have no pose)',
    )  # fmt: skip
    add('--max-ahead', type=_count, default=2, metavar='N', help='that N (default: %(default)s)')
    add('--wait-timeout', type=_positive, default=60.0, metavar='S', help='give up on an answer (default: 60 s)')
    add('--no-wait-for-subscribers', action='store_true', help='do not wait until somebody subscribes to the images')
    add(
        '--discovery-timeout', type=_positive, default=30.0, metavar='S',
        help='give up on subscribers and on TOPIC (default: 30 s)',
    )  # fmt: skip
    return parser


def make_options(args: argparse.Namespace, recording: Recording) -> Options:
    """What the command line asks for, of this recording.

    Raises:
        RosError: a topic is not in it, or nothing is left to play.
    """
    known = {**recording.topics, **recording.skipped}
    remap = dict(args.remap)
    for name in [*(args.topics or []), *args.exclude, *remap]:
        if name not in known:
            raise RosError(f'{name} is not in {recording.path}, which holds {", ".join(sorted(known))}')
    excluded = {*args.exclude, *(['/clock'] if args.clock else [])}
    playable = [name for name in recording.topics if name not in excluded]
    topics = tuple(name for name in playable if not args.topics or name in args.topics)
    if not topics:
        raise RosError(f'{recording.path}: no topic is left to play')
    seconds = (recording.end_ns - recording.start_ns) / 1e9
    if args.start_offset > seconds:
        raise RosError(f'--start-offset {args.start_offset:g}: the recording lasts {seconds:.1f} s')
    return Options(
        topics=topics,
        remap=remap,
        rate=args.rate or None,
        start_offset_s=args.start_offset,
        duration_s=args.duration,
        loop=args.loop,
        clock_hz=args.clock,
        start_paused=args.start_paused,
        wait_for=ANSWERS if args.wait_for == ANSWERS[0] else (args.wait_for,) if args.wait_for else (),
        max_ahead=args.max_ahead,
        wait_timeout_s=args.wait_timeout,
        wait_for_subscribers=not args.no_wait_for_subscribers,
        discovery_timeout_s=args.discovery_timeout,
    )


def play(args: argparse.Namespace, for_ros: Sequence[str], stop: StopRequest) -> None:
    """Open, play, close.

    Raises:
        SplatamError: what went wrong.
        Interrupted: by a signal.
    """
    with Recording(args.bag) as recording, ros(for_ros), Keyboard() as keyboard:
        options = make_options(args, recording)
        for name, reason in recording.skipped.items():
            _complain(f'warning: {name} is left out: {reason}')
        node = Node(PROGRAM)
        try:
            print(f'{PROGRAM}: {Player(node, recording, options, stop, keyboard).play()}')
        finally:
            node.destroy_node()


def main(arguments: Sequence[str] | None = None) -> int:
    """Play a recording; returns the exit code."""
    own, for_ros = split_arguments(sys.argv[1:] if arguments is None else arguments)
    args = make_parser().parse_args(own)
    with StopRequest() as stop:
        try:
            play(args, for_ros, stop)
        except Interrupted as interrupted:
            _complain(f'stopped by {stop.signal.name}; {interrupted}')
            return 128 + stop.signal
        except PlaybackError as error:
            _complain(f'error: {error}')
            return EXIT_PLAYBACK
        except SplatamError as error:
            _complain(f'error: {error}')
            return EXIT_USAGE
    return 0


def _complain(text: str) -> None:
    print(f'{PROGRAM}: {text}', file=sys.stderr, flush=True)


def _seconds(text: str) -> float:
    if not 0 <= (value := float(text)) < float('inf'):
        raise argparse.ArgumentTypeError(f'{text}: expected 0 or more')
    return value


def _positive(text: str) -> float:
    if not 0 < (value := float(text)) < float('inf'):
        raise argparse.ArgumentTypeError(f'{text}: expected more than 0')
    return value


def _count(text: str) -> int:
    if (value := int(text)) < 1:
        raise argparse.ArgumentTypeError(f'{text}: expected 1 or more')
    return value


def _rate(text: str) -> float:
    return 0.0 if text == 'max' else _seconds(text)


def _remap(text: str) -> tuple[str, str]:
    source, separator, target = text.partition(':=')
    if not (source and separator and target):
        raise argparse.ArgumentTypeError(f'{text}: expected /recorded:=/published')
    return source, target


if __name__ == '__main__':
    sys.exit(main())
