"""Another build of the native code: that of ``make sanitize``."""

from __future__ import annotations

import importlib.util
import os
import sys
from pathlib import Path

import splatam_core


def use_other_native_build() -> None:
    """Loads the build that ``SPLATAM_NATIVE`` names, if it names one, in place of the installed one."""
    if path := os.environ.get('SPLATAM_NATIVE'):
        spec = importlib.util.spec_from_file_location('splatam_core._native', Path(path))
        assert spec is not None and spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        sys.modules['splatam_core._native'] = splatam_core._native = module
