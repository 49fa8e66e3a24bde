"""A browser without a window, which opens the page and takes pictures of it."""

from __future__ import annotations

import shutil
import subprocess
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splatam_core.errors import ViewerError
from splatam_core.maps.viewer.scene import page_url

BROWSERS = ('chromium', 'chromium-browser', 'google-chrome', 'google-chrome-stable')
FLAGS = (
    '--headless=new', '--no-sandbox', '--disable-dev-shm-usage', '--use-angle=swiftshader', '--enable-unsafe-swiftshader',
    '--no-first-run', '--disable-background-networking', '--disable-component-update', '--disable-sync', '--disable-quic',
    '--disable-extensions', '--hide-scrollbars', '--disable-renderer-backgrounding', '--disable-background-timer-throttling',
    '--disable-backgrounding-occluded-windows',
)  # fmt: skip
"""Graphics in software. No sandbox: it does not work as root or in a container, and the only page is our own."""

TIMEOUT_S = 300.0  # software graphics on busy cores are slow
SETTLED, NUM_ALIKE = 0.5, 3  # mean difference of two pictures, of 255; the page fills in steps


def find_browser() -> str | None:
    """Return the path of Chromium or Chrome; None if neither is installed."""
    return next(filter(None, map(shutil.which, BROWSERS)), None)


@contextmanager
def open_page(url: str, width: int, height: int) -> Iterator[None]:
    """Keep a page open in a browser without a window.

    Raises:
        ViewerError: no browser is installed.
    """
    program = find_browser()
    if program is None:
        raise ViewerError('a screenshot needs a browser: apt install chromium')
    with tempfile.TemporaryDirectory(prefix='splatam_browser_', ignore_cleanup_errors=True) as profile:
        process = subprocess.Popen(
            [program, *FLAGS, f'--user-data-dir={profile}', f'--window-size={width},{height}', url],
            stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        try:
            yield
        finally:
            process.terminate()
            try:
                process.wait(10)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


def take_picture(server: Any, width: int, height: int) -> NDArray[np.uint8]:
    """Open the page of a server, wait until it shows everything, and return the picture [height, width, 3].

    Args:
        server: of ``scene.open_server``.
        width: in pixels.
        height: in pixels.

    Raises:
        ViewerError: no browser is installed, or it shows nothing in time.
    """
    deadline_s = time.monotonic() + TIMEOUT_S
    with open_page(page_url(server), width, height + 100):
        alike: list[NDArray[np.uint8]] = []  # the newest pictures, all the same
        while time.monotonic() < deadline_s:
            time.sleep(0.2)
            for client in list(server.get_clients().values())[:1]:
                picture = _render(client, width, height)
                if picture is None:
                    continue
                is_alike = bool(alike) and np.abs(picture - alike[-1].astype(np.float32)).mean() < SETTLED
                alike = [*alike, picture] if is_alike else [picture]
                if len(alike) == NUM_ALIKE and picture.std() > 1:
                    return picture
    raise ViewerError(f'the browser showed nothing within {TIMEOUT_S:.0f} s')


def _render(client: Any, width: int, height: int) -> NDArray[np.uint8] | None:
    try:
        return np.asarray(client.get_render(height, width, timeout=TIMEOUT_S / 4))[:, :, :3]
    except (RuntimeError, TimeoutError):  # it is not ready, or has left
        return None
