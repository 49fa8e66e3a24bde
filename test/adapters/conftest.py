"""The two libraries whose messages are supported; every test that takes ``factory`` runs with both."""

from __future__ import annotations

import pytest
from rosbags.typesys import Stores, get_typestore

from msg_adapters.factory import MessageFactory, RclpyMessages, RosbagsMessages


@pytest.fixture(params=['rosbags', 'rclpy'])
def factory(request: pytest.FixtureRequest) -> MessageFactory:
    if request.param == 'rosbags':
        return RosbagsMessages(get_typestore(Stores.ROS2_JAZZY))
    pytest.importorskip('sensor_msgs.msg', reason='the ROS messages are not installed')
    return RclpyMessages()
