"""From messages to frames: sizes, rectification, a changing camera, and warnings about input that may be wrong."""

from __future__ import annotations

import itertools
import struct
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
import pytest
from camera import CAMERA_FRAME, MAKE, QUICK, CompressedCamera, Live, position, still
from graph import Graph
from sensor_msgs.msg import CameraInfo, RegionOfInterest

from msg_adapters import camera_info, images, poses
from msg_adapters.camera_info import CameraParameters
from splatam_core.config import load_config
from splatam_core.datasets.synthetic import SyntheticSequence
from splatam_core.geometry.camera import CameraCalibration
from splatam_core.images.rectification import FrameFactory
from splatam_core.slam import Slam
from splatam_core.types import RgbdFrame
from splatam_ros.node.frame_assembler import FrameAssembler
from splatam_ros.node.gate import FrameGate
from splatam_ros.node.parameters import node_options
from splatam_ros.throttled_warnings import ThrottledWarnings

SECOND = 10**9
PARAMETERS = CameraParameters(64, 48, 55.0, 55.0, 31.5, 23.5, frame_id=CAMERA_FRAME)
RGB = np.zeros((48, 64, 3), np.uint8)
DEPTH = np.full((48, 64), 2.0, np.float32)
STILL_M = 0.04  # a pixel, at 64 pixels width and 2.5 m


@dataclass
class Bench:
    """A frame assembler, and what it logs."""

    assembler: FrameAssembler
    gate: FrameGate
    rejected: list[int]
    said: Callable[[], str]

    def feed(
        self, stamp_ns: int, *, info: CameraInfo | None = None, rgb: Any = RGB, depth_m: Any = DEPTH,
        depth_delay_ns: int = 0, depth_frame: str = CAMERA_FRAME,
    ) -> list[RgbdFrame]:  # fmt: skip
        frames = self.assembler.add_info(info or camera_info.info_message(MAKE, PARAMETERS, stamp_ns))
        frames += self.assembler.add_color(images.color_message(MAKE, rgb, stamp_ns, CAMERA_FRAME))
        return frames + self.assembler.add_depth(images.depth_message(MAKE, depth_m, stamp_ns + depth_delay_ns, depth_frame))


@pytest.fixture
def make_bench(graph: Graph, capfd: pytest.CaptureFixture[str]) -> Callable[..., Bench]:
    text = ['']

    def said() -> str:
        text[0] += ''.join(capfd.readouterr())
        return text[0]

    def make(**options: Any) -> Bench:
        gate = FrameGate(options.get('max_rate_hz', 0.0))
        rejected: list[int] = []
        warnings = ThrottledWarnings(graph.node.get_logger())
        assembler = FrameAssembler(node_options(options), warnings, gate, rejected.append)
        return Bench(assembler, gate, rejected, said)

    return make


def info(**changes: Any) -> CameraInfo:
    message = camera_info.info_message(MAKE, PARAMETERS, SECOND)
    for name, value in changes.items():
        setattr(message, name, value)
    return message


def test_binning_and_region_of_interest_are_applied(make_bench: Callable[..., Bench]) -> None:
    """A 160x120 camera, of which the driver sends every second pixel of 128x96 at (16, 12)."""
    message = info(
        width=160, height=120, binning_x=2, binning_y=2,
        k=[110.0, 0.0, 79.5, 0.0, 110.0, 59.5, 0.0, 0.0, 1.0],
    )  # fmt: skip
    message.roi.x_offset, message.roi.y_offset, message.roi.width, message.roi.height = 16, 12, 128, 96
    (frame,) = make_bench().feed(SECOND, info=message)
    c = frame.camera
    assert (c.width, c.height, c.fx, c.fy, c.cx, c.cy) == (64, 48, 55.0, 55.0, 31.5, 23.5)


COEFFICIENTS = [
    ('plumb_bob', [-0.2, 0.05, 0.001, -0.001, 0.0]),
    ('rational_polynomial', [0.3, 0.1, 0.0, 0.0, 0.02, 0.5, 0.1, 0.01]),
    ('equidistant', [0.1, -0.02, 0.0, 0.0]),
]


@pytest.mark.parametrize(('model', 'd'), COEFFICIENTS)
def test_images_are_rectified_unless_they_are_already(make_bench: Callable[..., Bench], model: str, d: list[float]) -> None:
    rgb = np.dstack([np.tile(np.arange(64, dtype=np.uint8) * 4, (48, 1))] * 3)
    message = info(distortion_model=model, d=d, p=np.array([50.0, 0, 30, 0, 0, 50, 20, 0, 0, 0, 1, 0]))
    (rectified,) = make_bench().feed(SECOND, info=message, rgb=rgb)
    (as_it_was,) = make_bench(undistort=False).feed(SECOND, info=message, rgb=rgb)
    assert (rectified.camera.fx, as_it_was.camera.fx, as_it_was.camera.cx) == (55.0, 50.0, 30.0)
    np.testing.assert_array_equal(as_it_was.rgb, rgb)
    k = np.array(message.k).reshape(3, 3)
    if model == 'equidistant':
        maps = cv2.fisheye.initUndistortRectifyMap(k, np.array(d), np.eye(3), k, (64, 48), cv2.CV_32FC1)
    else:
        maps = cv2.initUndistortRectifyMap(k, np.array(d), np.eye(3), k, (64, 48), cv2.CV_32FC1)
    np.testing.assert_array_equal(rectified.rgb, cv2.remap(rgb, *maps, cv2.INTER_LINEAR))
    assert not np.array_equal(rectified.rgb, rgb)


def test_maps_are_computed_once_a_camera(make_bench: Callable[..., Bench], monkeypatch: pytest.MonkeyPatch) -> None:
    calls = []
    compute = cv2.initUndistortRectifyMap
    monkeypatch.setattr(cv2, 'initUndistortRectifyMap', lambda *a: calls.append(a) or compute(*a))
    bench = make_bench()
    bent, more = ({'distortion_model': 'plumb_bob', 'd': [k1, 0.0, 0.0, 0.0, 0.0]} for k1 in (-0.2, -0.3))
    for number in range(3):
        assert bench.feed(SECOND * (1 + number), info=info(**bent))
    assert len(calls) == 1
    assert bench.feed(SECOND * 10, info=info(**more)) and len(calls) == 2


def test_camera_info_of_zeros_changes_nothing(make_bench: Callable[..., Bench]) -> None:
    bench = make_bench()
    zeros = {'k': [0.0] * 9, 'p': [0.0] * 12}
    assert bench.feed(SECOND, info=info(**zeros)) == []  # waits for a valid one
    first, second = bench.feed(2 * SECOND)
    assert (first.stamp_ns, second.stamp_ns) == (SECOND, 2 * SECOND)
    (frame,) = bench.feed(3 * SECOND, info=info(**zeros))
    assert frame.camera == first.camera
    assert 'CameraInfo skipped' in bench.said() and 'not calibrated' in bench.said()


def test_p_is_used_until_there_is_a_k(make_bench: Callable[..., Bench]) -> None:
    bench = make_bench()
    only_p = info(k=[0.0] * 9, d=[0.1] * 5, p=[60.0, 0.0, 31.5, 0.0, 0.0, 60.0, 23.5, 0.0, 0.0, 0.0, 1.0, 0.0])
    (frame,) = bench.feed(SECOND, info=only_p)
    assert frame.camera.fx == 60.0 and 'P is used, and the images are taken as rectified' in bench.said()
    (frame,) = bench.feed(2 * SECOND)
    assert frame.camera.fx == 55.0
    (frame,) = bench.feed(3 * SECOND, info=only_p)
    assert frame.camera.fx == 55.0 and 'CameraInfo skipped: K is all zero' in bench.said()


@pytest.mark.parametrize('model', ['None', 'kannala', ''])
def test_any_model_without_coefficients_is_no_distortion(make_bench: Callable[..., Bench], model: str) -> None:
    (frame,) = make_bench().feed(SECOND, info=info(distortion_model=model))
    assert frame.camera.fx == 55.0


def test_autofocus_does_not_change_the_camera_of_the_frames(make_bench: Callable[..., Bench]) -> None:
    bench = make_bench()
    frames = []
    for i in range(4):
        f = 55.0 + 0.3 * i
        frames += bench.feed((1 + i) * SECOND, info=info(k=[f, 0.0, 31.5, 0.0, f, 23.5, 0.0, 0.0, 1.0]))
    assert len(frames) == 4 and {frame.camera.fx for frame in frames} == {55.0}
    (other,) = bench.feed(6 * SECOND, info=info(k=[90.0, 0.0, 31.5, 0.0, 90.0, 23.5, 0.0, 0.0, 1.0]))
    assert other.camera.fx == 90.0
    (back,) = bench.feed(7 * SECOND, info=info(k=[55.5, 0.0, 31.5, 0.0, 55.5, 23.5, 0.0, 0.0, 1.0]))
    assert back.camera == frames[0].camera


def test_images_that_do_not_say_the_order_of_channels(make_bench: Callable[..., Bench]) -> None:
    rgb = np.random.default_rng(0).integers(0, 256, RGB.shape, np.uint8)

    def feed(bench: Bench) -> RgbdFrame:
        color = images.color_message(MAKE, rgb, SECOND, CAMERA_FRAME)
        color.encoding = '8UC3'
        bench.assembler.add_info(info())
        bench.assembler.add_color(color)
        (frame,) = bench.assembler.add_depth(images.depth_message(MAKE, DEPTH, SECOND, CAMERA_FRAME))
        return frame

    bench = make_bench(rgb_encoding='rgb8')
    np.testing.assert_array_equal(feed(bench).rgb, rgb)
    assert '8UC3' not in bench.said()
    np.testing.assert_array_equal(feed(make_bench()).rgb, rgb[..., ::-1])
    assert "encoding '8UC3'" in bench.said() and 'read as bgr8' in bench.said()


def test_depth_of_a_slow_camera_may_be_later(make_bench: Callable[..., Bench]) -> None:
    bench = make_bench()
    frames = []
    for i in range(6):
        frames += bench.feed(SECOND + i * 66_000_000, depth_delay_ns=30_000_000)
    assert len(frames + bench.assembler.flush()) == 6
    assert 'depth is +0.030 s from its colour' in bench.said()


def test_an_image_that_claims_a_huge_size_is_one_warning(make_bench: Callable[..., Bench]) -> None:
    bench = make_bench()
    jpeg = bytearray(cv2.imencode('.jpg', RGB)[1].tobytes())
    size = jpeg.index(b'\xff\xc0') + 5
    jpeg[size : size + 4] = struct.pack('>HH', 40000, 40000)
    message = images.compressed_color_message(MAKE, RGB, SECOND, CAMERA_FRAME)
    message.data = bytes(jpeg)
    bench.assembler.add_info(info())
    bench.assembler.add_color(message)
    assert bench.assembler.add_depth(images.depth_message(MAKE, DEPTH, SECOND, CAMERA_FRAME)) == []
    assert 'colour skipped: colour image is 40000x40000' in bench.said()
    assert len(bench.feed(2 * SECOND)) == 1


def test_depth_of_half_the_resolution_is_taken_other_shapes_are_refused(make_bench: Callable[..., Bench]) -> None:
    bench = make_bench()
    (frame,) = bench.feed(SECOND, depth_m=DEPTH[::2, ::2])
    assert frame.depth_m.shape == (48, 64) and (frame.depth_m == 2.0).all()
    assert bench.feed(2 * SECOND, depth_m=DEPTH[:36]) == []
    assert 'frame skipped: depth image is 64x36' in bench.said() and 'aligned_depth_to_color' in bench.said()


def test_colour_and_depth_that_are_far_apart_are_told_with_the_gap(make_bench: Callable[..., Bench]) -> None:
    bench = make_bench(sync_max_interval=0.1)
    bench.feed(SECOND, depth_delay_ns=19_000_000)
    bench.feed(2 * SECOND, depth_delay_ns=0)
    assert 'from its colour' not in bench.said()
    bench.feed(3 * SECOND, depth_delay_ns=-45_000_000)
    assert len(bench.assembler.flush()) == 1
    assert 'depth is -0.045 s from its colour' in bench.said()


def test_images_that_nobody_stamped_are_told_and_can_be_stamped_when_received(make_bench: Callable[..., Bench]) -> None:
    bench = make_bench()
    assert [len(bench.feed(0)) for _ in range(4)] == [1, 0, 0, 0]
    bench.assembler.report_drops()
    assert 'all stamps are equal: the driver does not stamp; use_receive_time takes the time of receiving instead' in bench.said()
    bench = make_bench(use_receive_time=True)
    frames = [frame for _ in range(3) for frame in bench.feed(0)] + bench.assembler.flush()
    assert len(frames) == 3 and 0 < frames[0].stamp_ns < frames[1].stamp_ns < frames[2].stamp_ns


def test_a_frame_that_cannot_be_used_is_answered(make_bench: Callable[..., Bench]) -> None:
    """A player used to wait for it until its time-out."""
    bench = make_bench()
    assert bench.feed(SECOND) and not bench.feed(2 * SECOND, rgb=RGB[:, :-1]) and bench.feed(3 * SECOND)
    assert bench.rejected == [2 * SECOND]


def test_images_of_different_frames_are_told(make_bench: Callable[..., Bench]) -> None:
    bench = make_bench()
    assert bench.feed(SECOND) and 'registered' not in bench.said()
    assert bench.feed(2 * SECOND, depth_frame='') and 'registered' not in bench.said()
    assert bench.feed(3 * SECOND, depth_frame='camera_depth_optical_frame')
    assert "depth is in frame 'camera_depth_optical_frame', colour in 'camera_optical_frame'" in bench.said()


def test_frames_that_the_gate_keeps_out_are_not_decoded(make_bench: Callable[..., Bench]) -> None:
    bench = make_bench()
    bench.gate.is_paused = True
    broken = images.color_message(MAKE, RGB, SECOND, '')
    broken.encoding = 'nv99'
    bench.feed(SECOND)
    bench.assembler.add_color(broken)
    assert bench.rejected == [SECOND] and 'skipped' not in bench.said()


def test_a_jump_back_begins_an_epoch(make_bench: Callable[..., Bench]) -> None:
    bench = make_bench(time_jump_threshold=10.0)
    epochs = [frame.epoch for second in (100, 101, 95, 50, 51) for frame in bench.feed(second * SECOND)]
    assert epochs == [0, 0, 1, 1]  # 95 is late, 50 has jumped


# --- over DDS ---


def padded(pixels: np.ndarray) -> dict[str, Any]:
    """Returns step and data of an image whose rows are padded by five bytes."""
    rows = np.ascontiguousarray(pixels).reshape(len(pixels), -1).view(np.uint8)
    rows = np.hstack([rows, np.full((len(rows), 5), 170, np.uint8)])
    return {'step': rows.shape[1], 'data': rows.tobytes()}


def uyvy(rgb: np.ndarray) -> np.ndarray:
    """[H, W, 2]: each two pixels share the colour of the first."""
    yuv = cv2.cvtColor(rgb, cv2.COLOR_RGB2YUV).astype(np.float32)
    luma = np.clip(yuv[..., 0] * 219 / 255 + 16, 16, 235)
    chroma = 128 + (yuv[..., 1:] - 128) * (224 / 255)  # BT.601 with headroom
    packed = np.empty((*luma.shape, 2), np.float32)
    packed[..., 1] = luma
    packed[:, 0::2, 0], packed[:, 1::2, 0] = chroma[:, 0::2, 0], chroma[:, 0::2, 1]
    return np.rint(np.clip(packed, 0, 255)).astype(np.uint8)


def bayer_rggb(rgb: np.ndarray) -> np.ndarray:
    mosaic = rgb[..., 1].copy()
    mosaic[0::2, 0::2], mosaic[1::2, 1::2] = rgb[0::2, 0::2, 0], rgb[1::2, 1::2, 2]
    return mosaic


def from_millimetres(counts: np.ndarray) -> np.ndarray:
    return counts.astype(np.float32) / np.float32(1000)


# By encoding: a function that encodes, and one that returns the expected decoded image.
COLOURS = {
    'bgr8': (lambda rgb: rgb[..., ::-1], lambda bgr: bgr[..., ::-1].copy()),
    'rgba8': (lambda rgb: np.dstack([rgb, np.full(rgb.shape[:2], 7, np.uint8)]), lambda rgba: rgba[..., :3].copy()),
    'bgra8': (lambda rgb: np.dstack([rgb[..., ::-1], rgb[..., :1]]), lambda bgra: bgra[..., 2::-1].copy()),
    'mono8': (lambda rgb: cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), lambda mono: np.dstack([mono] * 3)),
    'bayer_rggb8': (bayer_rggb, lambda mosaic: cv2.cvtColor(mosaic, cv2.COLOR_BayerRGGB2RGB)),
    'yuv422': (uyvy, lambda pixels: cv2.cvtColor(pixels, cv2.COLOR_YUV2RGB_UYVY)),
    'yuv422_yuy2': (
        lambda rgb: np.ascontiguousarray(uyvy(rgb)[..., ::-1]),
        lambda pixels: cv2.cvtColor(pixels, cv2.COLOR_YUV2RGB_YUYV),
    ),
}
DEPTHS = {
    '16UC1': (lambda depth_m: np.rint(depth_m * 1000).astype('<u2'), from_millimetres),
    'mono16': (lambda depth_m: np.rint(depth_m * 1000).astype('<u2'), from_millimetres),
    '16UC1 big-endian': (lambda depth_m: np.rint(depth_m * 1000).astype('>u2'), from_millimetres),
    '32FC1 big-endian': (lambda depth_m: depth_m.astype('>f4'), lambda depth_m: depth_m.astype(np.float32)),
}


class Twins:
    """A node, and the same SLAM without a node: if both find exactly the same poses, the node decodes correctly."""

    def __init__(self, graph: Graph, **options: Any) -> None:
        self.live = Live(graph, queue_policy='all', **options)
        self._slam = Slam(load_config('quick', QUICK))

    def assert_same(self, what: str, expected: RgbdFrame, sent: RgbdFrame | None = None, **changes: Any) -> None:
        """Checks that the node sees the sent frame as the expected one."""
        pose = self.live.show(sent or expected, **changes)
        assert pose is not None, f'{what}: {self.live.node.text}'
        T_world_cam = self._slam.process(expected).T_world_cam
        assert pose == poses.pose_stamped(MAKE, T_world_cam, expected.stamp_ns, 'map'), what


def test_poses_tell_views_apart(frames: SyntheticSequence) -> None:
    """The tests below rely on this: a small change of colour or depth changes the pose."""
    first, second = still(frames, 0), still(frames, 1)
    red_for_blue = replace(second, rgb=second.rgb[..., ::-1].copy())
    one_pixel = second.depth_m.copy()
    one_pixel[20, 30] += 0.002
    found = []
    for frame in (second, red_for_blue, replace(second, depth_m=one_pixel)):
        slam = Slam(load_config('quick', QUICK))
        slam.process(first)
        found.append(slam.process(frame).T_world_cam)
    assert not (np.array_equal(found[0], found[1]) or np.array_equal(found[0], found[2]))


def test_every_encoding_reaches_slam_as_the_same_view(graph: Graph, frames: SyntheticSequence) -> None:
    twins = Twins(graph)
    twins.assert_same('rgb8, 32FC1', still(frames, 0))
    for number, (encoding, (encode, decode)) in enumerate({**COLOURS, **DEPTHS}.items(), start=1):
        frame = still(frames, number)
        name, field = ('rgb', 'rgb') if encoding in COLOURS else ('depth', 'depth_m')
        pixels = encode(getattr(frame, field))
        changes = {'encoding': encoding.split()[0], 'is_bigendian': int('big' in encoding), **padded(pixels)}
        expected = replace(frame, **{field: decode(pixels)})
        twins.assert_same(encoding, expected, frame, **{f'{name}__{key}': value for key, value in changes.items()})


def part_of_a_larger_sensor(frame: RgbdFrame) -> dict[str, Any]:
    """Returns changes of CameraInfo: the frame is every second pixel of a part of a larger sensor."""
    c, x, y = frame.camera, 16, 12
    k = [2 * c.fx, 0.0, 2 * c.cx + 0.5 + x, 0.0, 2 * c.fy, 2 * c.cy + 0.5 + y, 0.0, 0.0, 1.0]
    roi = RegionOfInterest(x_offset=x, y_offset=y, width=2 * c.width, height=2 * c.height)
    return {
        'info__width': 2 * c.width + 40, 'info__height': 2 * c.height + 30, 'info__k': k, 'info__roi': roi,
        'info__binning_x': 2, 'info__binning_y': 2,
    }  # fmt: skip


def test_every_camera_reaches_slam_as_the_same_view(graph: Graph, frames: SyntheticSequence) -> None:
    """Lenses, parts of sensors, smaller depth, depth in other steps, late depth; a wrong camera would start a new map."""
    twins = Twins(graph, sync__max_interval=0.1, depth_scale=0.0002)  # which does not apply to 32FC1, in metres
    numbers = itertools.count()
    twins.assert_same('pinhole', still(frames, next(numbers)))
    for model, d in COEFFICIENTS:
        sent = still(frames, next(numbers))
        c = sent.camera
        pinhole = CameraParameters(c.width, c.height, c.fx, c.fy, c.cx, c.cy)
        parameters = replace(pinhole, distortion_model=model, distortion=tuple(d))
        factory = FrameFactory(CameraCalibration.from_intrinsics(parameters), None)  # tested against OpenCV
        expected = factory.make(sent.stamp_ns, sent.rgb, sent.depth_m)
        assert not np.array_equal(expected.rgb, sent.rgb)
        twins.assert_same(model, expected, sent, info__distortion_model=model, info__d=d)
    frame = still(frames, next(numbers))
    twins.assert_same('binning and region of interest', frame, **part_of_a_larger_sensor(frame))
    frame = still(frames, next(numbers))
    small = images.depth_message(MAKE, frame.depth_m[::2, ::2], frame.stamp_ns, CAMERA_FRAME)
    doubled = frame.depth_m[::2, ::2].repeat(2, axis=0).repeat(2, axis=1)
    fields = {f'depth__{field}': getattr(small, field) for field in ('width', 'height', 'step', 'data')}
    twins.assert_same('depth of half the resolution', replace(frame, depth_m=doubled), frame, **fields)
    frame = still(frames, next(numbers))
    counts = np.rint(frame.depth_m * 5000).astype('<u2')
    fields = {'depth__encoding': '16UC1', 'depth__step': 2 * counts.shape[1], 'depth__data': counts.tobytes()}
    expected = replace(frame, depth_m=counts.astype(np.float32) / np.float32(5000))
    twins.assert_same('depth in fifths of a millimetre', expected, frame, **fields)
    assert not twins.live.node.says('WARN')
    twins.assert_same('far apart', still(frames, next(numbers)), depth_delay_ns=45_000_000)
    twins.live.wait_says('WARN', 'depth is +0.045 s from its colour')


def test_every_compression_reaches_slam_as_the_same_view(graph: Graph, frames: SyntheticSequence) -> None:
    twins = Twins(graph, camera_class=CompressedCamera, **CompressedCamera.PARAMETERS)
    camera = twins.live.camera
    pairs = itertools.product(('jpeg', 'png'), ('16UC1', '32FC1'))  # the latter as inverse depth in steps
    for number, (camera.color, camera.depth) in enumerate(pairs):
        frame = still(frames, number)
        messages = camera.messages(frame, frame.stamp_ns)
        bgr = cv2.imdecode(np.frombuffer(messages['rgb'].data, np.uint8), cv2.IMREAD_COLOR)
        config = struct.unpack('<iff', bytes(messages['depth'].data[:12]))
        counts = cv2.imdecode(np.frombuffer(messages['depth'].data[12:], np.uint8), cv2.IMREAD_UNCHANGED)
        depth_m = from_millimetres(counts) if camera.depth == '16UC1' else np.float32(config[1]) / counts
        expected = replace(frame, rgb=bgr[..., ::-1].copy(), depth_m=depth_m.astype(np.float32))
        twins.assert_same(f'{camera.color}, {camera.depth}', expected, frame)
    assert not twins.live.node.says('WARN')


def test_a_camera_that_changes_starts_a_new_map(graph: Graph, frames: SyntheticSequence) -> None:
    live = Live(graph, save_path=graph.folder / 'run', queue_policy='all')
    assert live.show(still(frames, 0))
    other = still(frames, 1).camera
    changed = {'info__k': [other.fx * 1.1, 0.0, other.cx, 0.0, other.fy, other.cy, 0.0, 0.0, 1.0]}
    assert live.show(still(frames, 1), **changed) is None  # one CameraInfo may be wrong
    pose = live.show(still(frames, 2), **changed)
    assert pose is not None and not position(pose).any()
    assert live.node.says('map reset: the camera changed', 'previous')
