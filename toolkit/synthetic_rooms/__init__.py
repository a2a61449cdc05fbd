"""Synthetic rooms with furniture, textures and exact poses, depth, labels and mesh."""

from toolkit.synthetic_rooms.layouts import LAYOUTS
from toolkit.synthetic_rooms.room import RoomSettings, make_room, tiny_room
from toolkit.synthetic_rooms.sensor import SensorModel

LAYOUT_NAMES = tuple(LAYOUTS)

__all__ = ["LAYOUT_NAMES", "RoomSettings", "SensorModel", "make_room", "tiny_room"]
