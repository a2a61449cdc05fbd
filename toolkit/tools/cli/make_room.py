"""`semsplat make-room`: create a synthetic room with ground truth, in the layout of Replica."""

from __future__ import annotations

from collections.abc import Iterable

from tqdm import tqdm

from toolkit.base.frame import Frame
from toolkit.datasets.synthetic_rooms import RoomSettings, SensorModel, make_room
from toolkit.semantics.taxonomy_building.builder import BuildOptions, build_taxonomy
from toolkit.semantics.taxonomy_building.rules import RuleGrouper
from toolkit.tools.cli.programs import MakeRoomOptions


def main(options: MakeRoomOptions) -> int:
    """Create a room.

    Returns:
        0.

    Raises:
        ToolkitError: the folder contains other files or cannot be written.
    """
    settings = RoomSettings(
        layout=options.layout,
        seed=options.seed,
        frames=options.frames,
        share=options.share,
        width=options.image_size[0],
        height=options.image_size[1],
        sensor=SensorModel.of(options.sensor_noise, options.real),
        unseen=options.unseen,
        walker=options.real or options.walker,
        texture=options.texture,
        fov_deg=options.fov_deg,
        classes=options.classes,
        glossy=options.glossy,
        polish=options.polish,
    )
    make_room(options.out, settings, with_progress)
    if settings.collection is not None:
        tree = build_taxonomy(settings.collection, RuleGrouper(), options=BuildOptions(name="room"))
        tree.save(options.out / "taxonomy.yaml")
    print(f"Created a room in {options.out}.")
    return 0


def with_progress(frames: Iterable[Frame], total: int) -> Iterable[Frame]:
    """Wrap frames in a progress bar, which is only displayed in terminals."""
    return tqdm(frames, total=total, unit="frame", disable=None)
