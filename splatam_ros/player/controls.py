"""Who steers the player: keys, services and the node's parameter ``rate``."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from rcl_interfaces.msg import ParameterDescriptor, SetParametersResult
from rclpy.node import Node
from rclpy.parameter import Parameter
from std_srvs.srv import Trigger

from splatam_ros.player.keyboard import Key, Keyboard
from splatam_ros.player.pacing import PlaybackClock

RATE_STEP = 1.1
Outcome = tuple[bool, str]
"""Whether a command did something, and what there is to say."""


class Controls:
    """Pause, step, rate and stop.

    The services are of ``std_srvs/Trigger``, which every ROS has; the standard player's own types come with rosbag2.

    Attributes:
        is_paused: whether messages wait.
        is_stopped: whether playback should end.
    """

    def __init__(self, node: Node, clock: PlaybackClock, keyboard: Keyboard, say: Callable[[str], None]) -> None:
        """Offer services and parameter.

        Args:
            node: whose they are.
            clock: frozen while paused.
            keyboard: may be attached or not.
            say: tells the user what has changed.
        """
        self.is_paused = self.is_stopped = False
        self._node = node
        self._clock = clock
        self._keyboard = keyboard
        self._say = say
        self._steps = 0
        commands = {
            'pause': self.pause, 'resume': self.resume, 'toggle_paused': self.toggle_paused,
            'is_paused': lambda: (self.is_paused, 'paused' if self.is_paused else 'playing'),
            'play_next': self.play_next, 'stop': self.stop,
        }  # fmt: skip
        self._services = [node.create_service(Trigger, f'~/{name}', partial(_serve, command)) for name, command in commands.items()]
        self._offer_rate()

    def pause(self) -> Outcome:
        """Let messages wait."""
        if self.is_paused:
            return False, 'paused already'
        self.is_paused = True
        self._clock.freeze()
        keys = 'space goes on, cursor right plays one message' if self._keyboard.is_attached else '~/resume goes on'
        self._say(f'paused ({keys})')
        return True, 'paused'

    def resume(self) -> Outcome:
        """Go on."""
        if not self.is_paused:
            return False, 'playing already'
        self.is_paused = False
        self._steps = 0
        self._clock.thaw()
        self._say('playing')
        return True, 'playing'

    def toggle_paused(self) -> Outcome:
        """Pause or go on."""
        return self.resume() if self.is_paused else self.pause()

    def play_next(self) -> Outcome:
        """Let one message out although paused."""
        if not self.is_paused:
            return False, 'only while paused'
        self._steps += 1
        return True, 'one message more'

    def stop(self) -> Outcome:
        """End playback."""
        self.is_stopped = True
        return True, 'stopping'

    def take_step(self) -> bool:
        """Whether a message may go out although paused; uses up a step."""
        self._steps -= (may_go := self._steps > 0)
        return may_go

    def look_at_keys(self) -> None:
        """Do what the keys pressed since the last look ask for."""
        actions = {
            Key.SPACE: self.toggle_paused,
            Key.RIGHT: self.play_next,
            Key.UP: partial(self._scale_rate, RATE_STEP),
            Key.DOWN: partial(self._scale_rate, 1 / RATE_STEP),
        }
        for key in self._keyboard.pressed():
            actions[key]()

    # --- rate ---

    def _offer_rate(self) -> None:
        description = 'Speed of playback, more than 0; shows 0 while as fast as listeners allow.'
        descriptor = ParameterDescriptor(description=description, dynamic_typing=True)  # whole numbers are welcome
        self._node.declare_parameter('rate', self._clock.rate or 0.0, descriptor, ignore_override=True)
        self._node.add_on_set_parameters_callback(_check_rate)
        self._node.add_post_set_parameters_callback(self._apply_rate)

    def _apply_rate(self, changed: list[Parameter]) -> None:
        for parameter in changed:
            if parameter.name == 'rate':
                self._clock.rate = float(parameter.value)
                self._say(f'rate {self._clock.rate:g}')

    def _scale_rate(self, factor: float) -> None:
        if self._clock.rate is None:
            self._say('already as fast as listeners allow')
        else:
            self._node.set_parameters([Parameter('rate', value=self._clock.rate * factor)])


def _check_rate(changed: list[Parameter]) -> SetParametersResult:
    for parameter in changed:
        value = parameter.value
        is_number = type(value) in (int, float)
        if parameter.name == 'rate' and not (is_number and 0 < value < float('inf')):
            return SetParametersResult(successful=False, reason=f'rate = {value!r}: expected a number above 0')
    return SetParametersResult(successful=True)


def _serve(command: Callable[[], Outcome], request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
    response.success, response.message = command()
    return response
