"""A room with the imperfections of real recordings, against the same room without them.

python -m benchmarks.real_room [--only NAMES] [--seeds N]
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
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
from toolkit.base.exposure import Exposure
from toolkit.base.geometry import se3
from toolkit.base.geometry.camera import Camera
from toolkit.base.keyframe import Keyframe
from toolkit.base.options import validated
from toolkit.datasets.base import Dataset
from toolkit.datasets.registry import open_dataset
from toolkit.runs.evaluation.images import balanced, masked_psnr_db, mean_or_none, psnr_db
from toolkit.runs.evaluation.run_metrics import TrackedFrame
from toolkit.runs.outcome import tracked_frames
from toolkit.runs.settings import RunSettings
from toolkit.slam.system import Slam
from toolkit.splatting.gaussians.scene import GaussianScene
from toolkit.splatting.rendering import render

Array = NDArray[np.float32]
Mask = NDArray[np.bool_]

MAX_VIEWS = 100
# Minimum fraction of a view that the walker covers for the scene behind to be scored.
MIN_WALKER = 0.01
# Pixels beside the walker that may be hidden without being counted as wrong, at a width of 320.
TOLERANCE_PIXELS = 8
COLUMNS = (
    *(
        "trajectory.ate_rmse_cm",
        "psnr clean db",
        "psnr clean per channel db",
        "psnr behind walker db",
    ),
    *("walker hidden percent", "wrongly hidden percent"),
    *("images.unseen.psnr_db", "map.gaussians", "frames.lost", "time.online_ms_per_frame"),
)
MAPPED = {"mapping": {"moving_objects": False}}
CLEAN, REAL = "clean", "real"
DESCRIPTION = f"""\
The synthetic room (`semsplat make-room`, 300 frames of 320x240) as it is, with `--walker`, and with
`--real`: drifting white balance, flying pixels, missing depth on shiny objects, at edges and at
grazing angles, and the walker. All have the same camera path. Runs have default settings; in rows
with "all mapped", `--mapping.no-moving-objects`. At most {MAX_VIEWS} tracked frames are
rendered at their estimated poses and at the exposure of the first frame, and compared with the
images of the clean room outside of the walker's mask, which is the same for every row: after
fitting one gain and one bias for each view, and after fitting one gain for each channel and view.
Behind the walker: within the mask instead, with the gain and bias from outside. Hidden: share of
the walker's pixels in keyframes that are left out of the map, and share of all pixels farther than
{TOLERANCE_PIXELS} pixels from the walker that are."""


@dataclass(frozen=True)
class Row:
    """One variant: a key of ROOMS, and the settings that differ from the defaults."""

    room: str
    settings: dict[str, Any]


ROWS = {
    CLEAN: Row("room", {}),
    "walker": Row("room-walker", {}),
    "walker, all mapped": Row("room-walker", MAPPED),
    REAL: Row("room-real", {}),
    "real, all mapped": Row("room-real", MAPPED),
}


@dataclass(frozen=True, kw_only=True)
class Options(ReportOptions):
    """Compare a room with imperfections and without."""

    seeds: int = 1
    """Seeds 0, 1, ... of rooms and runs; a row is their median."""
    frames: int | None = None
    """Number of frames from the start; all if unset. Give --out with it."""


def main() -> None:
    """Measure one row for each variant of the room."""
    options = tyro.cli(Options)
    report = Report("real-room", "Real room", DESCRIPTION, options, range(options.seeds))
    jobs = {name: {**vars(row), "max_frames": options.frames} for name, row in ROWS.items()}
    rows = report.measured(jobs, measure)
    report.write(table_of(COLUMNS, rows, "room"), target_table(targets(rows)))


def targets(rows: Rows) -> list[Target]:
    """How close the real room should come to the clean one."""
    median = median_of(rows)

    def behind(column: str, sign: float) -> float | None:
        real, clean = median(REAL, column), median(CLEAN, column)
        return None if real is None or clean is None else sign * (real - clean)

    return [
        Target(
            "ATE above that of the clean room, cm",
            behind("trajectory.ate_rmse_cm", 1.0),
            at_most=0.1,
        ),
        Target("PSNR below, dB", behind("psnr clean db", -1.0), at_most=1.5),
        Target(
            "PSNR per channel below, dB", behind("psnr clean per channel db", -1.0), at_most=1.5
        ),
    ]


def measure(job: dict[str, Any], seed: int) -> Metrics:
    """Run one variant; metrics.json and the comparison with the clean room."""
    place = room(job["room"], seed)
    dataset = open_dataset("synthetic", place, None, job["max_frames"])
    values = {"dataset": {"kind": "synthetic", "path": str(place)}, "seed": seed}
    settings = validated(RunSettings, job["settings"] | values | {"max_frames": job["max_frames"]})
    systems: list[Slam] = []
    with finished_slam(settings, dataset, systems.append) as run:
        tracked = tracked_frames(run.result, settings)
        (atlas,) = (slam.atlas for slam in systems)
        keyframes = [k for n in range(len(atlas)) for k in atlas.submap(n).keyframes]
        walker = walker_masks(room("room-real", seed))
        clean = open_dataset("synthetic", room("room", seed), None, job["max_frames"])
        return {
            **run.metrics,
            **against_clean(run.result.map, tracked, clean, walker),
            **(hidden(keyframes, walker) if job["room"] != "room" else {}),
        }


def walker_masks(folder: Path) -> Callable[[int], Mask]:
    """The walker's mask [H, W] of each frame of a room."""

    def mask(index: int) -> Mask:
        path = folder / "walker" / f"walker{index:06d}.png"
        image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        if image is None:
            raise SystemExit(f"{path} is missing; delete {folder} to render the room again")
        return np.asarray(image > 0)

    return mask


def against_clean(
    scene: GaussianScene,
    tracked: Sequence[TrackedFrame],
    clean: Dataset,
    walker: Callable[[int], Mask],
) -> Metrics:
    """PSNR of views of a map against images without imperfections, in front of no walker."""
    chosen = {round(i) for i in np.linspace(0, len(tracked) - 1, min(len(tracked), MAX_VIEWS))}
    affine, per_channel, behind = [], [], []
    for number in sorted(chosen):
        frame = tracked[number]
        image, mask = clean[frame.index], walker(frame.index)
        truth = image.rgb
        rendered = rendered_view(scene, frame, image.camera, tracked[0].exposure)
        fitted = affinely_fitted(rendered, truth, ~mask)
        affine.append(masked_psnr_db(fitted, truth, ~mask))
        pixels, true_pixels = rendered[~mask][None], truth[~mask][None]
        per_channel.append(psnr_db(balanced(pixels, true_pixels), true_pixels))
        if mask.mean() >= MIN_WALKER:
            behind.append(masked_psnr_db(fitted, truth, mask))
    return {
        "psnr clean db": mean_or_none(affine),
        "psnr clean per channel db": mean_or_none(per_channel),
        "psnr behind walker db": mean_or_none(behind),
    }


def rendered_view(
    scene: GaussianScene, frame: TrackedFrame, camera: Camera, exposure: Exposure
) -> Array:
    """Colour [H, W, 3] of a map at the pose of a frame and at an exposure."""
    gaussians = scene.visible_from(camera, frame.T_map_camera)
    output = render(gaussians, camera, se3.inverse(frame.T_map_camera))
    return np.asarray(exposure.undo(output.colour).numpy().clip(0.0, 1.0), np.float32)


def affinely_fitted(rendered: Array, truth: Array, mask: Mask) -> Array:
    """Rendered colours [H, W, 3] with the gain and bias that fit the true ones within a mask."""
    r, t = rendered[mask].reshape(-1).astype(np.float64), truth[mask].reshape(-1)
    design = np.stack([r, np.ones_like(r)], axis=1)
    (gain, bias), *_ = np.linalg.lstsq(design, t, rcond=None)
    return (gain * rendered + bias).clip(0.0, 1.0).astype(np.float32)


def hidden(keyframes: Sequence[Keyframe], walker: Callable[[int], Mask]) -> Metrics:
    """How much of the walker, and of the rest, is hidden in the keyframes."""
    visible = found = elsewhere = wrong = 0
    for keyframe in keyframes:
        mask = walker(keyframe.index)
        size = 2 * round(TOLERANCE_PIXELS * mask.shape[1] / 320) + 1
        beside = cv2.dilate(mask.astype(np.uint8), np.ones((size, size))) > 0
        left_out = np.zeros_like(mask)
        if keyframe.transient is not None:
            left_out = keyframe.transient.numpy()
        visible, found = visible + mask.sum(), found + (mask & left_out).sum()
        elsewhere, wrong = elsewhere + (~beside).sum(), wrong + (left_out & ~beside).sum()
    return {
        "walker hidden percent": 100.0 * float(found / max(visible, 1)),
        "wrongly hidden percent": 100.0 * float(wrong / max(elsewhere, 1)),
    }


if __name__ == "__main__":
    main()
