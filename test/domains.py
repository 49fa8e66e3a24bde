"""ROS domains for tests: each graph has one that no other test on this machine uses."""

from __future__ import annotations

import fcntl
import itertools
import os
import tempfile
from pathlib import Path
from typing import IO

NUM_DOMAINS = 101  # above, the ports may be in use by other programs
CANDIDATES = itertools.count(os.getpid())


def reserve_domain() -> tuple[int, IO[bytes]]:
    """Returns a domain, and the file that reserves it until the file is closed."""
    folder = Path(tempfile.gettempdir()) / 'splatam_ros_test_domains'
    folder.mkdir(exist_ok=True)
    for candidate in itertools.islice(CANDIDATES, NUM_DOMAINS):
        domain = 1 + candidate % NUM_DOMAINS
        file = (folder / str(domain)).open('wb')
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            file.close()
        else:
            return domain, file
    raise AssertionError('all ROS domains are in use by tests')
