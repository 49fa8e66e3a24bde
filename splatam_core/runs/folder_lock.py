"""Keeps a run folder to one writer at a time."""

from __future__ import annotations

import fcntl
import os
import weakref
from pathlib import Path

from splatam_core.errors import RunFolderError


class FolderLock:
    """Held while a run is written, so that no other run removes its files or writes among them.

    It is a lock of the operating system on the folder itself: it leaves no file behind, and ends with the process, however that
    ends. Reading needs no lock.
    """

    def __init__(self, path: Path) -> None:
        """Locks an existing folder. On a file system without locks nothing is locked.

        Raises:
            RunFolderError: another run is being written there.
            OSError: there is no such folder.
        """
        descriptor = os.open(path, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        self._close = weakref.finalize(self, os.close, descriptor)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            self.release()
            raise RunFolderError(f'{path} is in use: a run is written there; choose another folder, or end that run') from None
        except OSError:  # such as ENOLCK: the file system has no locks
            return

    def release(self) -> None:
        """Lets others write to the folder."""
        self._close()
