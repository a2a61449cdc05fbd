"""Synthetic rooms with furniture, textures and exact poses, depth, labels and mesh."""

from toolkit.datasets.synthetic.layouts import LAYOUTS
from toolkit.datasets.synthetic.room import RoomSettings, make_room, tiny_room
from toolkit.datasets.synthetic.sensor import SensorModel

LAYOUT_NAMES = tuple(LAYOUTS)

__all__ = ["LAYOUT_NAMES", "RoomSettings", "SensorModel", "make_room", "tiny_room"]
