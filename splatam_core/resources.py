"""Where the files live that are shipped beside the code."""

from __future__ import annotations

from pathlib import Path

from splatam_core.errors import ConfigError

_PACKAGE = 'splatam_ros'


def config_dir() -> Path:
    """The folder of presets, ROS parameter files and transport profiles.

    In a checkout that is ``config/`` beside ``package.xml``. Installed, by pip or colcon, it is
    ``share/splatam_ros/config`` below whichever prefix holds this file.

    Raises:
        ConfigError: neither is there.
    """
    here = Path(__file__).resolve()
    checkout = here.parents[1]
    if (checkout / 'package.xml').is_file():
        return checkout / 'config'
    for prefix in here.parents:
        installed = prefix / 'share' / _PACKAGE / 'config'
        if installed.is_dir():
            return installed
    raise ConfigError(f'no share/{_PACKAGE}/config above {here.parent}: the installation is incomplete; install {_PACKAGE} again')
