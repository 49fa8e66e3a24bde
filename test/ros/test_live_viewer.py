"""The viewer in a real browser, without a window: a map that grows, a finished run, and a picture of a map."""

from __future__ import annotations

import re
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from processes import Patience
from rclpy.logging import get_logger

from splatam_core.cli import main
from splatam_core.config import load_config
from splatam_core.datasets.synthetic import SyntheticSequence
from splatam_core.geometry.camera import PinholeCamera
from splatam_core.maps.viewer.browser import FLAGS
from splatam_core.slam import Slam
from splatam_core.types import FrameResult, RgbdFrame, StageTimings, Status
from splatam_ros.viewer.feed import ViewerFeed
from splatam_ros.viewer.protocol import KINDS, MAX_MESSAGE, FrameUpdate, MapUpdate, SharedMemory, read, socket_pair

FAST = ['threads=1', 'tracking.iterations=8', 'mapping.iterations=3']
SIZE = {'width': 800, 'height': 500}
PATH_RGB = (240, 180, 40)
TIMEOUT_S = 60.0  # only ever waited out when a test fails; software graphics on busy cores are slow


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(('127.0.0.1', 0))
        return probe.getsockname()[1]


@pytest.fixture(scope='module')
def pages(browser: str) -> Iterator[Any]:
    """A context of the browser."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        opened = playwright.chromium.launch(executable_path=browser, args=list(FLAGS[1:]))
        yield opened.new_context(viewport=SIZE, accept_downloads=True)
        opened.close()


class Shown:
    """A page, and what is seen on it."""

    def __init__(self, pages: Any, port: int, meanwhile: Callable[[], None] = lambda: None) -> None:
        self._meanwhile = meanwhile  # what the node would do
        self.page = pages.new_page()
        self.errors: list[str] = []
        self.page.on('pageerror', lambda error: self.errors.append(str(error)))
        self.page.goto(f'http://127.0.0.1:{port}')

    def picture(self) -> np.ndarray:
        """The page as it is, [H, W, 3] RGB, without the controls, which are on the right."""
        encoded = np.frombuffer(self.page.screenshot(), np.uint8)
        return cv2.imdecode(encoded, cv2.IMREAD_COLOR)[:, : SIZE['width'] - 330, ::-1]

    def until(self, is_so: Callable[[np.ndarray], bool]) -> np.ndarray:
        """Wait for a picture. Returns it."""
        patience = Patience(TIMEOUT_S)
        while not is_so(picture := self.picture()):
            assert not patience.is_over, f'the page does not show it; errors: {self.errors}'
            self._meanwhile()
            self.page.wait_for_timeout(50)
        return picture

    def until_still(self) -> np.ndarray:
        before = [self.picture()]
        return self.until(lambda now: np.array_equal(before.pop(), now) or bool(before.append(now)))

    def tick(self, label: str) -> None:
        self.page.get_by_label(label, exact=True).click(force=True)


def bright(picture: np.ndarray) -> int:
    """Number of pixels that show something."""
    return int((picture.max(axis=2) > 60).sum())


def on_path(picture: np.ndarray) -> int:
    """Number of pixels in the colour of the trajectory, on the line or at its edge."""
    return int((np.abs(picture.astype(int) - PATH_RGB).max(axis=2) < 40).sum())


@pytest.mark.slow
def test_the_page_shows_the_map_while_it_grows(
    pages: Any, room: Callable[..., SyntheticSequence], capfd: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    slam, frames = Slam(load_config('quick', FAST)), room(frames=25)
    feed = ViewerFeed.start('127.0.0.1', free_port(), get_logger('test'))
    try:
        said = ''
        while not (found := re.search(r'viewer at http://127\.0\.0\.1:(\d+), for this machine only', said)):
            time.sleep(0.05)
            said += capfd.readouterr().out
        feed.take(frames[0], slam.process(frames[0]), slam)
        shown = Shown(pages, int(found[1]), lambda: feed.answer(slam))
        shown.until(lambda picture: bright(picture) > 20_000)
        first = shown.until_still()
        assert on_path(first) == 0

        for index in range(1, 24):
            feed.take(frames[index], slam.process(frames[index]), slam)
        grown = shown.until(lambda picture: on_path(picture) > 30)
        assert (np.abs(grown.astype(int) - first).max(axis=2) > 30).sum() > 2_000
        shown.until(lambda picture: shown.page.get_by_text('24 frames').is_visible())
        shown.page.screenshot(path=tmp_path / 'page.png')

        shown.tick('Trajectory')
        shown.until(lambda picture: on_path(picture) < 5)
        shown.tick('Follow camera')
        feed.take(frames[24], slam.process(frames[24]), slam)
        shown.until(lambda picture: np.abs(picture.astype(int) - grown).mean() > 3)
        with shown.page.expect_download(timeout=1000 * TIMEOUT_S) as download:
            shown.page.get_by_role('button', name='Screenshot').click()
        download.value.save_as(tmp_path / 'map.png')
        assert bright(cv2.imread(str(tmp_path / 'map.png'))) > 20_000
        shown.tick('Gaussians')
        shown.tick('Camera')
        shown.until(lambda picture: bright(picture) < 9_000)  # a notice about software graphics has 6000
        assert not shown.errors
    finally:
        feed.close()
    assert not feed.is_asked


class Listening:
    """The viewer's end of a feed, without a page."""

    def __init__(self) -> None:
        self.warnings: list[str] = []
        self.memories = {kind.code: SharedMemory() for kind in KINDS}
        connection, self.socket = socket_pair()
        self.feed = ViewerFeed(connection, self.memories, SimpleNamespace(warning=self.warnings.append))
        self.slam, self._num = Slam(load_config('quick', FAST)), 0

    def frame(self) -> None:
        """One more frame, tracked at x = its number."""
        pose, camera = np.eye(4), PinholeCamera(4, 4, 4.0, 4.0, 1.5, 1.5)
        pose[0, 3], self._num = self._num, self._num + 1
        frame = RgbdFrame(self._num, np.zeros((4, 4, 3), np.uint8), np.zeros((4, 4), np.float32), camera)
        result = FrameResult(
            index=self._num, stamp_ns=self._num, status=Status.TRACKED, T_world_cam=pose, is_keyframe=False, num_gaussians=0,
            visible_fraction=1.0, inlier_fraction=1.0, reason='', timings=StageTimings(),
        )  # fmt: skip
        self.feed.take(frame, result, self.slam)

    def asked(self, kind: type[FrameUpdate | MapUpdate]) -> Any:
        """The answer to a request."""
        self.socket.send(kind.code)
        assert self.feed.is_asked
        self.feed.answer(self.slam)
        return read(self.socket.recv(MAX_MESSAGE), self.memories)


def test_each_point_of_the_path_is_handed_over_once_and_none_of_an_earlier_map() -> None:
    viewer = Listening()
    viewer.frame()
    assert viewer.asked(FrameUpdate).path[:, 0].tolist() == [0]
    for _ in range(3):
        viewer.frame()
    assert viewer.asked(FrameUpdate).path[:, 0].tolist() == [1, 2, 3]
    assert viewer.asked(FrameUpdate).path.shape == (0, 3)
    assert viewer.asked(MapUpdate).means.shape == (0, 3)  # a map without Gaussians
    viewer.frame()
    viewer.feed.begin_map()
    viewer.frame()
    update = viewer.asked(FrameUpdate)
    assert (update.epoch, update.path[:, 0].tolist()) == (1, [5])
    viewer.feed.close()


def test_the_end_of_the_viewer_is_one_warning_and_keeps_nothing_for_it() -> None:
    viewer = Listening()
    viewer.frame()
    viewer.socket.close()
    for _ in range(3):
        viewer.frame()
    assert viewer.warnings == ['the viewer has ended; the node goes on without']
    assert not viewer.feed.is_asked and not viewer.feed._path
    viewer.feed.close()


def test_a_fault_of_the_viewer_costs_no_frame(monkeypatch: pytest.MonkeyPatch) -> None:
    viewer = Listening()
    monkeypatch.setattr(viewer.feed, '_map_update', lambda slam: 1 / 0)
    viewer.frame()
    viewer.socket.send(MapUpdate.code)
    viewer.frame()
    assert viewer.warnings == [
        "the viewer is ended by an unexpected ZeroDivisionError('division by zero'); the node goes on without"
    ]
    assert viewer.socket.recv(MAX_MESSAGE) == b'' and not viewer.feed.is_asked
    viewer.feed.close()


@pytest.fixture(scope='module')
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run."""
    folder = tmp_path_factory.mktemp('viewer') / 'tiny'
    settings = [word for setting in FAST for word in ('--set', setting)]
    source = ['synthetic', '--width', '64', '--max-frames', '16', '--preset', 'quick']
    assert main(['run', *source, *settings, '--no-evaluate', '--out', str(folder)]) == 0
    return folder


@pytest.mark.slow
def test_a_finished_run_is_shown_at_any_frame(pages: Any, finished: Path) -> None:
    command = [sys.executable, '-m', 'splatam_core.cli', 'view', str(finished), '--port', str(free_port())]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        found = re.fullmatch(
            r'viewer at http://127\.0\.0\.1:(\d+), for this machine only; Ctrl-C ends it\n', process.stdout.readline()
        )
        assert found
        shown = Shown(pages, int(found[1]))
        shown.until(lambda picture: bright(picture) > 20_000 and on_path(picture) > 30)
        last = shown.until_still()
        shown.page.screenshot(path=finished / 'page.png')
        assert shown.page.get_by_text('frame 16 of 16 tracked').is_visible()
        assert shown.page.get_by_text("camera's image: recorded").is_visible()
        slider = shown.page.get_by_role('slider').first
        slider.press('Home')
        shown.page.get_by_text('frame 1 of 16 initialized').wait_for(timeout=1000 * TIMEOUT_S)
        shown.until(lambda picture: on_path(picture) < 5)
        assert (np.abs(shown.until_still().astype(int) - last).max(axis=2) > 30).sum() > 1_000
        shown.tick('Play')
        shown.page.get_by_text(re.compile(r'frame ([5-9]|1\d) of 16')).wait_for(timeout=1000 * TIMEOUT_S)
        process.send_signal(signal.SIGINT)
        assert process.wait(TIMEOUT_S) == 130
    finally:
        process.kill()
        process.communicate()


@pytest.mark.slow
def test_a_picture_of_a_map_needs_no_screen(browser: str, finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr('splatam_core.commands.view.PICTURE_SIZE', (320, 180))  # software graphics are slow
    picture = tmp_path / 'map.png'
    assert main(['view', str(finished / 'map.ply'), '--port', str(free_port()), '--screenshot', str(picture)]) == 0
    shown = cv2.imread(str(picture))
    assert shown.shape == (180, 320, 3) and bright(shown) > 3_000
    assert main(['view', str(finished), '--screenshot', str(tmp_path / 'map.gif')]) == 2
