"""Synthetic rooms with furniture, textures and exact poses, depth, labels and mesh.

Knows: layouts of rooms and corridors, furniture, light, walks of a camera, noise of sensors.
In: settings. Out: recordings whose truth is known, as tests, `make-room` and benchmarks need.
For others: the names below, and `walker`, `layouts` and `writer` for `make-room`.
"""

from toolkit.datasets.synthetic_rooms.room import RoomSettings, make_room, tiny_room
from toolkit.datasets.synthetic_rooms.sensor import SensorModel

__all__ = ["RoomSettings", "SensorModel", "make_room", "tiny_room"]
