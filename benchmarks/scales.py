"""Maps seen in smaller and in larger images than those of the camera, and from nearer.

python -m benchmarks.scales [--only NAMES]
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
import tyro
from numpy.typing import NDArray

from benchmarks.recordings import room
from benchmarks.reflections import rendered_view
from benchmarks.report import Report, ReportOptions
from benchmarks.runs import finished_slam
from benchmarks.tables import Metrics, Rows, Target, median_of, table_of, target_table
from toolkit.base.geometry import se3
from toolkit.base.geometry.camera import Camera
from toolkit.base.options import validated
from toolkit.datasets.registry import open_dataset
from toolkit.datasets.synthetic_rooms.ray_casting import Scene
from toolkit.datasets.synthetic_rooms.room import RoomSettings, room_scene
from toolkit.runs.evaluation.images import masked_psnr_db, mean_or_none
from toolkit.runs.evaluation.trajectory import absolute_trajectory_error
from toolkit.runs.settings import RunSettings

ROOMS = ("room", "room-noise")
SHAPES = ("spheres", "ellipsoids")
# Sizes of images relative to those of the camera.
SCALES = (0.25, 0.5, 1.0, 2.0, 3.0, 4.0)
# The camera moves along its axis until the surface in the middle is this many times nearer.
NEARER = 3.0
NEARER_COLUMN = f"{NEARER:g} times nearer"
# Side of the middle, as a fraction of the image.
_MIDDLE = 0.2
COUNT = "map.gaussians"
DESCRIPTION = """\
`semsplat run` of a synthetic room at 320x240, with each `--mapping.final-shape`, otherwise default
settings. PSNR in dB of its unseen views (off the path), rendered with 1/4 to 4 times the number of
rows and columns. The truth is the same scene, rendered at that size, or averaged over the pixels of
the view where images are smaller. In the last column, the camera has moved forward until the
surface in the middle of each view is three times nearer, at 320x240."""


@dataclass(frozen=True, kw_only=True)
class Options(ReportOptions):
    """Render maps at several scales."""


@dataclass(frozen=True)
class View:
    """A true view: its column, camera, pose T_world_camera [4, 4] and colours [H, W, 3]."""

    column: str
    camera: Camera
    T_world_camera: NDArray[np.float64]
    rgb: NDArray[np.float32]


def main() -> None:
    """Measure one row for each room and shape."""
    report = Report("scales", "Scales", DESCRIPTION, tyro.cli(Options))
    jobs = {f"{name}, {shape}": (name, shape) for name in ROOMS for shape in SHAPES}
    rows = report.measured(jobs, measure)
    columns = (*map(column_of, SCALES), NEARER_COLUMN, COUNT)
    report.write(table_of(columns, rows, "room, shape"), target_table(targets(rows)))


def column_of(scale: float) -> str:
    """Name of the column of a scale."""
    return f"scale {scale:g}"


def targets(rows: Rows) -> list[Target]:
    """What ellipsoids should gain where spheres show bubbles, and keep elsewhere."""
    median = median_of(rows)
    found = []
    for name in ROOMS:
        for column, least in ((column_of(3.0), 3.0), (NEARER_COLUMN, 3.0), (column_of(0.25), 0.0)):
            spheres, ellipsoids = (median(f"{name}, {shape}", column) for shape in SHAPES)
            gain = None if spheres is None or ellipsoids is None else ellipsoids - spheres
            found.append(Target(f"{name}, {column}, dB more", gain, at_least=least))
    return found


def measure(job: tuple[str, str], seed: int) -> Metrics:
    """Run one room, and render its unseen views."""
    name, shape = job
    place = room(name, seed)
    dataset = open_dataset("synthetic", place)
    unseen = open_dataset("synthetic", place / "unseen")
    assert dataset.ground_truth is not None and unseen.ground_truth is not None
    values = {
        "dataset": {"kind": "synthetic", "path": str(place)},
        "mapping": {"final_shape": shape},
        "seed": seed,
    }
    scene = room_scene(RoomSettings(seed=seed))
    scores: dict[str, list[float | None]] = {}
    with finished_slam(validated(RunSettings, values), dataset) as run:
        estimate = run.result.trajectory
        aligned = absolute_trajectory_error(estimate, dataset.ground_truth, "se3").alignment
        for T_world_camera in unseen.ground_truth.T_world_camera:
            for view in true_views(scene, dataset.camera, T_world_camera):
                T_map_camera = se3.inverse(aligned.T_world_map) @ view.T_world_camera
                colour, _ = rendered_view(run.result.map, view.camera, T_map_camera)
                everywhere = np.ones(colour.shape[:2], bool)
                psnr_db = masked_psnr_db(colour, view.rgb, everywhere)
                scores.setdefault(view.column, []).append(psnr_db)
        return {**run.metrics, **{c: mean_or_none(values) for c, values in scores.items()}}


def true_views(scene: Scene, camera: Camera, T_world_camera: NDArray) -> Iterator[View]:
    """What a camera [4, 4] sees at each scale, and from nearer."""
    whole = scene.render(camera, T_world_camera)
    for scale in SCALES:
        resized = scaled(camera, scale)
        if scale < 1.0:
            size = resized.width, resized.height
            rgb = cv2.resize(whole.rgb, size, interpolation=cv2.INTER_AREA)
        else:
            rgb = scene.render(resized, T_world_camera).rgb
        yield View(column_of(scale), resized, T_world_camera, rgb)
    nearer = T_world_camera.copy()
    nearer[:3, 3] += (1.0 - 1.0 / NEARER) * middle_depth_m(whole.depth_m) * nearer[:3, 2]
    yield View(NEARER_COLUMN, camera, nearer, scene.render(camera, nearer).rgb)


def scaled(camera: Camera, scale: float) -> Camera:
    """A camera with a multiple of its rows and columns."""
    return camera.scaled(scale, scale, round(scale * camera.width), round(scale * camera.height))


def middle_depth_m(depth_m: NDArray[np.floating]) -> float:
    """Least depth in the middle of an image [H, W], so that the camera stays before surfaces."""
    height, width = depth_m.shape
    rows, columns = (round(_MIDDLE * side / 2) for side in (height, width))
    middle = depth_m[
        height // 2 - rows : height // 2 + rows + 1, width // 2 - columns : width // 2 + columns + 1
    ]
    return float(middle[middle > 0].min(initial=np.inf)) if (middle > 0).any() else 0.0


if __name__ == "__main__":
    main()
