"""The floor plan over DDS: ``~/map/grid`` and ``~/get_map``, with up from the base; without any up, one line says so."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from camera import CAMERA_FRAME, LATCHED, MAKE, Camera, run_node
from geometry_msgs.msg import Vector3
from graph import Graph
from nav_msgs.msg import OccupancyGrid
from nav_msgs.srv import GetMap
from processes import Process
from sensor_msgs.msg import Imu

from msg_adapters import poses, stamps
from splatam_core.datasets.room import ROOM_SIZE_M
from splatam_core.datasets.synthetic import SyntheticSequence
from splatam_core.geometry import se3
from splatam_ros.frames.gravity import RestDetector
from splatam_ros.node.floor_plan import along_map


def get_map(graph: Graph, node: Process) -> OccupancyGrid:
    client = graph.node.create_client(GetMap, '/splatam/get_map')
    graph.spin_until(client.service_is_ready, explain=lambda: node.text)
    answer = client.call_async(GetMap.Request())
    graph.spin_until(answer.done, explain=lambda: node.text)
    return answer.result().map


def cells(grid: OccupancyGrid) -> np.ndarray:
    return np.array(grid.data, np.int8).reshape(grid.info.height, grid.info.width)


def test_the_plan_is_published_and_served_in_the_axes_of_the_base(graph: Graph, frames: SyntheticSequence) -> None:
    T_room_cam = frames.ground_truth().T_world_cam[0]
    T_room_base = np.eye(4)
    T_room_base[:2, 3] = T_room_cam[:2, 3]  # on the floor below the camera, along the room
    T_base_cam = se3.inverse(T_room_base) @ T_room_cam
    w, *xyz = se3.quaternion_from_rotation(T_base_cam[:3, :3])
    in_base = ' '.join(f'{value:.9f}' for value in (*T_base_cam[:3, 3], *xyz, w))
    node = run_node(
        graph, queue_policy='all', base_frame='base', camera_in_base=f"'{in_base}'", world_up='z_up', publish_rate__grid=0.0
    )
    camera = Camera(graph)
    camera.wait_matched()
    grids: list[OccupancyGrid] = []
    for index, frame in enumerate(frames):
        camera.send(frame)
        if index == 0:
            grids = graph.collect(OccupancyGrid, '/splatam/map/grid', LATCHED)
    last_ns = frames[11].stamp_ns
    graph.spin_until(lambda: grids and stamp_ns(grids[-1]) == last_ns, explain=lambda: node.text)
    served = get_map(graph, node)
    for grid in (grids[-1], served):
        assert grid.header.frame_id == 'map' and abs(grid.info.resolution - 0.05) < 1e-6
        T_map_corner = poses.pose_matrix(grid.info.origin)
        np.testing.assert_allclose(T_map_corner[:3, :3], np.eye(3), atol=1e-6)  # the map is upright, and so is the grid
        assert abs(T_map_corner[2, 3]) < 1e-6  # on the floor
        check_inside_the_room(grid, T_room_base @ T_map_corner)
    late = graph.collect(OccupancyGrid, '/splatam/map/grid', LATCHED)
    graph.spin_until(lambda: late, explain=lambda: node.text)
    assert cells(late[-1]).tolist() == cells(served).tolist()
    assert 'WARN' not in node.text.replace('tf2_msgs is not installed', '')


def stamp_ns(grid: Any) -> int:
    return grid.header.stamp.sec * 10**9 + grid.header.stamp.nanosec


def check_inside_the_room(grid: OccupancyGrid, T_room_corner: np.ndarray) -> None:
    """Free cells are in the room, and so are all but a few of the occupied ones, with its walls."""
    known = cells(grid)
    assert (known == 100).sum() > 20 and (known == 0).sum() > 100
    for value, margin_m in ((0, 0.0), (100, 0.1)):
        row, column = np.nonzero(known == value)
        points = 0.05 * (np.stack([column, row], axis=1) + 0.5) + T_room_corner[:2, 3]
        inside = (np.abs(points) <= np.array(ROOM_SIZE_M[:2]) / 2 + margin_m).all(axis=1)
        assert inside.mean() > 0.97


def test_without_a_floor_there_is_no_plan_and_one_line_says_why(graph: Graph, frames: SyntheticSequence) -> None:
    node = run_node(graph, queue_policy='all', publish_rate__grid=0.0)
    camera = Camera(graph)
    camera.wait_matched()
    grids = graph.collect(OccupancyGrid, '/splatam/map/grid', LATCHED)
    for frame in frames:
        camera.send(replace(frame, depth_m=np.full_like(frame.depth_m, 2.0)))  # a wall
    node.wait_says('nothing is published on ~/map/grid', 'no floor was seen', 'set base_frame')
    served = get_map(graph, node)
    assert (served.info.width, served.info.height, len(served.data), grids) == (0, 0, 0, [])
    assert len([line for line in node.lines if '~/map/grid' in line]) == 1


def imu_message(stamp_ns: int, up: np.ndarray, shake: float = 0.0) -> Imu:
    acceleration = 9.81 * up + shake * np.array([1.0, -1.0, 1.0])
    message = Imu(header=stamps.header(MAKE, stamp_ns, CAMERA_FRAME))
    message.linear_acceleration = Vector3(**dict(zip('xyz', map(float, acceleration))))
    return message


def test_an_imu_at_rest_says_which_way_is_up(graph: Graph, frames: SyntheticSequence) -> None:
    """The map is that of a camera that looks downwards; the grid lies on the floor all the same."""
    node = run_node(graph, queue_policy='all', publish_rate__grid=0.0, grid__imu=True)
    camera, imu = Camera(graph), graph.publisher(Imu, '/imu')
    camera.wait_matched()
    graph.spin_until(imu.get_subscription_count)
    grids = graph.collect(OccupancyGrid, '/splatam/map/grid', LATCHED)
    T_room_cam = frames.ground_truth().T_world_cam[0]
    camera.send(frames[0])
    node.wait_says('nothing is published on ~/map/grid', 'the Imu on the topic imu has not rested yet')
    for stamp in range(frames[1].stamp_ns - 10**9, frames[1].stamp_ns, 10**7):
        imu.publish(imu_message(stamp, T_room_cam[:3, :3].T @ [0, 0, 1]))
    graph.spin_for(0.3)  # so that they arrive before the images
    for frame in frames:
        if frame.stamp_ns > frames[0].stamp_ns:
            camera.send(frame)
    graph.spin_until(lambda: grids and stamp_ns(grids[-1]) == frames[11].stamp_ns, explain=lambda: node.text)
    T_room_corner = T_room_cam @ poses.pose_matrix(grids[-1].info.origin)  # the map is the first camera
    # The pose at which the Imu is read is that of an image of 64x48 pixels, here 0.27 degrees off.
    assert np.degrees(np.arccos(T_room_corner[2, 2])) < 1 and abs(T_room_corner[2, 3]) < 0.05
    assert (cells(grids[-1]) == 0).sum() > 100


def test_only_an_imu_at_rest_is_believed() -> None:
    def up_after(message_stamps: range, shake: float, rate: float, asked_ns: int) -> np.ndarray | None:
        detector = RestDetector()
        for index, stamp in enumerate(message_stamps):
            jolt = shake * np.array([1.0, 1, 1]) * (-1) ** index
            detector.add(stamp, np.array([0, 0.6, 0.8]) * 9.8 + jolt, np.array([rate, 0, 0]))
        return detector.up_at(asked_ns)

    second = range(0, 10**9, 10**7)
    np.testing.assert_allclose(up_after(second, 0.0, 0.0, 8 * 10**8), [0, 0.6, 0.8], atol=1e-12)
    assert up_after(second, 0.05, 0.01, 10**9) is not None
    assert up_after(second, 0.3, 0.0, 10**9) is None  # shaken
    assert up_after(second, 0.0, 0.2, 10**9) is None  # turned
    assert up_after(second, 0.0, 0.0, 2 * 10**9) is None  # no longer known
    assert up_after(second, 0.0, 0.0, 10**8) is None  # nor yet
    assert up_after(range(0, 10**8, 10**6), 0.0, 0.0, 10**8) is None  # too short


def test_the_grid_lies_along_the_map() -> None:
    up, on_floor = np.array([0.0, -1, 0]), np.array([5.0, 1.2, 7.0])  # an optical world, 1.2 m over the floor
    T_grid_world = along_map(up, on_floor, np.eye(4))
    expected = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 1.2], [0, 0, 0, 1]])  # x right as the map's, y ahead
    np.testing.assert_allclose(T_grid_world, expected, atol=1e-12)
    T_world_map = np.array([[0.0, -1, 0, 0.5], [0, 0, -1, 1.2], [1, 0, 0, 2], [0, 0, 0, 1]])  # upright, on the floor
    np.testing.assert_allclose(along_map(up, on_floor, T_world_map), se3.inverse(T_world_map), atol=1e-12)
