"""Synthetic rooms with furniture, textures and exact poses, depth, labels and mesh."""

from toolkit.synthetic_rooms.room import RoomSettings, make_room, tiny_room
from toolkit.synthetic_rooms.sensor import SensorModel

__all__ = ["RoomSettings", "SensorModel", "make_room", "tiny_room"]
