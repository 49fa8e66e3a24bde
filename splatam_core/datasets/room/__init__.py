"""The room of the synthetic recordings: surfaces, paint, light, furniture and a ray caster."""

from splatam_core.datasets.room.caster import Cast, Room, build_room
from splatam_core.datasets.room.furniture import ROOM_SIZE_M
from splatam_core.datasets.room.surfaces import look_at

__all__ = ['ROOM_SIZE_M', 'Cast', 'Room', 'build_room', 'look_at']
