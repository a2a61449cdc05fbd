"""Image matching: the relative pose of two keyframes from their observed images.

The map is not used: two renderings of one map agree regardless of its drift.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from toolkit.base.caching import LruCache
from toolkit.base.geometry import se3
from toolkit.base.geometry.camera import Camera
from toolkit.base.keyframe import Keyframe
from toolkit.semantics.features.keypoints import Keypoints, detect_keypoints, match_keypoints
from toolkit.splatting.alignment.covariance import clustered_information
from toolkit.splatting.alignment.data import ResidualScales
from toolkit.splatting.alignment.health import HealthLimits, failure_reason
from toolkit.splatting.alignment.joint import Estimate, JointOptions, Pair, align
from toolkit.splatting.alignment.levels import (
    keyframe_level,
    limited_to_width,
    model_level,
    pyramid,
)

Array = NDArray[np.float64]

# Number of RANSAC hypotheses, each from three matches, and minimum number of inliers.
HYPOTHESES, MIN_MATCHES = 500, 12
# Maximum number of SIFT features per image, and ratio of the descriptor distances of the nearest
# and the second nearest match.
_FEATURES, _RATIO = 1500, 0.8
# Maximum direction error of an inlier, in radians and, for small images, in pixels of the coarser
# camera; and its maximum depth error, as a fraction of depth.
_TOLERANCE_RAD, _TOLERANCE_PIXELS, _TOLERANCE_DEPTH = 0.008, 1.5, 0.05
_MIN_DEPTH_M = 0.05

# Wider images are halved for dense alignment. Matches are accurate to one or two pixels, so that
# few levels suffice.
_MAX_WIDTH = 400
_DENSE = JointOptions(levels=3)
_LIMITS = HealthLimits()
# Maximum correction of an initial pose by dense alignment: as a fraction of the image's width, or
# in pixels of the coarser camera if that is larger. After a larger one, one of the two poses is
# wrong. Where a sensor's depth is not registered to its colour image, as in 7-Scenes, the depth at
# a feature may be that of another surface: correct motions were corrected by 5 % of the width.
_MAX_CORRECTION, _MAX_CORRECTION_OF_MATCHES, _MAX_CORRECTION_PIXELS = 0.02, 0.08, 3.0


@dataclass(frozen=True)
class Offset:
    """Relative pose of two keyframes.

    Attributes:
        T_first_second: [4, 4] float64.
        matches: number of inlier matches before dense alignment.
        visible: fraction of the second image's measured pixels explained by the first image.
        residual: robust scales of intensity and of depth at 1 m (m).
        information: [6, 6] inverse covariance of x in T_first_second exp(x), translation
            first.
        iterations: of the dense alignment.
    """

    T_first_second: Array
    matches: int
    visible: float
    residual: ResidualScales
    information: Array = field(repr=False)
    iterations: int = 0


def measure_offset(
    first: Keyframe,
    second: Keyframe,
    generator: np.random.Generator | None = None,
) -> Offset | None:
    """Measure the relative pose of two keyframes from their observed images.

    RANSAC on SIFT matches with depth in both images gives an initial pose. Dense alignment of
    colour and depth then refines it, with the first image as the model.

    Args:
        generator: samples the triples of matches; by default one with a fixed seed.

    Returns:
        The offset, or None if the images do not determine one.
    """
    matched = match_features(first, second)
    if matched is None:
        return None
    found = matched.motion(generator or np.random.default_rng(0), MIN_MATCHES)
    return None if found is None else refine_offset(first, second, *found)


def refine_offset(first: Keyframe, second: Keyframe, start: Array, matches: int) -> Offset | None:
    """The offset after dense alignment, or None if that is not reliable.

    Args:
        start: T_first_second [4, 4] from feature matches.
        matches: number of inliers of these.
    """
    levels, frame = (
        pyramid(limited_to_width(keyframe_level(keyframe), _MAX_WIDTH), _DENSE.levels)
        for keyframe in (first, second)
    )
    pair = Pair([model_level(level) for level in levels], frame, np.eye(4), np.eye(4))
    estimate = align([pair], Estimate(start), _DENSE)
    measured = float((frame[0].depth_m > 0).sum())
    visible = float(estimate.pixels.sum()) / max(measured, 1.0)
    failed = failure_reason(_LIMITS, estimate.scales, visible, estimate.information, measured)
    end = estimate.T_target_source
    if failed or correction_too_large(start, end, first.camera, second, _MAX_CORRECTION_OF_MATCHES):
        return None
    return Offset(
        estimate.T_target_source,
        matches,
        visible,
        estimate.scales,
        clustered_information([pair], estimate, _DENSE),
        estimate.iterations,
    )


def correction_too_large(
    start: Array,
    end: Array,
    camera: Camera,
    second: Keyframe,
    max_correction: float = _MAX_CORRECTION,
) -> bool:
    """Whether dense alignment moved a keyframe by more than the error of an initial pose.

    Args:
        start, end: T_first_second [4, 4] before and after dense alignment.
        camera: camera of the first keyframe.
        second: the second keyframe.
        max_correction: median shift of its points, as a fraction of the image's width.
    """
    points = second.points.astype(np.float64)
    if len(points) == 0:
        return True
    before, after = se3.transform_points(start, points), se3.transform_points(end, points)
    ahead = (before[:, 2] > _MIN_DEPTH_M) & (after[:, 2] > _MIN_DEPTH_M)
    if not ahead.any():
        return True
    shift = np.linalg.norm(camera.project(before[ahead]) - camera.project(after[ahead]), axis=1)
    pixels = _MAX_CORRECTION_PIXELS * _pixel_size(camera, second.camera)
    max_shift = max(max_correction * camera.width, pixels)
    return bool(np.median(shift) > max_shift)


def _pixel_size(first: Camera, second: Camera) -> float:
    """Size of the coarser camera's pixels in pixels of the first camera."""
    return max(1.0, first.focal / second.focal)


def match_features(
    first: Keyframe,
    second: Keyframe,
    keypoints: Callable[[Keyframe], Keypoints] | None = None,
) -> Matched | None:
    """Mutual matches of two images with depth in both; None without any.

    Args:
        keypoints: detects the keypoints of a keyframe; by default without a cache.
    """
    keypoints = keypoints or keyframe_keypoints
    a, b = keypoints(first), keypoints(second)
    matches = match_keypoints(a, b, _RATIO)
    if len(matches) == 0:
        return None
    pixels_a, pixels_b = a.px[matches[:, 0]], b.px[matches[:, 1]]
    points_a = _points_at(first, pixels_a)
    points_b = _points_at(second, pixels_b)
    measured = (points_a[:, 2] > 0) & (points_b[:, 2] > 0)
    if not measured.any():
        return None
    pixel_size = _pixel_size(first.camera, second.camera)
    points_a, points_b, pixels_a = points_a[measured], points_b[measured], pixels_a[measured]
    return Matched(points_a, points_b, pixels_a, first.camera, pixel_size)


def keyframe_keypoints(keyframe: Keyframe) -> Keypoints:
    """Keypoints of a keyframe's image."""
    grey = cv2.cvtColor(keyframe.rgb.permute(1, 2, 0).contiguous().numpy(), cv2.COLOR_RGB2GRAY)
    return detect_keypoints(grey, _FEATURES)


class KeypointCache:
    """Keypoints of the keyframes that were used last.

    Args:
        size: maximum number of keyframes; each needs up to 1 MB and is kept in memory itself.
    """

    def __init__(self, size: int = 64) -> None:
        self._found: LruCache[Keypoints] = LruCache(size)

    def __call__(self, keyframe: Keyframe) -> Keypoints:
        """Keypoints of a keyframe's image."""
        # Keyframes of different runs may have the same number, so that objects are compared.
        return self._found.get(id(keyframe), lambda: keyframe_keypoints(keyframe), (keyframe,))


def _points_at(keyframe: Keyframe, pixels: Array) -> Array:
    """Observed points [n, 3] in camera coordinates at pixels [n, 2]; z is 0 where missing."""
    x = np.clip(np.rint(pixels[:, 0]).astype(int), 0, keyframe.camera.width - 1)
    y = np.clip(np.rint(pixels[:, 1]).astype(int), 0, keyframe.camera.height - 1)
    depth = keyframe.depth_m.numpy()[y, x].astype(np.float64)
    camera = keyframe.camera
    rays = np.column_stack([(pixels - [camera.cx, camera.cy]) / [camera.fx, camera.fy], x * 0 + 1])
    return rays * depth[:, None]


@dataclass(frozen=True)
class Matched:
    """n matched features of two keyframes, whose cameras may differ.

    Attributes:
        first, second: points [n, 3] in the coordinates of the first and of the second camera (m).
        pixels: [n, 2] pixels in the first image.
        camera: camera of the first image.
        pixel_size: size of the coarser camera's pixels, in pixels of the first image.
    """

    first: Array
    second: Array
    pixels: Array
    camera: Camera
    pixel_size: float = 1.0

    def motion(
        self,
        generator: np.random.Generator,
        min_matches: int,
        fits: Callable[[Array, Array], Array] | None = None,
    ) -> tuple[Array, int] | None:
        """The motion with the most inliers, and their number; None below `min_matches`.

        Args:
            fits: fits motions [H, 4, 4] to points; by default `rigid_fits`.
        """
        fits = fits or rigid_fits
        n = len(self.first)
        if n < min_matches:
            return None
        triples = np.argsort(generator.random((HYPOTHESES, n)), axis=1)[:, :3]
        motions = fits(self.first[triples], self.second[triples])
        inliers = self.inliers(motions)
        best = inliers[int(np.argmax(inliers.sum(axis=1)))]
        T = np.eye(4)
        for _ in range(3):
            if best.sum() < min_matches:
                return None
            T = fits(self.first[best][None], self.second[best][None])[0]
            best = self.inliers(T[None])[0]
        count = int(best.sum())
        return (T, count) if count >= min_matches else None

    def inliers(self, motions: Array) -> NDArray[np.bool_]:
        """Mask [H, n] of the matches that are inliers of motions [H, 4, 4]."""
        moved = np.einsum("hij,nj->hni", motions[:, :3, :3], self.second)
        moved += motions[:, None, :3, 3]
        depth = moved[..., 2]
        safe = np.where((depth > _MIN_DEPTH_M)[..., None], moved, [0.0, 0.0, 1.0])
        error = np.linalg.norm(self.camera.project(safe) - self.pixels, axis=-1)
        tolerance = max(_TOLERANCE_RAD * self.camera.focal, _TOLERANCE_PIXELS * self.pixel_size)
        near = np.abs(depth - self.first[:, 2]) < _TOLERANCE_DEPTH * self.first[:, 2]
        return (depth > _MIN_DEPTH_M) & (error < tolerance) & near


def rigid_fits(first: Array, second: Array) -> Array:
    """Least-squares motions [H, 4, 4] from points second [H, m, 3] to points first [H, m, 3]."""
    centre_a, centre_b = first.mean(axis=1), second.mean(axis=1)
    a, b = first - centre_a[:, None], second - centre_b[:, None]
    U, _, Vt = np.linalg.svd(np.swapaxes(a, 1, 2) @ b)
    flip = np.sign(np.linalg.det(U @ Vt))
    U[:, :, 2] *= flip[:, None]  # no reflections
    T = np.tile(np.eye(4), (len(first), 1, 1))
    T[:, :3, :3] = U @ Vt
    T[:, :3, 3] = centre_a - np.einsum("hij,hj->hi", T[:, :3, :3], centre_b)
    return T


def similarity_fits(first: Array, second: Array) -> Array:
    """As `rigid_fits`, with a scale in the left 3x3 block (Horn 1987)."""
    T = rigid_fits(first, second)
    centre_a, centre_b = first.mean(axis=1), second.mean(axis=1)
    size_a, size_b = (
        np.linalg.norm(points - centre[:, None], axis=(1, 2))
        for points, centre in ((first, centre_a), (second, centre_b))
    )
    T[:, :3, :3] *= (size_a / np.maximum(size_b, 1e-12))[:, None, None]
    T[:, :3, 3] = centre_a - np.einsum("hij,hj->hi", T[:, :3, :3], centre_b)
    return T
