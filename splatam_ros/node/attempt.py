"""Runs a step whose failure must not keep the next step from running."""

from __future__ import annotations

import traceback
from collections.abc import Callable

from rclpy.impl.rcutils_logger import RcutilsLogger

from splatam_core.errors import SplatamError
from splatam_ros.throttled_warnings import describe


def attempt(logger: RcutilsLogger, what: str, action: Callable[[], object]) -> bool:
    """Run a step of the shutdown. If it fails, log the error in one line.

    Args:
        logger: logger of the node.
        what: name of the step.
        action: the step.

    Returns:
        True if it did not fail.
    """
    try:
        action()
    except Exception as error:  # noqa: BLE001 - the rest of the shutdown must run
        logger.error(f'{what} failed: {why(error)}')
        logger.debug(''.join(traceback.format_exception(error)))
        return False
    return True


def why(error: Exception) -> str:
    """Returns one line about an error of SLAM or of the disk."""
    if isinstance(error, OSError) and error.strerror:
        return f'{error.filename}: {error.strerror}' if error.filename else error.strerror
    return str(error) if isinstance(error, SplatamError) else describe(error)
