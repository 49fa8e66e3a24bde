"""Folders as people bring them: recordings of a textured wall that are correct, odd or partly damaged.

The wall is a metre away. The camera has a focal length of 140 pixels and moves by a pixel, 1/140 m, from frame to frame.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import cv2
import numpy as np

WIDTH, HEIGHT, FOCAL, FRAMES = 160, 120, 140.0, 8
CENTRE = (WIDTH - 1) / 2, (HEIGHT - 1) / 2
K_TEXT = f'{FOCAL} 0 {CENTRE[0]}\n0 {FOCAL} {CENTRE[1]}\n0 0 1\n'
FIRST_S, PERIOD_S = 1403636579.25, 1 / 32  # exact in binary and decimal
LFS_POINTER = b'version https://git-lfs.github.com/spec/v1\noid sha256:4d7a214614ab\nsize 12345\n'


def wall() -> np.ndarray:
    """Colour of the whole wall: smooth noise, [H, W, 3] uint8."""
    noise = np.random.default_rng(7).uniform(0, 255, (HEIGHT, WIDTH + FRAMES, 3)).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 2)
    return cv2.normalize(smooth, None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)


WALL = wall()


def write_color(path: Path, frame: int) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), WALL[:, frame : frame + WIDTH, ::-1])


def write_depth(path: Path, counts_per_metre: float, shrink: int = 1) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    counts = np.full((HEIGHT // shrink, WIDTH // shrink), round(counts_per_metre), np.uint16)
    assert cv2.imwrite(str(path), counts)


def stamps(unit: int = 1, first_s: float = FIRST_S, form: str = '{}') -> list[str]:
    """The frames' stamps as text. unit: how many make a second."""
    seconds = [first_s + PERIOD_S * frame for frame in range(FRAMES)]
    return [form.format(round(Fraction(second) * unit) if unit > 1 else second) for second in seconds]


def pose_lines(texts: Sequence[str], between: str = ' ') -> list[str]:
    """True poses: x grows by a pixel's width a frame."""
    return [between.join([text, f'{frame / FOCAL:.6f}', *'000001']) for frame, text in enumerate(texts)]


def camera_yaml(folder: Path, depth_scale: float | None = 5000) -> None:
    lines = [f'width: {WIDTH}', f'height: {HEIGHT}', f'fx: {FOCAL}', f'fy: {FOCAL}', f'cx: {CENTRE[0]}', f'cy: {CENTRE[1]}']
    lines += [] if depth_scale is None else [f'depth_scale: {depth_scale}']
    (folder / 'camera.yaml').write_text('\n'.join(lines) + '\n')


def tum(folder: Path, texts: Sequence[str] | None = None, encoding: str = 'utf-8', newline: str = '\n') -> Path:
    """Lists of colour and depth, as the TUM dataset has them."""
    texts = stamps() if texts is None else texts
    for frame in range(FRAMES):
        write_color(folder / f'rgb/{frame}.png', frame)
        write_depth(folder / f'depth/{frame}.png', 5000)
    for name in ('rgb', 'depth'):
        lines = ['# stamp file', *(f'{text} {name}/{frame}.png' for frame, text in enumerate(texts))]
        (folder / f'{name}.txt').write_bytes((newline.join(lines) + newline).encode(encoding))
    camera_yaml(folder)
    return folder


def with_truth(folder: Path, lines: Sequence[str], texts: Sequence[str] | None = None) -> Path:
    tum(folder, texts)
    (folder / 'groundtruth.txt').write_text('\n'.join(lines) + '\n')
    return folder


def fourth_pose(change: Callable[[str, str], str]) -> Callable[[Path], Path]:
    """A truth whose fourth line is another one. change: makes it of the line's stamp and pose."""

    def write(folder: Path) -> Path:
        lines = pose_lines(stamps())
        lines[3] = change(*lines[3].split(maxsplit=1))
        return with_truth(folder, lines)

    return write


def wrong_stamp(stamp: str) -> Callable[[Path], Path]:
    """A truth whose fourth pose has another stamp."""
    return fourth_pose(lambda _, pose: f'{stamp} {pose}')


def metres_per_count(folder: Path) -> Path:
    """The unit of depth as the node's parameter states it."""
    tum(folder)
    camera_yaml(folder, depth_scale=0.0002)
    return folder


def unknown(text: str) -> Callable[[Path], Path]:
    """A truth whose fourth pose is unknown. text: what stands for it after the stamp."""
    return fourth_pose(lambda stamp, _: f'{stamp} {text}')


def numbered(folder: Path) -> Path:
    """A 7-Scenes folder: numbers in the names, a pose for each frame."""
    for frame in range(FRAMES):
        stem = folder / f'frame-{frame:06d}'
        write_color(stem.with_suffix('.color.png'), frame)
        write_depth(stem.with_suffix('.depth.png'), 1000)
        pose = np.eye(4)
        pose[0, 3] = frame / FOCAL
        np.savetxt(stem.with_suffix('.pose.txt'), pose)
    (folder / 'camera-intrinsics.txt').write_text(K_TEXT)
    return folder


def associations(folder: Path, line: str = '{t} rgb/{i}.png {t} depth/d{i}.png', name: str = 'associations.txt') -> Path:
    """An own camera in ORB-SLAM's form; names of depth do not have colour's numbers."""
    for frame in range(FRAMES):
        write_color(folder / f'rgb/{frame}.png', frame)
        write_depth(folder / f'depth/d{frame}.png', 1000)
    rows = [line.format(t=f'{frame * PERIOD_S}', i=frame) for frame in range(FRAMES)]
    (folder / name).write_text('\n'.join(rows) + '\n')
    (folder / 'intrinsics.txt').write_text(K_TEXT)
    return folder


def nerfcapture(folder: Path, color: str = 'images/{}.png', depth: str = 'images/{}.depth.png', listed: str = '') -> Path:
    """NeRFCapture without a connection: pictures beside each other, depth of half the size."""
    frames = []
    for frame in range(FRAMES):
        write_color(folder / color.format(frame), frame)
        write_depth(folder / depth.format(frame), 6553.5, shrink=2)
        pose = np.diag([1.0, -1.0, -1.0, 1.0])
        pose[0, 3] = frame / FOCAL
        paths = {'file_path': (listed or color).format(frame), 'depth_path': depth.format(frame)}
        frames.append({**paths, 'transform_matrix': pose.tolist(), 'timestamp': frame * PERIOD_S})
    top = {'fl_x': FOCAL, 'fl_y': FOCAL, 'cx': CENTRE[0], 'cy': CENTRE[1], 'w': WIDTH, 'h': HEIGHT}
    (folder / 'transforms.json').write_text(json.dumps({**top, 'integer_depth_scale': 10 / 65535, 'frames': frames}))
    return folder


def replaced(write: Callable[[Path], Path], name: str, data: bytes | None) -> Callable[[Path], Path]:
    """A folder of which one file has other bytes, or is missing."""

    def write_replaced(folder: Path) -> Path:
        path = write(folder) / name
        path.unlink() if data is None else path.write_bytes(data)
        return folder

    return write_replaced


@dataclass(frozen=True)
class Brought:
    """A folder that somebody brings.

    Attributes:
        write: writes it into an empty folder.
        format: the reader that it is for.
        says: what is said in a warning, as a pattern; empty where nothing is.
        unreadable: the frames that cannot be read.
        truth: number of true poses; None where there is no ground truth.
    """

    write: Callable[[Path], Path]
    format: str = 'tum'
    says: str = ''
    unreadable: tuple[int, ...] = ()
    truth: int | None = None


MILLIMETRES = 'depth is taken as millimetres'
ONE_UNKNOWN = r'groundtruth\.txt: of 8 lines with poses these are left out: 1 unknown'
ONE_STRAY = r'groundtruth\.txt: of 8 lines with poses these are left out: 1 with a stamp that contradicts those around it'

FOLDERS = {
    'associations': Brought(associations, says=MILLIMETRES),
    'associations, depth first': Brought(lambda f: associations(f, '{t} depth/d{i}.png {t} rgb/{i}.png'), says=MILLIMETRES),
    'associations, another name': Brought(lambda f: associations(f, name='associated.txt'), says=MILLIMETRES),
    'truth nan': Brought(unknown('nan nan nan nan nan nan nan'), says=ONE_UNKNOWN, truth=7),
    'truth inf': Brought(unknown('-inf -inf -inf 0 0 0 1'), says=ONE_UNKNOWN, truth=7),
    'truth without rotation': Brought(unknown('0 0 0 0 0 0 0'), says=ONE_UNKNOWN, truth=7),
    'truth with a tiny quaternion': Brought(unknown('0 0 0 1e-200 0 0 0'), says=ONE_UNKNOWN, truth=7),
    'truth far away': Brought(unknown('1e300 0 0 0 0 0 1'), says=ONE_UNKNOWN, truth=7),
    'truth None': Brought(unknown('None None None None None None None'), says=ONE_UNKNOWN, truth=7),
    'truth torn': Brought(unknown('0.02 0'), says='these are left out: 1 no poses', truth=7),
    'truth, a stamp twice': Brought(
        lambda f: with_truth(f, [*pose_lines(stamps()), pose_lines(stamps())[-1]]), says='1 of a stamp that is there', truth=8
    ),
    'truth, a stamp a day ahead': Brought(wrong_stamp(stamps(first_s=FIRST_S + 86400)[3]), says=ONE_STRAY, truth=7),
    'truth, a stamp of zero': Brought(wrong_stamp('0'), says=ONE_STRAY, truth=7),
    'truth, semicolons': Brought(lambda f: with_truth(f, pose_lines(stamps(), ';')), truth=8),
    'depth_scale in metres': Brought(metres_per_count, says='0.0002 is read as metres per count: 5000 counts'),
    'truth table': Brought(lambda f: with_truth(f, pose_lines(stamps(), ',')), truth=8),
    'truth nanoseconds': Brought(
        lambda f: with_truth(f, pose_lines(stamps(10**9))), says=r'groundtruth\.txt: stamps look like nanoseconds', truth=8
    ),
    'truth nanoseconds, scientific': Brought(
        lambda f: with_truth(f, pose_lines(stamps(10**9, form='{:.18e}'))), says='stamps look like nanoseconds', truth=8
    ),
    'truth microseconds': Brought(
        lambda f: with_truth(f, pose_lines(stamps(10**6))), says=r'groundtruth\.txt: stamps look like microseconds', truth=8
    ),
    'lists nanoseconds': Brought(lambda f: tum(f, stamps(10**9)), says=r'rgb\.txt: stamps look like nanoseconds'),
    'lists microseconds': Brought(lambda f: tum(f, stamps(10**6)), says=r'depth\.txt: stamps look like microseconds'),
    'lists nanoseconds since start': Brought(lambda f: tum(f, stamps(10**9, 0.0)), says='look like nanoseconds'),
    'lists nanoseconds since boot': Brought(lambda f: tum(f, stamps(10**9, 1500.0)), says='look like nanoseconds'),
    'mark and Windows line ends': Brought(lambda f: tum(f, encoding='utf-8-sig', newline='\r\n')),
    'UTF-16': Brought(lambda f: tum(f, encoding='utf-16', newline='\r\n')),
    'pointer': Brought(replaced(tum, 'depth/4.png', LFS_POINTER), unreadable=(4,)),
    'pointer first': Brought(replaced(tum, 'rgb/0.png', LFS_POINTER), unreadable=(0,)),
    'pointer first, numbered': Brought(
        replaced(numbered, 'frame-000000.color.png', LFS_POINTER), 'sevenscenes', unreadable=(0,), truth=8
    ),
    'empty file': Brought(replaced(tum, 'rgb/2.png', b''), unreadable=(2,)),
    'missing, listed': Brought(replaced(tum, 'depth/7.png', None), unreadable=(7,)),
    'missing, numbered': Brought(replaced(numbered, 'frame-000004.depth.png', None), 'sevenscenes', unreadable=(4,), truth=8),
    'pose missing': Brought(
        replaced(numbered, 'frame-000003.pose.txt', None), 'sevenscenes', says='1 of 8 true poses are unknown', truth=7
    ),
    'pose damaged': Brought(
        replaced(numbered, 'frame-000003.pose.txt', LFS_POINTER), 'sevenscenes', says='1 of 8 true poses cannot be read', truth=7
    ),
    'NeRFCapture offline': Brought(nerfcapture, 'nerfcapture', truth=8),
    'NeRFCapture without suffix': Brought(lambda f: nerfcapture(f, listed='images/{}'), 'nerfcapture', truth=8),
    'NeRFCapture, other folders': Brought(
        lambda f: nerfcapture(f, './a b/c_{}.jpg', 'd/{}.png', 'a b\\c_{}.jpg'), 'nerfcapture', truth=8
    ),
}  # fmt: skip
