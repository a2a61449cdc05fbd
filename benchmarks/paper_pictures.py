"""Picture of views at the boundaries of submaps, by rule of allocation (G, Figure 6).

    python -m benchmarks.paper_pictures --out docs/images/allocation.jpg

The runs are those of `benchmarks.paper_tables`. Rows are the boundaries of the rule "motion" whose
renderings are worst; columns are the input image and the maps of both rules.
"""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import tyro
from numpy.typing import NDArray

from benchmarks.paper_plans import GROUPS
from benchmarks.paper_runs import Effort, PaperRuns
from benchmarks.repository import ROOT
from toolkit.base.geometry import se3
from toolkit.runs.evaluation.images import psnr_db
from toolkit.runs.maps.finished import FinishedRun, load_run
from toolkit.splatting.rendering import backend, render_surface

ROWS, SCALE, GAP = 3, 2, 4

Image = NDArray[np.uint8]


@dataclass(frozen=True, kw_only=True)
class Options:
    """Draw views at the boundaries of submaps."""

    out: Path = ROOT / "docs" / "images" / "allocation.jpg"
    """Picture to write."""


def main() -> None:
    """Render the boundaries of the rule motion with the maps of both rules."""
    options = tyro.cli(Options)
    runs = PaperRuns(GROUPS, Effort())
    motion, places = (
        load_run(runs.folder("ablation", "ring-0", settings))
        for settings in ("allocation-motion", "default")
    )
    shown = sorted(boundaries(motion), key=lambda index: quality_db(motion, index))[:ROWS]
    rows = [
        beside([observed(motion, index), rendered(motion, index), rendered(places, index)])
        for index in sorted(shown)
    ]
    cv2.imwrite(str(options.out), np.vstack(rows)[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 88])
    print(f"{options.out}: frames {sorted(shown)}", file=sys.stderr)


def boundaries(run: FinishedRun) -> list[int]:
    """Frames at which a submap of a run started."""
    verdicts = json.loads((run.folder.path / "frames.json").read_text())["allocation"]
    return [verdict["index"] for verdict in verdicts if verdict["reason"]]


def observed(run: FinishedRun, index: int) -> Image:
    """The input image of a frame."""
    return np.asarray((255.0 * run.open_dataset()[index].rgb).round(), np.uint8)


def rendered(run: FinishedRun, index: int) -> Image:
    """The map of a run at the pose of a frame."""
    (view,) = [frame for frame in run.tracked if frame.index == index]
    T_camera_map = se3.inverse(view.T_map_camera)
    shown = render_surface(backend("auto"), run.gaussians, run.camera, T_camera_map)
    colour = shown.output.colour.clamp(0.0, 1.0).numpy()
    return np.asarray((255.0 * colour).round(), np.uint8)


def quality_db(run: FinishedRun, index: int) -> float:
    """PSNR of the map of a run at a frame."""
    shown, seen = (
        image.astype(np.float32) / 255.0 for image in (rendered(run, index), observed(run, index))
    )
    return float(psnr_db(shown, seen))


def beside(images: list[Image]) -> Image:
    """Images in one row, enlarged, with gaps."""
    large = [
        cv2.resize(image, None, fx=SCALE, fy=SCALE, interpolation=cv2.INTER_CUBIC)
        for image in images
    ]
    height = large[0].shape[0]
    white = np.full((height, GAP, 3), 255, np.uint8)
    row = np.hstack([part for image in large for part in (image, white)][:-1])
    return np.vstack([row, np.full((GAP, row.shape[1], 3), 255, np.uint8)])


if __name__ == "__main__":
    main()
