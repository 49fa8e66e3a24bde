"""``splatam_bag_player``: plays a recording onto the ROS graph. Its switches have the names of those of ``ros2 bag play``."""

from __future__ import annotations

import argparse
import re
import signal
import sys
from collections.abc import Sequence
from pathlib import Path

from rclpy.node import Node

from splatam_core.datasets.bag.recording import Recording
from splatam_core.errors import SplatamError
from splatam_core.geometry.trajectory import stamp_from_text
from splatam_core.output import unfailing_output
from splatam_ros.player.back_pressure import PlaybackError
from splatam_ros.player.keyboard import Keyboard
from splatam_ros.player.options import ANSWER_TOPICS, make_options
from splatam_ros.player.pacing import why_no_rate
from splatam_ros.player.playable import find_playable
from splatam_ros.player.player import Interrupted, Player
from splatam_ros.process import StopRequest, ros, split_arguments

PROGRAM = 'splatam_bag_player'
EXIT_PLAYBACK, EXIT_USAGE = 1, 2
LARGEST = 10**9
"""Of any number of the command line: 30 years, in nanoseconds, fit into 64 bits."""


def make_parser() -> argparse.ArgumentParser:
    """Returns the parser of the command line."""
    parser = argparse.ArgumentParser(
        PROGRAM,
        usage='%(prog)s BAG [options]',
        description='Play a recording onto the ROS graph. Keys: space pauses and resumes, cursor right plays one '
        'message while paused, cursor up and down change the rate by a tenth.',
        epilog='Exit code: 0 everything was played and received, 1 a frame was not answered or a listener left, '
        '2 the recording or the arguments cannot be used, 128 + n stopped by signal n.',
    )
    add = parser.add_argument
    add('bag', type=Path, metavar='BAG', help='a rosbag2: folder, .db3 or .mcap; or a ROS 1 .bag')
    _add_time(parser)
    _add_topics(parser)
    _add_clock(parser)
    _add_back_pressure(parser)
    add(
        '--read-ahead-queue-size', type=_count, default=100, metavar='N',
        help='read at most N messages ahead (default: %(default)s)',
    )  # fmt: skip
    add('--disable-keyboard-controls', action='store_true', help='do not read keys from the terminal')
    return parser


def _add_time(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group('time')
    add = group.add_argument
    add(
        '-r', '--rate', type=_rate, default=1.0, metavar='R',
        help="speed relative to the recording; 'max' or 0 = as fast as the listeners allow",
    )  # fmt: skip
    add('--start-offset', type=_seconds, default=0.0, metavar='S', help='skip the first S seconds')
    end = group.add_mutually_exclusive_group()
    end.add_argument('--playback-duration', '--duration', dest='duration', type=_seconds, metavar='S',
                     help='play S seconds')  # fmt: skip
    end.add_argument('--playback-until-sec', dest='until_ns', type=_nanoseconds_of, metavar='T',
                     help='stop at this time of the recording, seconds since 1970')  # fmt: skip
    end.add_argument('--playback-until-nsec', dest='until_ns', type=_stamp, metavar='T', help='the same in nanoseconds')
    add('-d', '--delay', type=_seconds, default=0.0, metavar='S', help='wait S seconds before the first message, in every loop')
    add('-l', '--loop', action='store_true', help='start over at the end, with the same stamps, until stopped')
    add('-p', '--start-paused', action='store_true', help='wait for a key or a service before the first message')


def _add_topics(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument_group('topics').add_argument
    add('--topics', nargs='+', action='extend', metavar='TOPIC', help='play only these topics')
    add('-e', '--regex', type=_regex, metavar='RE', help='play topics that match, besides those of --topics')
    add('--exclude-topics', '--exclude', dest='exclude_topics', nargs='+', action='extend', default=[],
        metavar='TOPIC', help='leave these topics out')  # fmt: skip
    add('-x', '--exclude-regex', type=_regex, metavar='RE', help='leave out topics that match')
    add('-m', '--remap', type=_remap, nargs='+', action='extend', default=[], metavar='A:=B',
        help='publish topic A as B')  # fmt: skip
    add('--qos-profile-overrides-path', type=Path, metavar='FILE',
        help='YAML file that maps topics to QoS policies; policies that it does not name stay as recorded')  # fmt: skip


def _add_clock(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument_group('/clock').add_argument
    add('--clock', type=_positive, nargs='?', const=40.0, metavar='HZ', help='publish /clock (default: 40 Hz)')
    add('--clock-topics', nargs='+', action='extend', default=[], metavar='TOPIC',
        help='publish /clock before each message on these')  # fmt: skip
    add('--clock-topics-all', action='store_true', help='publish /clock before each message')


def _add_back_pressure(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument_group('losing no message').add_argument
    add(
        '--wait-for', nargs='?', const=ANSWER_TOPICS[0], metavar='TOPIC',
        help='stay at most N frames ahead of the newest stamp on TOPIC, which may have any type with a header '
        f'(default: {ANSWER_TOPICS[0]}, and {ANSWER_TOPICS[1]} for frames without a pose)',
    )  # fmt: skip
    add('--max-ahead', type=_count, default=2, metavar='N', help='the N of --wait-for (default: %(default)s)')
    add('--max-interval', type=_seconds, default=0.0, metavar='S', help="the node's sync.max_interval: colour and depth of a "
        'frame are at most S seconds apart (default: 0 = by the rate, as the node)')  # fmt: skip
    add('--wait-timeout', type=_positive, default=60.0, metavar='S', help='longest wait for an answer (default: 60 s)')
    add(
        '--wait-for-all-acked', type=_seconds, metavar='MS',
        help='longest wait, at the end, until subscribers have received everything, in milliseconds; 0 = no limit '
        '(default: as --wait-timeout)',
    )  # fmt: skip
    add('--no-wait-for-subscribers', action='store_true', help='do not wait for subscribers of the images')
    add(
        '--discovery-timeout', type=_positive, default=30.0, metavar='S',
        help='longest wait for subscribers and for the TOPIC of --wait-for (default: 30 s)',
    )  # fmt: skip


def play(args: argparse.Namespace, for_ros: Sequence[str], stop: StopRequest) -> None:
    """Play the recording that the arguments name.

    Args:
        args: from ``make_parser``.
        for_ros: the arguments that are ROS's.
        stop: ends playback when requested.

    Raises:
        SplatamError: the recording, the arguments or playback failed.
        Interrupted: by a signal.
    """
    with Recording(args.bag) as recording, ros(for_ros), Keyboard(not args.disable_keyboard_controls) as keyboard:
        playable = find_playable(recording)
        options = make_options(args, recording, playable)
        for name, reason in playable.skipped.items():
            _print_error(f'warning: {name} is left out: {reason}')
        node = Node(PROGRAM)
        try:
            print(f'{PROGRAM}: {Player(node, recording, options, stop, keyboard).play()}')
        finally:
            node.destroy_node()


def main(arguments: Sequence[str] | None = None) -> int:
    """Play a recording.

    Returns:
        The exit code.
    """
    own, for_ros = split_arguments(sys.argv[1:] if arguments is None else arguments)
    args = make_parser().parse_args(own)
    with unfailing_output(results=False), StopRequest() as stop:
        try:
            play(args, for_ros, stop)
        except Interrupted as interrupted:
            number = stop.signal or signal.SIGINT
            _print_error(f'stopped by {number.name}; {interrupted}')
            return 128 + number
        except PlaybackError as error:
            _print_error(f'error: {error}')
            return EXIT_PLAYBACK
        except SplatamError as error:
            _print_error(f'error: {error}')
            return EXIT_USAGE
    return 0


def _print_error(text: str) -> None:
    print(f'{PROGRAM}: {text}', file=sys.stderr, flush=True)


def _seconds(text: str) -> float:
    if not 0 <= (value := float(text)) <= LARGEST:
        raise argparse.ArgumentTypeError(f'{text}: expected 0 or more, at most {LARGEST:g}')
    return value


def _positive(text: str) -> float:
    if not 1 / LARGEST <= (value := float(text)) <= LARGEST:
        raise argparse.ArgumentTypeError(f'{text}: expected more than 0, {1 / LARGEST:g} to {LARGEST:g}')
    return value


def _count(text: str) -> int:
    if not 1 <= (value := int(text)) <= LARGEST:
        raise argparse.ArgumentTypeError(f'{text}: expected 1 or more, at most {LARGEST:g}')
    return value


def _nanoseconds_of(text: str) -> int:
    try:
        return stamp_from_text(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def _stamp(text: str) -> int:
    if (value := int(text)) < 0:
        raise argparse.ArgumentTypeError(f'{text}: expected 0 or more')
    return value


def _regex(text: str) -> re.Pattern[str]:
    try:
        return re.compile(text)
    except re.error as error:
        raise argparse.ArgumentTypeError(f'{text}: no regular expression: {error}') from None


def _rate(text: str) -> float:
    value = 0.0 if text == 'max' else float(text)
    if value != 0 and (why := why_no_rate(value)):
        raise argparse.ArgumentTypeError(why)
    return value


def _remap(text: str) -> tuple[str, str]:
    source, separator, target = text.partition(':=')
    if not (source and separator and target):
        raise argparse.ArgumentTypeError(f'{text}: expected /recorded:=/published')
    return source, target


if __name__ == '__main__':
    sys.exit(main())
