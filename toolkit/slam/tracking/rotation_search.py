"""Initial poses of a frame by trying many rotations, for turns that alignment cannot follow.

The map is rendered once with a wider field of view, and the frame is aligned to it at the coarsest
pyramid level from rotations in all directions. Small blurred images suffice (as in PTAM's
relocalisation): alignment follows a few coarse pixels, and the grid of rotations covers the rest.
Neither texture that features need nor an overlap with a certain keyframe is required.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from toolkit.base.exposure import Exposure
from toolkit.base.geometry import se3
from toolkit.base.geometry.camera import Camera
from toolkit.slam.tracking.evidence import quality
from toolkit.splatting.alignment.backend import align, linearise
from toolkit.splatting.alignment.data import (
    INITIAL_SCALES,
    Alignment,
    FrameLevel,
    GaussNewtonOptions,
    LevelProblem,
    Linearisation,
    ModelLevel,
)
from toolkit.splatting.alignment.similarity import aligned_correlation

Array = NDArray[np.float64]

# Rotations about the camera's x and y axes that are tried, and the margin of the wide view beyond
# the frame's own. Alignment at the coarsest level follows half a step.
_PITCH_DEG = (-24.0, -16.0, -8.0, 0.0, 8.0, 16.0, 24.0)
_YAW_DEG = (-40.0, -32.0, *_PITCH_DEG, 32.0, 40.0)
_MARGIN_DEG = 25.0
# Cost of a pixel that the view does not cover, in units of the squared residual scales. That of a
# pixel with large residuals is about 5.
_UNCOVERED_COST = 4.0
# Number of coarse results that are aligned at all levels, and of poses that are returned.
_FOLLOWED, _RETURNED = 5, 2
# Closer results are one.
_SAME_RAD = 0.03


def wide_camera(camera: Camera) -> Camera:
    """The camera of half the resolution whose image has a margin around that of a camera."""
    half = camera.halved()
    x = _margin(half.width / (2 * half.fx)) * half.fx
    y = _margin(half.height / (2 * half.fy)) * half.fy
    # Levels are halved: sizes are multiples of eight.
    left, top = (8 * round(margin / 8) for margin in (x, y))
    return half.cropped(-left, -top, half.width + 2 * left, half.height + 2 * top)


def _margin(half_tangent: float) -> float:
    """Width of the margin in units of the focal length, limited for wide-angle cameras."""
    edge = min(np.arctan(half_tangent) + np.radians(_MARGIN_DEG), np.radians(60.0))
    return max(float(np.tan(edge)) - half_tangent, 0.0)


def rotated_starts(
    view: list[ModelLevel],
    frame: list[FrameLevel],
    T_view_camera: Array,
    exposure: Exposure,
    options: GaussNewtonOptions,
) -> list[Array]:
    """The poses T_view_camera [4, 4] with the best evidence, from rotations in all directions.

    Args:
        view: levels of the wide view of the map, from fine to coarse.
        frame: levels of the frame of the same resolutions.
        T_view_camera: [4, 4] predicted pose.
        exposure: of the frame against the map, about.
        options: of alignment; `max_distance` is that of the first level.
    """
    coarse = replace(options, max_distance=options.max_distance * 2 ** (len(view) - 1))
    found: list[tuple[float, Array]] = []
    for rotation in _rotations():
        start = Alignment(T_view_camera @ rotation, INITIAL_SCALES, exposure)
        T = align(view[-1:], frame[-1:], start, coarse).T_view_camera
        linear = linearise(
            LevelProblem(view[-1], frame[-1], T, INITIAL_SCALES, exposure, coarse.max_distance)
        )
        measured = float((frame[-1].depth_m > 0).sum())
        found.append((_cost(linear, measured), T))
    found.sort(key=lambda entry: entry[0])
    followed: list[tuple[float, Array]] = []
    for T in _distinct([T for _, T in found])[:_FOLLOWED]:
        start = Alignment(T, INITIAL_SCALES, exposure)
        T = align(view, frame, start, options).T_view_camera
        followed.append((quality(aligned_correlation(view[0], frame[0], T)), T))
    followed.sort(key=lambda entry: -entry[0])
    return _distinct([T for _, T in followed])[:_RETURNED]


def _rotations() -> list[Array]:
    """Rotations [4, 4] about the axes x and y."""
    return [se3.exp(np.radians([0.0, 0.0, 0.0, x, y, 0.0])) for x in _PITCH_DEG for y in _YAW_DEG]


def _cost(linear: Linearisation, measured: float) -> float:
    """Mean cost of the frame's pixels with depth, with those that the view does not cover."""
    covered = linear.depth_pixels
    if covered < 1:
        return float("inf")
    fit = linear.depth_variance * covered + linear.intensity_variance * linear.intensity_pixels
    return (fit + 2 * _UNCOVERED_COST * max(measured - covered, 0.0)) / max(measured, 1.0)


def _distinct(poses: Sequence[Array]) -> list[Array]:
    """The poses without those close to an earlier one."""
    kept: list[Array] = []
    for T in poses:
        differences = [se3.log(se3.inverse(other) @ T) for other in kept]
        if all(np.linalg.norm(d) > _SAME_RAD for d in differences):
            kept.append(T)
    return kept
