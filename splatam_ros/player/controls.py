"""Controls of the player: keys, services and the parameter ``rate``."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial

from rcl_interfaces.msg import ParameterDescriptor, SetParametersResult
from rclpy.node import Node
from rclpy.parameter import Parameter
from std_srvs.srv import Trigger

from splatam_ros.player.keyboard import Key, Keyboard
from splatam_ros.player.pacing import PlaybackClock, why_no_rate

RATE_STEP = 1.1
Outcome = tuple[bool, str]
"""True if a command changed something (or the answer of ``is_paused``), and the message for the caller."""


class Controls:
    """Pause, step, rate and stop.

    The services are of type ``std_srvs/Trigger``, which every ROS has. Those of ``ros2 bag play`` need rosbag2's types.

    Attributes:
        is_paused: True while messages are held back.
        is_stopped: True if playback should end.
    """

    def __init__(self, node: Node, clock: PlaybackClock, keyboard: Keyboard, say: Callable[[str], None]) -> None:
        """Create the services and the parameter.

        Args:
            node: gets the services and the parameter.
            clock: is frozen while paused.
            keyboard: need not be attached to a terminal.
            say: shows a message to the user.
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
        """Hold messages back."""
        if self.is_paused:
            return False, 'paused already'
        self.is_paused = True
        self._clock.freeze()
        keys = 'space resumes, cursor right plays one message' if self._keyboard.is_attached else 'the service ~/resume resumes'
        self._say(f'paused ({keys})')
        return True, 'paused'

    def resume(self) -> Outcome:
        """Play on."""
        if not self.is_paused:
            return False, 'playing already'
        self.is_paused = False
        self._steps = 0
        self._clock.thaw()
        self._say('playing')
        return True, 'playing'

    def toggle_paused(self) -> Outcome:
        """Pause or resume."""
        return self.resume() if self.is_paused else self.pause()

    def play_next(self) -> Outcome:
        """Play one message while paused."""
        if not self.is_paused:
            return False, 'only while paused'
        self._steps += 1
        return True, 'one message more'

    def stop(self) -> Outcome:
        """End playback."""
        self.is_stopped = True
        return True, 'stopping'

    def take_step(self) -> bool:
        """Returns True if a message may be played while paused; uses up one step."""
        self._steps -= (may_go := self._steps > 0)
        return may_go

    def handle_keys(self) -> None:
        """Act on the keys that were pressed since the last call."""
        actions: Mapping[Key, Callable[[], object]] = {
            Key.SPACE: self.toggle_paused,
            Key.RIGHT: self.play_next,
            Key.UP: partial(self._scale_rate, RATE_STEP),
            Key.DOWN: partial(self._scale_rate, 1 / RATE_STEP),
        }
        for key in self._keyboard.pressed():
            actions[key]()

    # --- rate ---

    def _offer_rate(self) -> None:
        description = 'Speed of playback relative to the recording, above 0; reads 0 while playing as fast as the listeners allow.'
        descriptor = ParameterDescriptor(description=description, dynamic_typing=True)  # accepts integers too
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
            self._say('already as fast as the listeners allow')
        else:
            self._node.set_parameters([Parameter('rate', value=self._clock.rate * factor)])


def _check_rate(changed: list[Parameter]) -> SetParametersResult:
    for parameter in changed:
        if parameter.name == 'rate' and (why := why_no_rate(parameter.value)):
            return SetParametersResult(successful=False, reason=why)
    return SetParametersResult(successful=True)


def _serve(command: Callable[[], Outcome], request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
    response.success, response.message = command()
    return response
