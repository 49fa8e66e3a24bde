"""Tiny copies of every dataset's layout, from the dataset's own documentation (cited in each reader's module).

The frames are those of the synthetic room, so that poses, depth and cameras are known exactly. What a layout says
differently from OpenCV (axes, units, sizes, numbers that do not start at 0) is said here in its own way, not with the
readers' code.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from rosbags import rosbag1
from rosbags.typesys import Stores, get_typestore

from splatam_core.datasets.convert import write_bag
from splatam_core.datasets.room import build_room
from splatam_core.datasets.synthetic import SyntheticSequence, Walk
from splatam_core.geometry import se3
from splatam_core.geometry.camera import PinholeCamera

CAMERA = PinholeCamera(96, 72, 79.0, 78.0, 47.2, 35.9)
FRAMES = (0, 6, 12)  # of the walk: 0.2 s apart, some centimetres and degrees
ROOM, WALK = build_room(0), Walk.of(0)
FLIP_Y_AND_Z = np.diag([1.0, -1.0, -1.0, 1.0])


@dataclass(frozen=True)
class Shot:
    """A frame: colour [H, W, 3] uint8, depth [H, W] metres, and pose (camera to world)."""

    rgb: NDArray[np.uint8]
    depth_m: NDArray[np.float32]
    T_world_cam: NDArray[np.float64]


def shoot(camera: PinholeCamera = CAMERA, frames: tuple[int, ...] = FRAMES) -> list[Shot]:
    poses = [WALK.pose(frame) for frame in frames]
    return [Shot(ROOM.color(camera, T), ROOM.cast(camera, T).depth_m, T) for T in poses]


SHOTS = shoot()


@dataclass(frozen=True)
class Layout:
    """How a dataset stores frames.

    Attributes:
        format: the reader that must recognise it.
        write: writes it into an empty folder, returns the SOURCE.
        truth: pattern of the files with poses; without them there must be frames all the same.
        depth: a depth image without which there must be an error that names the folder.
        step_m: depth is stored in steps of this.
        camera: of the frames as they are read.
        is_exact: whether pixels are read as they were stored, not moved or compressed.
        depth_pixel: width of a stored depth pixel in pixels of the camera.
        numbers: of the frames, counting at ``rate_hz``.
        options: what to read it with.
    """

    format: str
    write: Callable[[Path], Path]
    truth: str | None = None
    depth: str | None = None
    step_m: float = 1e-3
    camera: PinholeCamera = CAMERA
    is_exact: bool = True
    depth_pixel: float = 1.0
    numbers: tuple[int, ...] = (0, 1, 2)
    rate_hz: int = 30
    options: dict[str, object] = field(default_factory=dict)


# --- files ---


def save(path: Path, image: NDArray[np.uint8 | np.uint16]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), image)


def save_color(path: Path, rgb: NDArray[np.uint8]) -> None:
    save(path, cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR))


def save_depth(path: Path, depth_m: NDArray[np.float32], scale: float) -> None:
    save(path, np.rint(depth_m.astype(np.float64) * scale).astype(np.uint16))


def save_text(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)


def numbers(matrix: NDArray[np.float64]) -> str:
    return ' '.join(repr(float(value)) for value in matrix.reshape(-1))


def rows(matrix: NDArray[np.float64]) -> str:
    return '\n'.join(numbers(row) for row in matrix) + '\n'


def tum_pose(T: NDArray[np.float64]) -> str:
    w, x, y, z = se3.quaternion_from_rotation(T[:3, :3])
    return numbers(np.array([*T[:3, 3], x, y, z, w]))


def camera_yaml(folder: Path, camera: PinholeCamera = CAMERA, **more: object) -> None:
    c = camera
    stated = {'width': c.width, 'height': c.height, 'fx': c.fx, 'fy': c.fy, 'cx': c.cx, 'cy': c.cy, **more}
    save_text(folder / 'camera.yaml', '\n'.join(f'{key}: {value}' for key, value in stated.items()))


def nerfstudio_camera(camera: PinholeCamera) -> dict[str, float]:
    c = camera
    return {'w': c.width, 'h': c.height, 'fl_x': c.fx, 'fl_y': c.fy, 'cx': c.cx, 'cy': c.cy}


def opengl(T: NDArray[np.float64]) -> list[list[float]]:
    """Convert to the axes of ARKit and nerfstudio: the camera looks along -z, y is up."""
    return (T @ FLIP_Y_AND_Z).tolist()


# --- layouts ---


def write_tum(folder: Path) -> Path:
    stamps = [f'{1305031102.175304 + 0.033 * index:.6f}' for index in range(len(SHOTS))]
    for stamp, shot in zip(stamps, SHOTS, strict=True):
        save_color(folder / f'rgb/{stamp}.png', shot.rgb)
        save_depth(folder / f'depth/{stamp}.png', shot.depth_m, 5000)
    for name in ('rgb', 'depth'):
        save_text(folder / f'{name}.txt', '# list\n' + '\n'.join(f'{stamp} {name}/{stamp}.png' for stamp in stamps))
    lines = [f'{stamp} {tum_pose(shot.T_world_cam)}' for stamp, shot in zip(stamps, SHOTS, strict=True)]
    save_text(folder / 'groundtruth.txt', '\n'.join(lines))
    camera_yaml(folder)
    return folder


def write_sevenscenes(folder: Path) -> Path:
    for index, shot in enumerate(SHOTS):
        save_color(folder / f'frame-{index:06d}.color.png', shot.rgb)
        save_depth(folder / f'frame-{index:06d}.depth.png', shot.depth_m, 1000)
        save_text(folder / f'frame-{index:06d}.pose.txt', rows(shot.T_world_cam))
    save_text(folder / 'camera-intrinsics.txt', rows(CAMERA.matrix))
    return folder


def write_replica(folder: Path) -> Path:
    c, room = CAMERA, folder / 'room0'
    for index, shot in enumerate(SHOTS):
        save_color(room / f'results/frame{index:06d}.jpg', shot.rgb)
        save_depth(room / f'results/depth{index:06d}.png', shot.depth_m, 6553.5)
    save_text(room / 'traj.txt', '\n'.join(numbers(shot.T_world_cam) for shot in SHOTS))
    camera = {'w': c.width, 'h': c.height, 'fx': c.fx, 'fy': c.fy, 'cx': c.cx, 'cy': c.cy, 'scale': 6553.5}
    save_text(folder / 'cam_params.json', json.dumps({'camera': camera}))
    return room


def write_replica_v2(folder: Path) -> Path:
    walks = {'00': SHOTS, '01': SHOTS[::-1]}
    for name, shots in walks.items():
        for index, shot in enumerate(shots):
            save_color(folder / f'imap/{name}/rgb/rgb_{index}.png', shot.rgb)
            save_depth(folder / f'imap/{name}/depth/depth_{index}.png', shot.depth_m, 1000)
        save_text(folder / f'imap/{name}/traj_w_c.txt', '\n'.join(numbers(shot.T_world_cam) for shot in shots))
    camera_yaml(folder)
    return folder


COLOR_CAMERA = PinholeCamera(144, 108, 118.5, 117.0, 71.3, 54.1)
DEPTH_CAMERA = PinholeCamera(96, 72, 80.3, 79.6, 46.1, 36.8)


def write_scannet(folder: Path, inside: str = '.') -> Path:
    """Colour is larger than depth, and each of the two cameras has its own calibration."""
    frames = folder / inside
    pairs = zip(shoot(COLOR_CAMERA), shoot(DEPTH_CAMERA), strict=True)
    for index, (color, depth) in enumerate(pairs):
        save_color(frames / f'color/{index}.jpg', color.rgb)
        save_depth(frames / f'depth/{index}.png', depth.depth_m, 1000)
        save_text(frames / f'pose/{index}.txt', rows(color.T_world_cam))
    for name, camera in (('color', COLOR_CAMERA), ('depth', DEPTH_CAMERA)):
        K = np.eye(4)
        K[:3, :3] = camera.matrix
        save_text(frames / f'intrinsic/intrinsic_{name}.txt', rows(K))
        save_text(frames / f'intrinsic/extrinsic_{name}.txt', rows(np.eye(4)))
    return folder


def write_scannetpp(folder: Path) -> Path:
    """The lists have the order of the frames, the JSON file has not."""
    shots = {'train': SHOTS, 'test': SHOTS[::-1]}
    first = {'train': 7, 'test': 90}
    names = {split: [f'DSC0{first[split] + index:04d}.JPG' for index in range(3)] for split in first}
    dslr, listed = folder / 'dslr', {}
    for split, key in (('train', 'frames'), ('test', 'test_frames')):
        for name, shot in zip(names[split], shots[split], strict=True):
            save_color(dslr / f'undistorted_images/{name}', shot.rgb)
            save_depth(dslr / f'undistorted_depths/{Path(name).stem}.png', shot.depth_m, 1000)
        frames = [
            {'file_path': name, 'mask_path': 'none', 'is_bad': index == 1, 'transform_matrix': opengl(shot.T_world_cam)}
            for index, (name, shot) in enumerate(zip(names[split], shots[split], strict=True))
        ]
        listed[key] = frames[::-1]
    save_text(dslr / 'train_test_lists.json', json.dumps({**names, 'has_masks': True}))
    transforms = {**nerfstudio_camera(CAMERA), 'camera_model': 'OPENCV', 'k1': 0.0, 'k2': 0.0, **listed}
    save_text(dslr / 'nerfstudio/transforms_undistorted.json', json.dumps(transforms))
    return folder


FOCI = [CAMERA, replace(CAMERA, fx=80.5, fy=79.5, cx=47.9), replace(CAMERA, fx=78.1, fy=77.1, cy=35.2)]
"""The camera of each frame: the intrinsics change because the lens focuses."""


def focused_shots() -> list[Shot]:
    return [shoot(camera, (frame,))[0] for camera, frame in zip(FOCI, FRAMES, strict=True)]


def half(depth_m: NDArray[np.float32], camera: PinholeCamera, frame: int) -> NDArray[np.float32]:
    """The same view from a depth sensor of half the size."""
    return shoot(camera.resized(camera.width // 2, camera.height // 2), (frame,))[0].depth_m


def write_scannetpp_iphone(folder: Path) -> Path:
    iphone, stated = folder / 'iphone', {}
    for number, (camera, frame, shot) in zip((0, 10, 20), zip(FOCI, FRAMES, focused_shots(), strict=True), strict=True):
        name = f'frame_{number:06d}'
        save_color(iphone / f'rgb/{name}.jpg', shot.rgb)
        save_depth(iphone / f'depth/{name}.png', half(shot.depth_m, camera, frame), 1000)
        stated[name] = {
            'timestamp': number / 60, 'pose': opengl(shot.T_world_cam), 'aligned_pose': shot.T_world_cam.tolist(),
            'intrinsic': camera.matrix.tolist(), 'imu': {},
        }  # fmt: skip
    save_text(iphone / 'pose_intrinsic_imu.json', json.dumps(stated))
    return iphone


def write_nerfcapture(folder: Path) -> Path:
    frames = []
    for index, (camera, shot) in enumerate(zip(FOCI, focused_shots(), strict=True)):
        save_color(folder / f'rgb/{index}.png', shot.rgb)
        save_depth(folder / f'depth/{index}.png', shot.depth_m, 65535 / 10)
        frames.append(
            {
                'transform_matrix': opengl(shot.T_world_cam), 'file_path': f'rgb/{index}.png',
                'depth_path': f'depth/{index}.png', **nerfstudio_camera(camera),
            }
        )  # fmt: skip
    top = {**nerfstudio_camera(CAMERA), 'integer_depth_scale': 10 / 65535, 'frames': frames}
    save_text(folder / 'transforms.json', json.dumps(top))
    return folder


def write_record3d(folder: Path) -> Path:
    import OpenEXR

    poses = []
    for index, (camera, frame, shot) in enumerate(zip(FOCI, FRAMES, focused_shots(), strict=True)):
        save_color(folder / f'rgb/{index}.jpg', shot.rgb)
        (folder / 'depth').mkdir(exist_ok=True)
        depth_m = half(shot.depth_m, camera, frame)
        with OpenEXR.File({'type': OpenEXR.scanlineimage}, {'R': np.ascontiguousarray(depth_m)}) as file:
            file.write(str(folder / f'depth/{index}.exr'))
        T = np.array(opengl(shot.T_world_cam))
        w, *xyz = se3.quaternion_from_rotation(T[:3, :3])
        poses.append([*map(float, xyz), float(w), *T[:3, 3].tolist()])
    metadata = {
        'w': CAMERA.width, 'h': CAMERA.height, 'dw': 48, 'dh': 36, 'fps': 60, 'poses': poses,
        'K': CAMERA.matrix.T.reshape(-1).tolist(),
        'perFrameIntrinsicCoeffs': [[camera.fx, camera.fy, camera.cx, camera.cy] for camera in FOCI],
    }  # fmt: skip
    save_text(folder / 'metadata.json', json.dumps(metadata))
    return folder


def write_icl(folder: Path) -> Path:
    """POV-Ray's world and camera are left-handed, y up: our point (x, y, z) is (x, -y, z) there."""
    mirror, lines = np.diag([1.0, -1.0, 1.0, 1.0]), []
    for number, shot in enumerate(SHOTS, 1):
        save_color(folder / f'rgb/{number}.png', shot.rgb)
        save_depth(folder / f'depth/{number}.png', shot.depth_m, 5000)
        lines.append(f'{number} {tum_pose(mirror @ shot.T_world_cam @ mirror)}')
    save_text(folder / 'livingRoom2.gt.freiburg', '\n'.join(lines))
    save_text(folder / 'associations.txt', '\n'.join(f'{n} depth/{n}.png {n} rgb/{n}.png' for n in (1, 2, 3)))
    camera_yaml(folder)
    return folder


def write_images(folder: Path, color: str, shots: list[Shot] = SHOTS, scale: float = 1000) -> None:
    for index, shot in enumerate(shots):
        save_color(folder / color.format(index), shot.rgb)
        save_depth(folder / f'depth/{index:05d}.png', shot.depth_m, scale)


def write_plain(folder: Path) -> Path:
    write_images(folder, 'rgb/frame{:05d}.png', scale=4000)
    for index, shot in enumerate(SHOTS):
        save_text(folder / f'poses/{index:05d}.txt', rows(shot.T_world_cam))
    camera_yaml(folder, depth_scale=4000)
    return folder


def write_azure(folder: Path) -> Path:
    """Open3D's Azure Kinect export, with a trajectory log in Redwood's format."""
    write_images(folder, 'color/{:05d}.jpg')
    c = CAMERA
    K = [c.fx, 0, 0, 0, c.fy, 0, c.cx, c.cy, 1]
    save_text(folder / 'intrinsic.json', json.dumps({'width': c.width, 'height': c.height, 'intrinsic_matrix': K}))
    blocks = [f'{index} {index} {index + 1}\n{rows(shot.T_world_cam)}' for index, shot in enumerate(SHOTS)]
    save_text(folder / 'trajectory.log', ''.join(blocks))
    return folder


def write_ai2thor(folder: Path) -> Path:
    write_images(folder, 'color/{}.png')
    for index, shot in enumerate(SHOTS):
        save_text(folder / f'pose/{index}.txt', rows(shot.T_world_cam))
    save_text(folder / 'intrinsics.txt', rows(CAMERA.matrix))
    return folder


def write_realsense(folder: Path) -> Path:
    write_images(folder, 'rgb/{:05d}.jpg')
    (folder / 'poses').mkdir()
    for index, shot in enumerate(SHOTS):
        np.save(folder / f'poses/{index:05d}.npy', np.array(opengl(shot.T_world_cam)))
    camera_yaml(folder, pose_axes='opengl')
    return folder


DISTORTION = (0.12, -0.2, 0.002, -0.003, 0.05)


def write_distorted(folder: Path) -> Path:
    """A lens with some pixels of distortion: each pixel is sampled from a larger ideal image along its ray."""
    c = CAMERA
    large = PinholeCamera(6 * c.width, 6 * c.height, 4 * c.fx, 4 * c.fy, 3.0 * c.width, 3.0 * c.height)
    u, v = np.meshgrid(np.arange(float(c.width)), np.arange(float(c.height)))
    pixels = np.stack([u, v], axis=-1).reshape(-1, 1, 2)
    x, y = cv2.undistortPoints(pixels, c.matrix, np.array(DISTORTION)).reshape(c.height, c.width, 2).transpose(2, 0, 1)
    at = (x * large.fx + large.cx).astype(np.float32), (y * large.fy + large.cy).astype(np.float32)
    bent = [
        Shot(cv2.remap(s.rgb, *at, cv2.INTER_LINEAR), cv2.remap(s.depth_m, *at, cv2.INTER_NEAREST), s.T_world_cam)
        for s in shoot(large)
    ]
    write_images(folder, 'images/{:05d}.png', bent)
    save_text(folder / 'traj.txt', '\n'.join(numbers(shot.T_world_cam) for shot in SHOTS))
    camera_yaml(folder, distortion_model='plumb_bob', distortion=list(DISTORTION))
    return folder


class InMemory:
    """The frames as a sequence, from which bags are written."""

    name, depth_scale = 'room', 1000.0
    camera = CAMERA

    def __init__(self) -> None:
        self._like = SyntheticSequence(frames=3, width=CAMERA.width)

    def __len__(self) -> int:
        return len(SHOTS)

    def __getitem__(self, index: int):
        depth_m = np.rint(1000 * SHOTS[index].depth_m).astype(np.float32) / np.float32(1000)
        return replace(self._like[index], rgb=SHOTS[index].rgb, depth_m=depth_m, camera=CAMERA)

    def ground_truth(self):
        truth = self._like.ground_truth()
        return replace(truth, T_world_cam=np.stack([shot.T_world_cam for shot in SHOTS]))


def write_rosbag2(folder: Path) -> Path:
    write_bag(InMemory(), folder / 'bag')
    return folder / 'bag'


def write_rosbag1(folder: Path, camera: str = '/camera') -> Path:
    """With the topic names of the RealSense driver of ROS 1; written by rosbags' ROS 1 writer."""
    types = get_typestore(Stores.ROS1_NOETIC)
    make = lambda name, *values: types.types[name](*values)  # noqa: E731
    topics = {
        f'{camera}/color/camera_info': 'sensor_msgs/msg/CameraInfo',
        f'{camera}/color/image_raw': 'sensor_msgs/msg/Image',
        f'{camera}/aligned_depth_to_color/image_raw': 'sensor_msgs/msg/Image',
        '/ground_truth/pose': 'geometry_msgs/msg/PoseStamped',
    }
    path, sequence, c = folder / 'room.bag', InMemory(), CAMERA
    closed = rosbag1.Writer(path)
    closed.set_compression(rosbag1.Writer.CompressionFormat.LZ4)
    with closed as writer:
        connections = {topic: writer.add_connection(topic, kind, typestore=types) for topic, kind in topics.items()}
        for index, shot in enumerate(SHOTS):
            frame = sequence[index]
            stamp = make('builtin_interfaces/msg/Time', *divmod(frame.stamp_ns, 1_000_000_000))
            header = make('std_msgs/msg/Header', index, stamp, 'camera')
            roi = make('sensor_msgs/msg/RegionOfInterest', 0, 0, 0, 0, False)
            P = np.hstack([c.matrix, np.zeros((3, 1))]).reshape(-1)
            millimetres = np.rint(1000 * frame.depth_m).astype(np.uint16)
            w, x, y, z = se3.quaternion_from_rotation(shot.T_world_cam[:3, :3])
            position = make('geometry_msgs/msg/Point', *shot.T_world_cam[:3, 3])
            orientation = make('geometry_msgs/msg/Quaternion', x, y, z, w)
            messages = (
                make(
                    'sensor_msgs/msg/CameraInfo', header, c.height, c.width, 'plumb_bob', np.zeros(5),
                    c.matrix.reshape(-1), np.eye(3).reshape(-1), P, 0, 0, roi,
                ),
                make('sensor_msgs/msg/Image', header, 72, 96, 'rgb8', 0, 288, frame.rgb.reshape(-1)),
                make('sensor_msgs/msg/Image', header, 72, 96, '16UC1', 0, 192, millimetres.view(np.uint8).reshape(-1)),
                make(
                    'geometry_msgs/msg/PoseStamped', header, make('geometry_msgs/msg/Pose', position, orientation)
                ),
            )  # fmt: skip
            for (topic, kind), message in zip(topics.items(), messages, strict=True):
                writer.write(connections[topic], frame.stamp_ns, types.serialize_ros1(message, kind))
    return path


LAYOUTS = {
    'tum': Layout('tum', write_tum, 'groundtruth.txt', step_m=1 / 5000),
    'sevenscenes': Layout('sevenscenes', write_sevenscenes, '*.pose.txt', 'frame-000001.depth.png'),
    'replica': Layout('replica', write_replica, 'traj.txt', 'results/depth000001.png', 1 / 6553.5),
    'replica_v2 train': Layout('replica_v2', write_replica_v2, 'imap/00/traj_w_c.txt', 'imap/00/depth/depth_1.png'),
    'replica_v2 test': Layout(
        'replica_v2', write_replica_v2, 'imap/01/traj_w_c.txt', 'imap/01/depth/depth_1.png', options={'split': 'test'}
    ),
    'scannet': Layout('scannet', write_scannet, 'pose/*.txt', 'depth/1.png', camera=COLOR_CAMERA, is_exact=False),
    'scannet frames': Layout(
        'scannet', lambda folder: write_scannet(folder, 'frames'), 'frames/pose/*.txt', 'frames/depth/1.png',
        camera=COLOR_CAMERA, is_exact=False,
    ),
    'scannetpp train': Layout('scannetpp', write_scannetpp, None, 'dslr/undistorted_depths/DSC00008.png'),
    'scannetpp test': Layout(
        'scannetpp', write_scannetpp, None, 'dslr/undistorted_depths/DSC00091.png', options={'split': 'test'}
    ),
    'scannetpp_iphone': Layout(
        'scannetpp_iphone', write_scannetpp_iphone, None, 'depth/frame_000010.png', is_exact=False, depth_pixel=2,
        numbers=(0, 10, 20), rate_hz=60,
    ),
    'nerfcapture': Layout('nerfcapture', write_nerfcapture, None, None, 1 / 6553.5, is_exact=False),
    'record3d': Layout('record3d', write_record3d, None, 'depth/1.exr', 0.0, is_exact=False, depth_pixel=2, rate_hz=60),
    'icl': Layout('icl', write_icl, '*.gt.freiburg', 'depth/2.png', 1 / 5000),
    'folder': Layout('folder', write_plain, 'poses/*.txt', 'depth/00001.png', 1 / 4000),
    'folder azure': Layout('folder', write_azure, 'trajectory.log', 'depth/00001.png'),
    'folder ai2thor': Layout('folder', write_ai2thor, 'pose/*.txt', 'depth/00001.png'),
    'folder realsense': Layout('folder', write_realsense, 'poses/*.npy', 'depth/00001.png'),
    'folder distorted': Layout('folder', write_distorted, 'traj.txt', 'depth/00001.png', is_exact=False),
    'rosbag2': Layout('rosbag', write_rosbag2),
    'rosbag1': Layout('rosbag', write_rosbag1),
}  # fmt: skip
