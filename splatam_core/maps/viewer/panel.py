"""The controls of the page: status, what is shown, follow the camera, screenshot, and time."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from splatam_core.maps.viewer.scene import Scene

SCREENSHOT_TIMEOUT_S = 30.0


class Panel:
    """The controls. Browsers change them at any time; ``apply`` is called regularly and does what they ask for."""

    def __init__(self, server: Any, *, num_frames: int = 0, follow: bool = False) -> None:
        """Add the controls to the page.

        Args:
            server: of ``open_server``.
            num_frames: of a finished run, for the slider through time; 0 = no slider.
            follow: whether views follow the camera in the beginning.
        """
        gui = server.gui
        self._status = gui.add_markdown('')
        self._text = ''
        self._frame: Any = None
        self._play: Any = None
        if num_frames > 1:
            self._frame = gui.add_slider('Frame', 0, num_frames - 1, 1, num_frames - 1, hint='the run as it was after this frame')
            self._play = gui.add_checkbox('Play', False, hint='move through time at the rate of the camera')
        self._follow = gui.add_checkbox('Follow camera', follow, hint='the view moves with the camera')
        self._gaussians = gui.add_checkbox('Gaussians', True)
        self._camera = gui.add_checkbox('Camera', True)
        self._lines = gui.add_checkbox('Trajectory', True)
        screenshot = gui.add_button('Screenshot', hint='save what this browser shows, without the controls')
        screenshot.on_click(_save_screenshot)

    @property
    def follows(self) -> bool:
        """Whether views follow the camera."""
        return bool(self._follow.value)

    @property
    def frame(self) -> int:
        """Position of the slider through time."""
        return int(self._frame.value)

    @property
    def plays(self) -> bool:
        """Whether the slider moves by itself."""
        return self._play is not None and bool(self._play.value)

    def advance(self) -> None:
        """Move the slider by a frame; after the last one comes the first."""
        self._frame.value = (self.frame + 1) % (int(self._frame.max) + 1)

    def say(self, text: str) -> None:
        """Set the status, Markdown."""
        if text != self._text:
            self._status.content = self._text = text

    def apply(self, scene: Scene) -> None:
        """Show and hide what the controls say."""
        scene.set_visible(
            gaussians=bool(self._gaussians.value), camera=bool(self._camera.value), lines=bool(self._lines.value)
        )  # fmt: skip


def _save_screenshot(event: Any) -> None:
    """Render what the browser shows that asked for it, and let it download the picture."""
    camera = event.client.camera
    picture = event.client.get_render(
        camera.image_height, camera.image_width, transport_format='png', timeout=SCREENSHOT_TIMEOUT_S
    )  # fmt: skip
    event.client.send_file_download('splatam.png', png(picture), save_immediately=True)


def png(picture: NDArray[np.uint8]) -> bytes:
    """Return a picture [H, W, 3 or 4] RGB(A) as a PNG file; transparent parts are black, as the page is."""
    rgb = picture[:, :, :3]
    if picture.shape[2] == 4:
        rgb = np.rint(rgb * (picture[:, :, 3:] / 255.0)).astype(np.uint8)
    return cv2.imencode('.png', rgb[:, :, ::-1])[1].tobytes()
