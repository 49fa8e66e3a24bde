"""Chooses the topics of a bag that a sequence reads, by type and encoding or as the user says."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from splatam_core.datasets.bag import realsense
from splatam_core.datasets.bag.recording import Recording
from splatam_core.datasets.bag.typestore import CAMERA_INFO, IMAGES, POSE_STAMPED
from splatam_core.datasets.base import BagTopics
from splatam_core.errors import DatasetError

RGB_TOPIC, DEPTH_TOPIC, INFO_TOPIC = '/rgb/image', '/depth/image', '/rgb/camera_info'
"""The topics of bags that ``splatam convert`` writes; those of other bags are found by type."""

GROUND_TRUTH_TOPIC = '/ground_truth/pose'
GREY_ENCODINGS = ('mono8', '8uc1')


@dataclass(frozen=True, slots=True)
class ChosenTopics:
    """Names of the topics to read.

    Attributes:
        rgb: colour images.
        depth: depth images.
        info: camera infos; None where the camera is known from elsewhere.
        ground_truth: poses; None where the bag has none.
    """

    rgb: str
    depth: str
    info: str | None
    ground_truth: str | None

    @property
    def names(self) -> list[str]:
        """All of them that are read."""
        return [name for name in (self.rgb, self.depth, self.info, self.ground_truth) if name is not None]


def choose_topics(recording: Recording, wanted: BagTopics, *, need_info: bool) -> ChosenTopics:
    """Choose the topics to read.

    Args:
        recording: the bag.
        wanted: what the user chose.
        need_info: True if the camera must come from the bag.

    Raises:
        DatasetError: a wanted topic does not fit, no topic does, or several do.
    """
    is_depth = {topic: recording.is_depth(topic) for topic in recording.topics_of(*IMAGES) if recording.encoding(topic) is not None}
    colors = _narrowed(recording, [topic for topic in is_depth if not is_depth[topic]])
    rgb = _choose(recording, 'colour image', '--rgb', wanted.rgb, fitting=colors, allowed=list(is_depth))
    others = [topic for topic in is_depth if topic != rgb]
    depths = [topic for topic in is_depth if is_depth[topic]]
    depth = _choose(recording, 'depth image', '--depth', wanted.depth, fitting=depths, allowed=others)
    info = None
    if need_info:
        infos = recording.topics_of(CAMERA_INFO)
        beside = [topic for topic in infos if namespace(topic) == namespace(rgb)]
        info = _choose(recording, 'camera info', '--info', wanted.info, fitting=beside or infos, allowed=infos)
    has_ground_truth = GROUND_TRUTH_TOPIC in recording.topics_of(POSE_STAMPED)
    return ChosenTopics(rgb, depth, info, GROUND_TRUTH_TOPIC if has_ground_truth else None)


def _narrowed(recording: Recording, colors: list[str]) -> list[str]:
    """Returns the topics that are likely colour images: not the infrared ones beside them."""
    named = [topic for topic in colors if realsense.is_color(topic)]
    colored = [topic for topic in colors if (recording.encoding(topic) or '').lower() not in GREY_ENCODINGS]
    return named or colored or colors


def _choose(recording: Recording, what: str, option: str, wanted: str | None, *, fitting: list[str], allowed: list[str]) -> str:
    """Returns the wanted topic if it is allowed; without one, the only topic that fits."""
    if wanted is not None:
        if wanted not in allowed:
            raise DatasetError(
                f"{recording.path}: {option} '{wanted}' is no {what} topic with messages; there is {_listed(allowed)}"
            )
        return wanted
    if len(fitting) == 1:
        return fitting[0]
    if fitting:
        raise DatasetError(
            f'{recording.path}: several topics could be the {what}: {_listed(fitting)}; '
            f'choose with {option} (--rgb, --depth and --info choose topics)'
        )
    every = _listed(f'{topic.name} ({", ".join(topic.type_names)})' for topic in recording.topics.values() if topic.num_messages)
    raise DatasetError(f'{recording.path}: there is no {what} topic with messages; the bag holds {every}')


def _listed(names: Iterable[str]) -> str:
    return ', '.join(names) or 'none'


def namespace(topic: str) -> str:
    """Returns what an image topic and its camera info have in common; a compressed image lies one level below its raw one."""
    for suffix in (realsense.IMAGE_DATA, realsense.CAMERA_INFO):
        if topic.endswith(suffix):
            return topic.removesuffix(suffix)
    return topic.removesuffix('/compressed').removesuffix('/compressedDepth').rpartition('/')[0]
