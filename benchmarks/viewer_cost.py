"""What the live viewer costs in the node's process: CPU time, and how long other threads wait for Python's lock.

    python benchmarks/viewer_cost.py [--seconds 10] [--sizes 20000,100000,500000]

A map of random Gaussians is handed over beside frames of 640x480 at 30 Hz, to a viewer that asks as often as the real one does
while a browser is open: ten frames and two maps a second. Another thread wakes every half millisecond, as DDS and timers do, and
notes how late it is; the same without a viewer is the noise of the machine.
"""

from __future__ import annotations

import argparse
import threading
import time
from dataclasses import dataclass

import numpy as np
import torch
from header import print_header
from rclpy.logging import get_logger

from splatam_core.config import load_config
from splatam_core.geometry.camera import PinholeCamera
from splatam_core.rasterizer import Gaussians
from splatam_core.slam import Slam
from splatam_core.types import FrameResult, RgbdFrame, StageTimings, Status
from splatam_ros.viewer.feed import ViewerFeed
from splatam_ros.viewer.main import FRAME_PERIOD_S, MAP_PERIOD_S
from splatam_ros.viewer.protocol import KINDS, MAX_MESSAGE, FrameUpdate, MapUpdate, SharedMemory, read, socket_pair

RATE_HZ = 30.0
WAKE_S = 0.0005
STALL_MS = 5.0


@dataclass(frozen=True, slots=True)
class Cost:
    """What was measured in one run.

    Attributes:
        cpu_percent: CPU time of handing over, in percent of one core.
        late_p99_ms: how late the other thread woke, 99th percentile.
        late_max_ms: the same, largest.
        num_late: number of times it was later than ``STALL_MS``.
        maps: number of maps handed over.
    """

    cpu_percent: float
    late_p99_ms: float
    late_max_ms: float
    num_late: int
    maps: int


class Viewer:
    """Asks as often as the real viewer, and reads what it gets. Its work is in this process, but not counted."""

    def __init__(self) -> None:
        self.socket, self.connection = socket_pair()
        self.memories = {kind.code: SharedMemory() for kind in KINDS}
        self._due_s = {FrameUpdate.code: 0.0, MapUpdate.code: 0.0}
        self._period_s = {FrameUpdate.code: FRAME_PERIOD_S, MapUpdate.code: MAP_PERIOD_S}
        self._asked: set[bytes] = set()
        self.maps = 0
        self.socket.setblocking(False)

    def step(self) -> None:
        """Ask for what is due, and take what has come."""
        try:
            while message := self.socket.recv(MAX_MESSAGE):
                update = read(message, self.memories)
                self._asked.discard(update.code)
                self._due_s[update.code] = time.monotonic() + self._period_s[update.code]
                self.maps += isinstance(update, MapUpdate)
        except BlockingIOError:
            pass
        for code, due_s in self._due_s.items():
            if code not in self._asked and time.monotonic() >= due_s:
                self.socket.send(code)
                self._asked.add(code)


class Sleeper:
    """A thread that notes how late it wakes."""

    def __init__(self) -> None:
        self.late_s: list[float] = []
        self._is_over = False
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        while not self._is_over:
            begin_s = time.perf_counter()
            time.sleep(WAKE_S)
            self.late_s.append(time.perf_counter() - begin_s - WAKE_S)

    def stop(self) -> None:
        """End the thread."""
        self._is_over = True
        self._thread.join()


def random_map(count: int) -> Slam:
    """Returns SLAM with a map of random Gaussians."""
    slam = Slam(load_config('realtime', ['threads=1']))
    generator = torch.Generator().manual_seed(0)
    means, rgb = (torch.rand(count, 3, generator=generator) for _ in range(2))
    slam.map.append(Gaussians(means, torch.full((count, 1), -4.0), torch.zeros(count), rgb))
    return slam


def measure(count: int, seconds: float, with_viewer: bool) -> Cost:
    """Hand over frames and the map for some seconds."""
    slam, viewer = random_map(count), Viewer()
    feed = ViewerFeed(viewer.connection, viewer.memories, get_logger('benchmark'))
    frame = RgbdFrame(
        0, np.zeros((480, 640, 3), np.uint8), np.zeros((480, 640), np.float32), PinholeCamera(640, 480, 525, 525, 319.5, 239.5)
    )
    result = FrameResult(
        index=0, stamp_ns=0, status=Status.TRACKED, T_world_cam=np.eye(4), is_keyframe=False, num_gaussians=count,
        visible_fraction=1.0, inlier_fraction=1.0, reason='', timings=StageTimings(),
    )  # fmt: skip
    sleeper, cpu_s, end_s = Sleeper(), 0.0, time.monotonic() + seconds
    while time.monotonic() < end_s:
        if with_viewer:
            viewer.step()
        begin_s = time.thread_time()
        feed.take(frame, result, slam)
        cpu_s += time.thread_time() - begin_s
        time.sleep(1 / RATE_HZ)
    sleeper.stop()
    feed.close()
    late_ms = 1e3 * np.array(sleeper.late_s)
    return Cost(
        cpu_percent=100 * cpu_s / seconds, late_p99_ms=float(np.percentile(late_ms, 99)), late_max_ms=float(late_ms.max()),
        num_late=int((late_ms > STALL_MS).sum()), maps=viewer.maps,
    )  # fmt: skip


def main() -> None:
    """Measure and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--seconds', type=float, default=10.0, help='duration of each run (default: %(default)s)')
    parser.add_argument('--sizes', default='20000,100000,500000', help='numbers of Gaussians (default: %(default)s)')
    args = parser.parse_args()
    print_header(f"The viewer's cost in the node's process, {args.seconds:g} s a run", 1)
    late = f'another thread wakes late, ms: p99 | largest | over {STALL_MS:g} ms'
    print(f'| Gaussians | viewer | CPU % of a core | {late} | maps handed over |')
    print('|---|---|---|---|---|---|---|')
    for count in map(int, args.sizes.split(',')):
        for with_viewer in (False, True):
            cost = measure(count, args.seconds, with_viewer)
            print(
                f'| {count:,} | {"yes" if with_viewer else "no"} | {cost.cpu_percent:.2f} | {cost.late_p99_ms:.2f} '
                f'| {cost.late_max_ms:.2f} | {cost.num_late} | {cost.maps} |'
            )


if __name__ == '__main__':
    main()
