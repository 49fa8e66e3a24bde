"""The native extension (``csrc``), loaded when something first needs it: only then is a missing one an error."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from splatam_core.errors import RasterizerError
from splatam_core.rasterizer.bounds import BLOCK

if TYPE_CHECKING:
    from splatam_core import _native


def make_engine(threads: int) -> _native.Engine:
    """Returns what renders and fits isotropic Gaussians. threads: 0 = one per core.

    Raises:
        RasterizerError: the extension is missing or does not fit, SPLATAM_ISA names no instruction set, or the threads cannot be
            started.
    """
    return _made('Engine', threads)


def make_blender(threads: int) -> _native.Blender:
    """Returns what blends anisotropic Gaussians; see ``make_engine``."""
    return _made('Blender', threads)


def make_native_aligner(threads: int) -> _native.Aligner:
    """Returns what aligns frames on the CPU; see ``make_engine``."""
    return _made('Aligner', threads)


def solve_blocks(place: NDArray[np.int32], blocks: NDArray[np.float64], right_hand_side: NDArray[np.float64]) -> None:
    """Solves a sparse symmetric system of 6x6 blocks in place.

    Args:
        place: [K, 2] row and column of the blocks of the lower triangle; those at one place are added.
        blocks: [K, 6, 6].
        right_hand_side: [N, 6]; the solution replaces it.

    Raises:
        RasterizerError: the extension is missing.
        ValueError: the matrix is not positive definite.
    """
    _extension().solve_blocks(place, blocks, right_hand_side)


def has_extension() -> bool:
    """True unless the extension is missing, as on a machine that computes on a GPU alone."""
    try:
        _extension()
    except RasterizerError:
        return False
    return True


def match_descriptors(ours: NDArray[np.uint8], others: NDArray[np.uint8]) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Returns for each descriptor [N, 32] which of the others [M, 32] is mutually nearest, and in how many bits they differ.

    Both are -1 where there is none.

    Raises:
        RasterizerError: the extension is missing.
    """
    partners, distances = _extension().match(np.ascontiguousarray(ours), np.ascontiguousarray(others))
    return partners, distances


@contextmanager
def native_errors() -> Iterator[None]:
    """Turns what the native code refuses, because a view is too large, into one line.

    Raises:
        RasterizerError: the block asked for too much.
    """
    try:
        yield
    except _extension().TooLargeError as error:
        raise RasterizerError(str(error)) from None
    except MemoryError:
        raise RasterizerError('the view does not fit into memory: draw smaller images, or a smaller map') from None


def _made(kind: str, threads: int) -> Any:
    count = _num_threads(threads)
    try:
        return getattr(_extension(), kind)(count)
    except ValueError as error:
        raise RasterizerError(str(error)) from None
    except RuntimeError as error:  # std::system_error
        raise RasterizerError(f'{count} threads cannot be started ({error}): set threads to a smaller number') from None


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
