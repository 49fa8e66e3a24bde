"""The errors a user can cause. Anything else that is raised is a bug and keeps its traceback."""

LONGEST = 2500  # characters


class SplatamError(Exception):
    """Base of every error a user can cause: what, the value, what is allowed, what to do.

    It is one line, whatever texts of files and of other libraries it quotes.
    """

    def __init__(self, text: str = '') -> None:
        """Make one printable line of the text; the middle of a very long one is left out."""
        super().__init__(printable(text))


class ConfigError(SplatamError):
    """A configuration file, key or value that cannot be used."""


class CameraError(SplatamError):
    """A camera calibration that cannot be used."""


class DatasetError(SplatamError):
    """A recording that cannot be read as the format it was taken for."""


class FrameError(SplatamError):
    """One frame that cannot be processed; the frames after it may be fine."""


class RunFolderError(SplatamError):
    """A run folder that cannot be written, read or scored."""


class MapFileError(SplatamError):
    """A map file that cannot be read, or is no map."""


class RasterizerError(SplatamError):
    """A rasterizer backend that is missing, or was given what it cannot render."""


class ExportError(SplatamError):
    """A map that cannot be brought into the form asked for."""


class MergeError(SplatamError):
    """Two maps that cannot be joined."""


class ViewerError(SplatamError):
    """A viewer that cannot be shown: a package or a browser is missing."""


class JobError(SplatamError):
    """Runs that cannot be started: a package or a cluster is missing."""


class WeightsError(SplatamError):
    """Weights of a network that cannot be fetched, read or kept."""


class CheckpointError(SplatamError):
    """A checkpoint that is missing, damaged, or of another run."""


def printable(text: str) -> str:
    """Returns one printable line: names in messages and files may hold anything. The middle of a very long one is left out."""
    line = ''.join(character if character.isprintable() else ' ' for character in text)
    return line if len(line) <= LONGEST else f'{line[: LONGEST // 2]} ... {line[-LONGEST // 2 :]}'


def one_line(error: Exception | str) -> str:
    """Returns what another library's error says, without its line breaks and without more than 300 characters of them."""
    text = ' '.join(str(error).split())
    return text if len(text) <= 300 else text[:297] + '...'
