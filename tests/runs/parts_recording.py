"""A recording of two places: the room, another one that nothing connects to it, and the room."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from toolkit.base.frame import Frame
from toolkit.datasets.synthetic_rooms import tiny_room
from toolkit.datasets.synthetic_rooms.writer import prepare_folder, write_sequence

# What frames show by index: the room until 5, another place until 11, and the room again.
FIRST, SECOND, THIRD = range(6), range(6, 12), range(12, 17)


def write_two_places(folder: Path, returns: bool = True) -> None:
    """Write the recording in the format of synthetic rooms.

    Args:
        returns: whether the camera comes back to the room.
    """
    frames, truth = tiny_room(14, 96, 72)
    ways = [*range(6), *range(8, 14), *(range(5, 0, -1) if returns else ())]
    shown = [frames[i] for i in ways]
    shown[6:12] = [elsewhere(frame) for frame in shown[6:12]]
    own = [replace(f, index=k, timestamp_s=k / 30) for k, f in enumerate(shown)]
    prepare_folder(folder)
    write_sequence(folder, own, frames[0].camera, truth.T_world_camera[ways])


def elsewhere(frame: Frame) -> Frame:
    """The view upside down in a room of twice the size, in opposite colours."""
    rgb = np.ascontiguousarray(1.0 - frame.rgb[::-1, ::-1])
    return replace(frame, rgb=rgb, depth_m=np.float32(2.0) * frame.depth_m[::-1, ::-1])
