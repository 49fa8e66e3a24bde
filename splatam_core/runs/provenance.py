"""The code, libraries and machine of a run: without them its numbers cannot be compared."""

from __future__ import annotations

import os
import platform
import subprocess
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import cv2
import numpy
import torch

DISTRIBUTION = 'splatam_ros'


def package_version() -> str | None:
    """Returns the installed version of this package; None where it runs without being installed."""
    try:
        return version(DISTRIBUTION)
    except PackageNotFoundError:
        return None


def commit() -> str | None:
    """Returns the commit of this code, with ``-dirty`` if it has changed since; None outside its repository.

    A virtual environment may lie inside another repository, so the repository counts only if it tracks this file.
    """
    if _git('ls-files', '--error-unmatch', Path(__file__).name) is None:
        return None
    head = _git('rev-parse', 'HEAD')
    return None if head is None else head + ('-dirty' if _git('status', '--porcelain', '-uno', ':/') else '')


def _git(*arguments: str) -> str | None:
    command = ['git', '-C', str(Path(__file__).parent), *arguments]
    try:
        return subprocess.run(command, capture_output=True, text=True, check=True, timeout=10).stdout.strip()
    except (OSError, subprocess.SubprocessError):
        return None


def machine() -> dict[str, str | int | None]:
    """Returns processor, usable cores, memory, system, and the GPU that torch sees, if any."""
    return {
        'system': platform.platform(),
        'processor': _processor(),
        'cores': len(os.sched_getaffinity(0)) if hasattr(os, 'sched_getaffinity') else os.cpu_count() or 1,
        'memory_mb': os.sysconf('SC_PAGE_SIZE') * os.sysconf('SC_PHYS_PAGES') // 2**20,
        'gpu': torch.cuda.get_device_name() if torch.cuda.is_available() else None,
    }


def _processor() -> str:
    fields = _fields(Path('/proc/cpuinfo'))
    return fields.get('model name') or platform.processor() or platform.machine()


def versions() -> dict[str, str | None]:
    """Returns the versions of this package and of the libraries that affect its numbers."""
    return {
        DISTRIBUTION: package_version(),
        'python': platform.python_version(),
        'torch': torch.__version__,
        'numpy': numpy.__version__,
        'opencv': cv2.__version__,
    }


def peak_rss_mb() -> float | None:
    """Returns the largest memory of this process so far, MiB; None where the system does not tell."""
    peak = _fields(Path('/proc/self/status')).get('VmHWM')  # unlike ru_maxrss not inherited from the parent
    return None if peak is None else round(int(peak.split()[0]) / 1024, 1)


def peak_gpu_mb() -> float | None:
    """Returns the largest memory of this process's tensors on a GPU so far, MiB; None where no GPU was used."""
    peak = torch.cuda.max_memory_allocated() if torch.cuda.is_available() else 0
    return round(peak / 2**20, 1) if peak else None


def rss_mb() -> float | None:
    """Returns the present memory of this process, MiB; None where the system does not tell."""
    held = _fields(Path('/proc/self/status')).get('VmRSS')
    return int(held.split()[0]) / 1024 if held else None


def _fields(path: Path) -> dict[str, str]:
    """Returns the ``name: value`` lines of a file in /proc; empty where there is no such file."""
    if not path.exists():
        return {}
    pairs = (line.partition(':') for line in path.read_text().splitlines())
    return {name.strip(): value.strip() for name, _, value in pairs}
