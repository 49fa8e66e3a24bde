"""Controls of the player during playback: services, the parameter ``rate``, and keys."""

from __future__ import annotations

import os
import pty
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from graph import Graph
from processes import Process
from rcl_interfaces.msg import ParameterType
from rcl_interfaces.srv import GetParameters, SetParameters
from rclpy.parameter import Parameter
from std_srvs.srv import Trigger
from test_player import RGB, finish, recorded, subscribe

PLAYER = '/splatam_bag_player'


class Remote:
    """Calls the player's services, as ``ros2 service call`` and ``ros2 param`` do."""

    def __init__(self, graph: Graph, player: Process) -> None:
        self._graph, self._player = graph, player

    def trigger(self, name: str) -> tuple[bool, str]:
        response = self._call(Trigger, name, Trigger.Request())
        return response.success, response.message

    def set_rate(self, value: Any) -> tuple[bool, str]:
        parameter = Parameter('rate', value=value).to_parameter_msg()
        result = self._call(SetParameters, 'set_parameters', SetParameters.Request(parameters=[parameter])).results[0]
        return result.successful, result.reason

    def rate(self) -> float:
        value = self._call(GetParameters, 'get_parameters', GetParameters.Request(names=['rate'])).values[0]
        return value.double_value if value.type == ParameterType.PARAMETER_DOUBLE else float(value.integer_value)

    def _call(self, service_class: type, name: str, request: Any) -> Any:
        client = self._graph.node.create_client(service_class, f'{PLAYER}/{name}')
        self._graph.spin_until(client.service_is_ready, explain=lambda: self._player.text)
        future = client.call_async(request)
        self._graph.spin_until(future.done, explain=lambda: self._player.text)
        client.destroy()
        return future.result()


def stays(graph: Graph, count: Callable[[], int]) -> bool:
    """Returns True if nothing more arrives for the time of seven frames, after messages in transit have arrived."""
    before = graph.settled(count)
    graph.spin_for(7 / 30)
    return count() == before


def test_services_pause_step_and_resume(graph: Graph, bag: Path) -> None:
    received = subscribe(graph)
    player = graph.play(str(bag), '--topics', RGB, '--start-paused')
    remote = Remote(graph, player)
    player.wait_says('paused (the service ~/resume resumes)')
    assert remote.trigger('is_paused') == (True, 'paused')
    assert stays(graph, lambda: len(received[RGB])) and received[RGB] == []
    for count in (1, 2):
        assert remote.trigger('play_next') == (True, 'one message more')
        graph.spin_until(lambda: len(received[RGB]) == count, explain=lambda: player.text)  # noqa: B023
    assert stays(graph, lambda: len(received[RGB])) and len(received[RGB]) == 2
    assert remote.trigger('pause') == (False, 'paused already')
    assert remote.trigger('resume') == (True, 'playing')
    finish(graph, player)
    assert received[RGB] == recorded(bag, RGB)


def test_services_toggle_and_stop(graph: Graph, bag: Path) -> None:
    received = subscribe(graph)
    player = graph.play(str(bag), '--loop', '--rate', '0.5')
    remote = Remote(graph, player)
    graph.spin_until(lambda: received[RGB], explain=lambda: player.text)
    assert remote.trigger('is_paused') == (False, 'playing')
    assert remote.trigger('resume') == (False, 'playing already')
    assert remote.trigger('play_next') == (False, 'only while paused')
    assert remote.trigger('toggle_paused') == (True, 'paused')
    assert stays(graph, lambda: len(received[RGB]))
    assert remote.trigger('toggle_paused') == (True, 'playing')
    assert remote.trigger('stop') == (True, 'stopping')
    finish(graph, player)
    assert player.says('stopped; played')


def test_the_rate_is_a_parameter(graph: Graph, bag: Path) -> None:
    received = subscribe(graph)
    player = graph.play(str(bag), '--rate', '0.001')  # six minutes long, but for what follows
    remote = Remote(graph, player)
    graph.spin_until(lambda: received[RGB], explain=lambda: player.text)
    assert remote.rate() == 0.001
    for wrong in (0.0, -1.0, 1e300, 1e-300, float('inf'), float('nan'), 'fast'):
        successful, reason = remote.set_rate(wrong)
        assert not successful and 'expected a number above 0' in reason
    assert remote.rate() == 0.001
    assert remote.set_rate(2) == (True, '')  # a whole number is as good
    assert remote.rate() == 2.0
    finish(graph, player)
    assert player.says('rate 2')
    assert received[RGB] == recorded(bag, RGB)


@pytest.fixture
def terminal() -> Iterator[tuple[int, int]]:
    """The user's and the player's end of a pseudo terminal."""
    ends = pty.openpty()
    yield ends
    for end in ends:
        os.close(end)


def test_keys_pause_step_and_change_the_rate(graph: Graph, bag: Path, terminal: tuple[int, int]) -> None:
    user, stdin = terminal
    received = subscribe(graph)
    player = graph.play(str(bag), '--topics', RGB, '--start-paused', stdin=stdin)
    player.wait_says('paused (space resumes, cursor right plays one message)')
    os.write(user, b'\x1b[C\x1bOC')  # terminals send cursor keys in two ways
    graph.spin_until(lambda: len(received[RGB]) == 2, explain=lambda: player.text)
    os.write(user, b'\x1b')  # slow lines deliver a key in pieces
    assert stays(graph, lambda: len(received[RGB])) and len(received[RGB]) == 2
    os.write(user, b'[C')
    graph.spin_until(lambda: len(received[RGB]) == 3, explain=lambda: player.text)
    os.write(user, b'\x1b[A\x1b[Ax\x1b[B\x1b[B\x1b[B')  # x means nothing
    player.wait_says('rate 0.909091')
    assert [line for line in player.lines if 'rate ' in line] == [
        f'splatam_bag_player: rate {rate}' for rate in ('1.1', '1.21', '1.1', '1', '0.909091')
    ]
    os.write(user, b' ')
    finish(graph, player)
    assert received[RGB] == recorded(bag, RGB)


def test_keys_can_be_switched_off(graph: Graph, bag: Path, terminal: tuple[int, int]) -> None:
    user, stdin = terminal
    received = subscribe(graph)
    player = graph.play(str(bag), '--rate', '0.5', '--disable-keyboard-controls', stdin=stdin)
    graph.spin_until(lambda: received[RGB], explain=lambda: player.text)
    os.write(user, b' ')
    finish(graph, player)
    assert not player.says('paused')
