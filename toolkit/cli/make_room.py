"""`semsplat make-room`: write a synthetic room with known truth, in Replica's layout."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Sequence

from tqdm import tqdm

from toolkit.cli.arguments import parse_arguments
from toolkit.cli.programs import MakeRoomOptions
from toolkit.datasets.synthetic import RoomSettings, SensorModel, make_room
from toolkit.frame import Frame


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
