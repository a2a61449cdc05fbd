"""Which side of the images is up, by the floor and walls that a few frames without poses show.

The prior on the camera's attitude, turned to each side, yields a direction up for each frame. The
right side is the one whose directions agree: its pitch and roll hardly change, because nobody
turns a camera about the walls, and floors and table tops face up, whereas only ceilings face down.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from toolkit.base.frame import Frame
from toolkit.base.geometry.image_sides import BORDERS, ImageSide, turned_upright
from toolkit.semantics.segmenters.geometric.gravity import UpEstimator, attitude
from toolkit.semantics.segmenters.geometric.patches import planar_patches
from toolkit.semantics.segmenters.geometric.surface_grid import SurfaceGrid, surface_grid

Array = NDArray[np.float64]

# Number of cells across the image, and minimum number of frames that show planes.
_COLUMNS, _MIN_FRAMES = 80, 4
_POINTS = 1200
# Cosine of the maximum tilt of surfaces that face up or down.
_LEVEL = np.cos(np.radians(20.0))
# The score is the weighted balance of surfaces that face up and down, minus the deviations of pitch
# and roll from their medians and minus the median roll, in these units and up to these limits.
_BALANCE, _PITCH_RAD, _ROLL_RAD, _TILT_RAD = 2.0, *np.radians([10.0, 15.0, 45.0])
_MAX_PITCH, _MAX_ROLL = 1.5, 2.0
# Fraction of the image at which the balance of few surfaces is half of that of many.
_FEW = 0.05
# Another side is doubtful or certain from this margin between the scores and this disorder of the
# assumed side. Parts of recordings whose camera hardly turns remain below.
_DOUBTFUL, _CERTAIN = (0.5, 0.3), (0.6, 0.5)
# Surfaces at this height above the lowest one that faces up, and the minimum fraction of the image
# that they fill in views of a furnished floor. Ceilings have none: 0.007 at most.
_RAISED_M, _MIN_RAISED = 0.15, 0.01


@dataclass(frozen=True)
class SideJudgement:
    """The side of the images that is up.

    Attributes:
        side: the assumed side unless the frames contradict it.
        rival: another side that may be up instead; None without doubt.
    """

    side: ImageSide
    rival: ImageSide | None = None


@dataclass(frozen=True)
class _Views:
    """What frames [N] show if a side is up.

    Attributes:
        pitch_rad, roll_rad: attitude of the camera.
        balance: difference of the areas that face up and down, divided by their sum, -1 to 1.
        raised: fraction of the image on surfaces that face up above the lowest one.
    """

    pitch_rad: Array
    roll_rad: Array
    balance: Array
    raised: Array

    @property
    def score(self) -> float:
        return _BALANCE * float(self.balance.mean()) - self.disorder

    @property
    def disorder(self) -> float:
        """How much pitch and roll deviate from those of a camera that is held in one way."""
        pitch_rad, roll_rad = np.median(self.pitch_rad), np.median(self.roll_rad)
        pitch = np.abs(self.pitch_rad - pitch_rad) / _PITCH_RAD
        roll = np.abs(self.roll_rad - roll_rad) / _ROLL_RAD
        changes = np.minimum(pitch, _MAX_PITCH) + np.minimum(roll, _MAX_ROLL)
        return float(changes.mean() + abs(roll_rad) / _TILT_RAD)

    @property
    def reversal(self) -> float:
        """How much area faces down instead of up."""
        return _BALANCE * max(0.0, -float(self.balance.mean()))


def judge_side(frames: Iterable[Frame]) -> SideJudgement:
    """Find the side of the images that is up; the top, unless the frames contradict it.

    Args:
        frames: with depth, spread over the recording.

    Raises:
        DependencyError: Open3D cannot be loaded.
    """
    rows: dict[ImageSide, list[tuple[float, float, float, float]]] = {s: [] for s in BORDERS}
    for frame in frames:
        grid = surface_grid(frame.depth_m, frame.camera, _COLUMNS)
        patches = planar_patches(grid, _POINTS)
        if not patches:
            continue
        normals = np.array([p.normal for p in patches])
        fractions = np.array([p.cells.sum() for p in patches]) / int(grid.valid.sum())
        for side, found in rows.items():
            found.append(_view(grid, normals, fractions, side))
    if len(rows["top"]) < _MIN_FRAMES:
        return SideJudgement("top")
    return _judged({side: _Views(*np.array(found).T) for side, found in rows.items()}, "top")


def _judged(views: Mapping[ImageSide, _Views], assumed: ImageSide) -> SideJudgement:
    best = max(views, key=lambda side: views[side].score)
    margin = views[best].score - views[assumed].score
    reverses = best == _opposite(assumed)
    # A ceiling in view is evidence for the opposite side alone.
    implausibility = views[assumed].disorder + reverses * views[assumed].reversal
    contradiction = margin, implausibility
    if not _reaches(contradiction, _DOUBTFUL):
        return SideJudgement(assumed)
    if not _reaches(contradiction, _CERTAIN):
        return SideJudgement(assumed, best)
    # A ceiling looks like an empty floor to a camera that is upside down.
    furnished = float(views[best].raised.mean()) >= _MIN_RAISED
    if furnished or not reverses:
        return SideJudgement(best, None if furnished else _opposite(best))
    return SideJudgement(assumed, best)


def _reaches(values: tuple[float, float], least: tuple[float, float]) -> bool:
    return values[0] >= least[0] and values[1] >= least[1]


def _opposite(side: ImageSide) -> ImageSide:
    return BORDERS[(BORDERS.index(side) + 2) % len(BORDERS)]


def _view(
    grid: SurfaceGrid, normals: Array, fractions: Array, side: ImageSide
) -> tuple[float, float, float, float]:
    """Return the values of `_Views` of one frame.

    Args:
        normals, fractions: [N, 3] normals of planes, and [N] fractions of the image.
    """
    estimator = UpEstimator(side)
    estimator.update(normals, fractions, np.eye(3))
    up = estimator.direction
    pitch_rad, roll_rad = attitude(up[None] @ turned_upright(side))
    slope = grid.normals[grid.oriented] @ up
    faces_up = slope > _LEVEL
    upward, downward = float(faces_up.mean()), float((slope < -_LEVEL).mean())
    balance = (upward - downward) / (upward + downward + _FEW)
    raised = 0.0
    if faces_up.any():
        heights_m = (grid.points[grid.oriented] @ up)[faces_up]
        raised = upward * float((heights_m > np.percentile(heights_m, 5) + _RAISED_M).mean())
    return float(pitch_rad[0]), float(roll_rad[0]), balance, raised
