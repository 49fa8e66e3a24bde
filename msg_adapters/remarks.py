"""Sentences about messages that are used, but that the user should know of; the same for bags and live topics."""

from __future__ import annotations

from typing import Any

from msg_adapters.camera_info import has_only_p
from msg_adapters.encodings import ORDERED

LARGE_GAP_NS = 20_000_000  # rtabmap_ros warns from the same gap
NOT_STAMPED = (
    'the driver does not stamp; use_receive_time takes the time of receiving instead (offline: --use-receive-time, of recording)'
)


def on_info(message: Any) -> str:
    """Returns a sentence about a CameraInfo that has P and no K; empty for any other."""
    if not has_only_p(message):
        return ''
    return 'CameraInfo has P, but K is all zero: P is used, and the images are taken as rectified'


def on_encoding(encoding: str, stated: str | None) -> str:
    """Returns a sentence about an encoding that does not say the order of its channels; empty if the order is known.

    Args:
        encoding: of the colour image.
        stated: the encoding that the user states for such images, if any.
    """
    if stated or encoding not in ORDERED:
        return ''
    return (
        f"colour image has encoding '{encoding}', which does not say the order of its channels: it is read as "
        f'{ORDERED[encoding][0]}; if red and blue are swapped, state rgb8 (parameter rgb_encoding, option --rgb-encoding)'
    )


def on_frames(color_frame: str, depth_frame: str) -> str:
    """Returns a sentence about depth in another coordinate frame than its colour image; empty if both are the same."""
    if color_frame == depth_frame or not (color_frame and depth_frame):
        return ''
    return (
        f"depth is in frame '{depth_frame}', colour in '{color_frame}': depth must be registered to colour; "
        'if it is not, use the depth that the driver aligns (RealSense: aligned_depth_to_color)'
    )


def on_gap(gap_ns: int) -> str:
    """Returns a sentence about a pair whose stamps differ much; empty for any other.

    Args:
        gap_ns: depth's stamp minus colour's.
    """
    if abs(gap_ns) <= LARGE_GAP_NS:
        return ''
    return (
        f'depth is {gap_ns / 1e9:+.3f} s from its colour: a moving camera will smear the map; '
        'synchronize the two in the driver, or lower sync.max_interval (offline: --max-interval)'
    )


def on_wrong_stamp(off_ns: int) -> str:
    """Returns why a frame is left out that is out of line with those around it.

    Args:
        off_ns: its stamp minus that of the frame before it.
    """
    return f'its stamp is {off_ns / 1e9:+.3f} s from the frames around it; do the stamps increase, and come from one clock?'
