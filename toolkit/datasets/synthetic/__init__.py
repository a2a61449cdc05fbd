"""Synthetic rooms: furnished, textured, with exact poses, depth, labels and mesh."""

from toolkit.datasets.synthetic.room import RoomSettings, make_room, tiny_room

__all__ = ["RoomSettings", "make_room", "tiny_room"]
