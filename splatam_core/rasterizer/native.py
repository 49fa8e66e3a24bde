"""The native extension (``csrc``), loaded when something first needs it: only then is a missing one an error."""

from __future__ import annotations

import os
from functools import lru_cache
from typing import TYPE_CHECKING, Any

from splatam_core.errors import RasterizerError
from splatam_core.rasterizer.bounds import BLOCK

if TYPE_CHECKING:
    from splatam_core import _native


def make_engine(threads: int) -> _native.Engine:
    """Returns what renders and fits isotropic Gaussians. threads: 0 = one per core.

    Raises:
        RasterizerError: the extension is missing or does not fit.
    """
    return _extension().Engine(_num_threads(threads))


def make_blender(threads: int) -> _native.Blender:
    """Returns what blends anisotropic Gaussians; see ``make_engine``."""
    return _extension().Blender(_num_threads(threads))


def make_native_aligner(threads: int) -> _native.Aligner:
    """Returns what aligns frames on the CPU; see ``make_engine``."""
    return _extension().Aligner(_num_threads(threads))


@lru_cache(maxsize=1)
def _extension() -> Any:
    try:
        from splatam_core import _native
    except ImportError as error:
        raise RasterizerError(
            f'the native module of rasterizer=cpu and of tracking.method=align on the CPU cannot be loaded ({error}): build it '
            "with 'pip install .' (needs g++ and Python's headers), or set rasterizer=reference and "
            'tracking.method=render_and_compare'
        ) from None
    if _native.BLOCK != BLOCK:
        raise RasterizerError("the native module is of another version of splatam_core: build it again with 'pip install .'")
    return _native


def _num_threads(threads: int) -> int:
    return threads or len(os.sched_getaffinity(0))
