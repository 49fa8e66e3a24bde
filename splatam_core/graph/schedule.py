"""When the keyframe graph looks for loops: at each keyframe while they say something new, else more and more rarely."""

from __future__ import annotations

from dataclasses import astuple, dataclass, replace

_MOST_NEAR, _MOST_ANYWHERE = 8, 8  # keyframes without a search, at most
_PAUSES_PER_LOOP = 10  # after a loop there is no search for a tenth of its length, at most
_LEAST_ANYWHERE = 2  # keyframes from one search by features to the next


@dataclass(frozen=True, slots=True)
class GraphSchedule:
    """It goes by the numbers of frames, so that runs stay repeatable.

    Attributes:
        near_from: number of the first frame at which places near the camera are compared again.
        near_pause: keyframes without that after the last loop that agreed.
        anywhere_from: number of the first frame at which features are compared again, with places anywhere.
        anywhere_pause: keyframes without that after the last time.
        is_disputed: True if a loop disagrees with the poses, and they were not optimised since.
        is_apart: True while a new map lies beside the old one, so that only features can join them.
    """

    near_from: int = 0
    near_pause: int = 0
    anywhere_from: int = 0
    anywhere_pause: int = 0
    is_disputed: bool = False
    is_apart: bool = False

    @classmethod
    def of(cls, numbers: list[int]) -> GraphSchedule:
        """Returns what ``numbers`` says."""
        *counts, is_disputed, is_apart = numbers
        near_from, near_pause, anywhere_from, anywhere_pause = counts
        return cls(near_from, near_pause, anywhere_from, anywhere_pause, is_disputed=bool(is_disputed), is_apart=bool(is_apart))

    def numbers(self) -> list[int]:
        """Returns all attributes as integers, for a checkpoint."""
        return [int(value) for value in astuple(self)]

    def agreed(self, frame: int, place: int, every: int) -> GraphSchedule:
        """Returns what follows from a loop that agrees with the present poses.

        Args:
            frame: number of the keyframe at which it was found.
            place: number of the keyframe that was seen again. A loop over a short way says little about long ones.
            every: frames from one keyframe to the next.
        """
        if frame < self.near_from:
            return self
        most = min(_MOST_NEAR, (frame - place) // every // _PAUSES_PER_LOOP)
        pause = min(max(1, 2 * self.near_pause), most)
        return replace(self, near_from=frame + (pause + 1) * every, near_pause=pause)

    def looked(self, frame: int, every: int) -> GraphSchedule:
        """Returns what follows from a search by features at a keyframe."""
        pause = _LEAST_ANYWHERE if self.is_apart else min(max(_LEAST_ANYWHERE, 2 * self.anywhere_pause), _MOST_ANYWHERE)
        return replace(self, anywhere_from=frame + pause * every, anywhere_pause=pause)

    def disagreed(self) -> GraphSchedule:
        """Returns what follows from a loop that disagrees: places near the camera are compared at each keyframe."""
        return replace(self, near_from=0, near_pause=0, anywhere_pause=0)

    def disputed(self, *, is_disputed: bool) -> GraphSchedule:
        """Returns the same, with poses that are to be optimised or not."""
        return replace(self, is_disputed=is_disputed)
