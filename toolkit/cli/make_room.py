"""`semsplat make-room`: write a synthetic room with known truth, in Replica's layout."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from tqdm import tqdm

from toolkit.cli.arguments import parse_arguments
from toolkit.datasets.synthetic import RoomSettings, SensorModel, make_room
from toolkit.frame import Frame


@dataclass(frozen=True)
class MakeRoomOptions:
    """Make a furnished room and walk a camera through it: colour, depth, labels, poses, mesh."""

    out: Path
    """Folder to write: new, empty, or an earlier synthetic room."""
    layout: Literal["room", "rooms", "hall", "ring", "twins"] = "room"
    """One room, three on a corridor, twelve, four that close a loop, or three with two equal."""
    seed: int = 0
    """Decides furniture, textures, the camera's sway and the sensor's noise."""
    frames: int | None = None
    """Number of frames, spread over the walk; by default as many as a person's pace gives."""
    share: float = 1.0
    """Part of the way that is walked, above 0 and at most 1."""
    image_size: tuple[int, int] = (320, 240)
    """Width and height in pixels."""
    sensor_noise: bool = False
    """Images as of a real camera (noise, holes, blur, exposure, wrong labels), not ideal ones."""
    unseen: int = 20
    """Number of ideal views off the path, in the folder `unseen`."""


def main(argv: Sequence[str]) -> int:
    """Make a room.

    Returns:
        0.

    Raises:
        ToolkitError: a value is out of range, or the folder holds something else or
            cannot be written.
    """
    options = parse_arguments(MakeRoomOptions, argv, "make-room")
    settings = RoomSettings(
        layout=options.layout,
        seed=options.seed,
        frames=options.frames,
        share=options.share,
        width=options.image_size[0],
        height=options.image_size[1],
        sensor=SensorModel() if options.sensor_noise else None,
        unseen=options.unseen,
    )
    make_room(options.out, settings, with_progress)
    print(f"made a room in {options.out}")
    return 0


def with_progress(frames: Iterable[Frame], total: int) -> Iterable[Frame]:
    """The same frames, and a bar on a terminal that shows how many are made."""
    return tqdm(frames, total=total, unit="frame", file=sys.stderr, disable=not sys.stderr.isatty())
