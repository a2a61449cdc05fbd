"""A room whose floor, screens and mirrors reflect it, against the same room without gloss.

python -m benchmarks.reflections [--only NAMES]
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import tyro
from numpy.typing import NDArray

from benchmarks.recordings import room
from benchmarks.report import Report, ReportOptions
from benchmarks.runs import finished_slam
from benchmarks.tables import Metrics, Rows, Target, median_of, table_of, target_table
from toolkit.base.geometry import se3
from toolkit.base.geometry.camera import Camera
from toolkit.base.options import validated
from toolkit.datasets.registry import open_dataset
from toolkit.datasets.synthetic_rooms.finishes import Finish
from toolkit.runs.evaluation.images import masked_psnr_db, mean_or_none
from toolkit.runs.evaluation.trajectory import absolute_trajectory_error
from toolkit.runs.settings import RunSettings
from toolkit.splatting.gaussians.scene import GaussianScene
from toolkit.splatting.rendering import RenderOptions, backend, render_surface

Mask = NDArray[np.bool_]

MATT, GLOSSY, POLISHED = "matt", "glossy", "polished"
IGNORED = ", reflections ignored"
ROOMS = {MATT: "room-small", GLOSSY: "room-glossy", POLISHED: "room-polished"}
# Each row: variant of the room, and whether keyframes are placed without the colour of
# view-dependent surfaces.
ROWS: dict[str, list[Any]] = {
    MATT: [MATT, False],
    GLOSSY: [GLOSSY, False],
    POLISHED: [POLISHED, False],
    **{name + IGNORED: [name, True] for name in (MATT, GLOSSY, POLISHED)},
}
SEEDS = range(3)
# Pixels of a group below this share of a view are not scored.
MIN_SHARE = 0.01
_MIN_SILHOUETTE = 0.5
ATE, PSNR = "trajectory.ate_rmse_cm", "images.unseen.psnr_db"
TRACKING = (
    *(ATE, "frames.lost", "frames.doubtful", "frames.keyframes"),
    *("loops.edges.count", "loops.edges.right"),
)
GROUPS = ("mirror", "floor", "elsewhere")
MAP = (
    PSNR,
    *(f"psnr {group} db" for group in GROUPS),
    *(f"depth {group} cm" for group in GROUPS),
    *("map.walls.floaters_percent", "map.gaussians"),
)
DESCRIPTION = """\
The synthetic room (`semsplat make-room --sensor-noise`, 200 frames of 160x120) as it is, and with
`--glossy`: a lacquered floor, switched-off screens without depth at most angles, and mirrors on a
wall and on the wardrobe, on which the sensor measures the depth of the mirror image. In the
polished room, the floor reflects 30 % of the light from above instead of 7 % (`--polish`). All have
the same surfaces, camera path and unseen views, and runs have default settings; where reflections
are ignored, with `--placement.ignore-reflections`. The pixels of the unseen views are grouped by
what they show in the glossy room, for all rows: glass of mirrors, the lacquered floor, everything
else. Depth is the mean absolute difference from the true surfaces, so that in a mirror it measures
how far behind its glass the map is. `floaters_percent` is the share of opaque Gaussians off all
surfaces, those of mirror images included."""


@dataclass(frozen=True, kw_only=True)
class Options(ReportOptions):
    """Compare a glossy room with the same room without gloss."""


def main() -> None:
    """Measure all rows."""
    report = Report("reflections", "Reflections", DESCRIPTION, tyro.cli(Options), SEEDS)
    rows = report.measured(ROWS, measure)
    report.write(
        table_of(TRACKING, rows, "room"),
        table_of(MAP, rows, "room", "Maps"),
        target_table(targets(rows)),
    )


def targets(rows: Rows) -> list[Target]:
    """How close the glossy room should come to the matt one."""
    median = median_of(rows)

    def compared(column: str, difference: bool = False) -> float | None:
        matt, glossy = median(MATT, column), median(GLOSSY, column)
        if matt is None or glossy is None:
            return None
        return matt - glossy if difference else glossy / matt

    polished, ignored = (median(name, ATE) for name in (POLISHED, POLISHED + IGNORED))
    gain = None if polished is None or ignored is None else ignored / polished
    return [
        Target("ATE in the polished room, ignored reflections, multiple", gain, at_most=1.0),
        Target("ATE, as a multiple of that of the matt room", compared(ATE), at_most=1.5),
        Target("lost frames", median(GLOSSY, "frames.lost"), at_most=0),
        Target("doubtful frames", median(GLOSSY, "frames.doubtful"), at_most=0),
        Target("PSNR elsewhere, dB less", compared("psnr elsewhere db", True), at_most=0.5),
        Target("depth error elsewhere, multiple", compared("depth elsewhere cm"), at_most=1.25),
    ]


def measure(job: list[Any], seed: int) -> Metrics:
    """Run one variant; metrics.json, and the unseen views by what they show."""
    variant, ignored = job
    place = room(ROOMS[variant], seed)
    dataset = open_dataset("synthetic", place)
    assert dataset.ground_truth is not None
    values = {
        "dataset": {"kind": "synthetic", "path": str(place)},
        "placement": {"ignore_reflections": ignored},
        "seed": seed,
    }
    with finished_slam(validated(RunSettings, values), dataset) as run:
        estimate = run.result.trajectory
        T_world_map = absolute_trajectory_error(
            estimate, dataset.ground_truth, "se3"
        ).alignment.T_world_map
        views = unseen_scores(run.result.map, T_world_map, place, room(ROOMS[GLOSSY], seed))
        return {**run.metrics, **views}


def unseen_scores(scene: GaussianScene, T_world_map: NDArray, place: Path, glossy: Path) -> Metrics:
    """PSNR and depth error of the unseen views of a room, by what they show.

    Args:
        scene: the map.
        T_world_map: [4, 4] alignment of the map.
        place: folder of the room.
        glossy: folder of its glossy variant.
    """
    unseen = open_dataset("synthetic", place / "unseen")
    assert unseen.ground_truth is not None
    scores: dict[str, list[float | None]] = {}
    for index, T_world_camera in enumerate(unseen.ground_truth.T_world_camera):
        frame = unseen[index]
        colour, depth_m = rendered_view(
            scene, frame.camera, se3.inverse(T_world_map) @ T_world_camera
        )
        error_cm = 100.0 * np.abs(depth_m - frame.depth_m)
        known = (depth_m > 0) & (frame.depth_m > 0)
        for group, mask in groups(glossy / "unseen", index):
            if (mask & known).mean() >= MIN_SHARE:
                psnr = masked_psnr_db(colour, frame.rgb, mask)
                scores.setdefault(f"psnr {group} db", []).append(psnr)
                mean_cm = float(error_cm[mask & known].mean())
                scores.setdefault(f"depth {group} cm", []).append(mean_cm)
    return {name: mean_or_none(values) for name, values in scores.items()}


def rendered_view(
    scene: GaussianScene, camera: Camera, T_map_camera: NDArray
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Colour [H, W, 3] in [0, 1] and depth [H, W] in metres of a map, 0 where it is empty."""
    gaussians = scene.visible_from(camera, T_map_camera)
    options = RenderOptions(_MIN_SILHOUETTE)
    view = render_surface(backend("auto"), gaussians, camera, se3.inverse(T_map_camera), options)
    colour = view.output.colour.numpy().clip(0.0, 1.0).astype(np.float32)
    return colour, np.asarray(view.depth_m.numpy(), np.float32)


def groups(folder: Path, index: int) -> Iterator[tuple[str, Mask]]:
    """The pixels of a view by what they show."""
    path = folder / "surface" / f"finish{index:06d}.png"
    finish = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    if finish is None:
        raise SystemExit(f"{path} is missing; delete {folder.parent} to render the room again")
    mirror, floor = finish == Finish.MIRROR, finish == Finish.LACQUER
    yield from zip(GROUPS, (mirror, floor, ~mirror & ~floor), strict=True)


if __name__ == "__main__":
    main()
