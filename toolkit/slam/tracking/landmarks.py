"""Landmarks: corners with measured depth, followed from frame to frame.

A second source of evidence for the pose of a frame, beside its alignment to the map. The images
show thin joints and small marks that the map blurs, and a corner is found again wherever it moves
within its neighbourhood, while dense alignment needs a motion of less than the texture's size.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from toolkit.base.geometry import se3
from toolkit.semantics.features.tracks import NO_FEATURES, Features, FeatureTracks
from toolkit.slam.tracking.feature_pose import FeaturePose, Observations, projected
from toolkit.splatting.alignment.data import FrameLevel

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

# Features per image, and fraction of them below which new ones are found.
_COUNT, _MIN_KEPT = 200, 0.6
# Eigenvalue of the structure tensor at which a direction has half the weight of a sharp corner, and
# the block that it is computed from in pixels.
_EDGE, _BLOCK = 0.005, 9
# Quantile of the smaller eigenvalues of an image that noise causes, as long as they are this small,
# and how far a direction must exceed it.
_BLANK, _MAX_BLANK, _NOISE = 0.1, 2e-4, 4.0
# Maximum difference of the depths around a feature, as a fraction of depth.
_SAME_SURFACE = 0.08


class Landmarks:
    """Follows features whose points in the map are known."""

    def __init__(self, frame: FrameLevel | None = None, T_map_camera: Array | None = None) -> None:
        """Start with the features of a frame, if there is one, at its pose [4, 4]."""
        self._tracks = FeatureTracks(_COUNT)
        self._ids = np.zeros(0, np.int64)
        self._corrected = 0
        self._points, self._weights = np.zeros((0, 3)), np.zeros((0, 2, 2))
        self._certain = np.zeros(0, bool)
        self._before: tuple[Image, Features] | None = None
        if frame is not None and T_map_camera is not None:
            self.extend(frame, T_map_camera)

    def locate(self, frame: FrameLevel, starts: Sequence[Array]) -> FeaturePose | None:
        """Follow the features into the next frame, and find its pose; None if they are too few.

        Args:
            starts: T_map_camera [4, 4] where the camera may be, from the likeliest to that of the
                last frame.
        """
        before = self._tracks.features
        if not len(before):
            return None
        self._before = self._tracks.image, before
        known = self._points[np.searchsorted(self._ids, before.ids)]
        guesses = [projected(frame.camera, known, T) for T in starts]
        features = self._tracks.follow(_grey(frame), guesses)
        rows = np.searchsorted(self._ids, features.ids)
        flow = features.px - before.px[np.searchsorted(before.ids, features.ids)]
        points, weights, certain = self._points[rows], self._weights[rows], self._certain[rows]
        seen = Observations(frame.camera, points, features.px, flow, weights, certain)
        pose = seen.pose(starts)
        if pose is not None:
            self._tracks.keep(pose.fits)
        return pose

    def extend(self, frame: FrameLevel, T_map_camera: Array, certain: bool = True) -> None:
        """Find new features in the frame that was located last, if many were lost.

        Args:
            T_map_camera: [4, 4] its pose.
            certain: whether it is right. The features of a doubtful frame are followed, but tell
                only how the camera moved since then; they go when a frame is certain again.
        """
        before = self._tracks.features
        if certain:
            self._tracks.keep(self._certain[np.searchsorted(self._ids, before.ids)])
            before = self._tracks.features
        if not len(before):
            self._tracks.continue_from(_grey(frame), NO_FEATURES)
        elif len(before) > _MIN_KEPT * _COUNT:
            return
        features, image, camera = self._tracks.replenish(), self._tracks.image, frame.camera
        depth = _depths(frame.depth_m.cpu().numpy(), features.px[len(before) :])
        measured = depth > 0
        self._tracks.keep(np.concatenate([np.ones(len(before), bool), measured]))
        px, depth = features.px[len(before) :][measured], depth[measured]
        rays = np.column_stack(
            [(px - [camera.cx, camera.cy]) / [camera.fx, camera.fy], np.ones(len(px))]
        )
        kept = np.searchsorted(self._ids, before.ids)
        self._ids = self._tracks.features.ids
        points = se3.transform_points(T_map_camera, rays * depth[:, None])
        self._points = np.concatenate([self._points[kept], points])
        self._weights = np.concatenate([self._weights[kept], _information(image, px)])
        self._certain = np.concatenate([self._certain[kept], np.full(len(px), certain)])

    def undo(self) -> None:
        """Forget the frame that was located last: the next one is compared with that before."""
        if self._before is not None:
            self._tracks.continue_from(*self._before)

    def change_frame(self, T_new_old: Array) -> None:
        """Change the coordinate frame of the map."""
        self._points = se3.transform_points(T_new_old, self._points)

    def correct(self, T_new_old: Array) -> None:
        """Move the features found since the last correction, whose poses are wrong by a motion."""
        moved = self._ids >= self._corrected
        self._points[moved] = se3.transform_points(T_new_old, self._points[moved])
        self._corrected = int(self._ids[-1]) + 1 if len(self._ids) else 0

    def state(self) -> dict[str, NDArray]:
        """Arrays from which `restore` continues identically."""
        own = {"landmarks": self._ids, "points": self._points, "weights": self._weights}
        own |= {"certain": self._certain, "corrected": np.array(self._corrected)}
        return self._tracks.state() | own

    def restore(self, state: Mapping[str, NDArray]) -> None:
        """Restore an earlier `state`."""
        self._tracks.restore(state)
        self._ids, self._points, self._weights, self._certain = (
            np.array(state[name]) for name in ("landmarks", "points", "weights", "certain")
        )
        self._corrected = int(state["corrected"])


def _grey(frame: FrameLevel) -> Image:
    """The image [H, W] of a frame in bytes."""
    return np.asarray(cv2.convertScaleAbs(frame.intensity.cpu().numpy(), alpha=255.0))


def _depths(depth_m: NDArray[np.float32], px: Array) -> Array:
    """Depths [N] at pixels [N, 2] (m), 0 where they are missing or belong to an edge."""
    column, row = np.rint(px).astype(int).T
    around = np.stack([depth_m[row + j, column + i] for j in (-1, 0, 1) for i in (-1, 0, 1)])
    low, high = around.min(axis=0), around.max(axis=0)
    good = (low > 0) & (high - low < _SAME_SURFACE * low)
    return np.where(good, around[4], 0.0).astype(np.float64)


def _information(image: Image, px: Array) -> Array:
    """Relative information [N, 2, 2] about the places of features, 1 across sharp edges."""
    tensors = cv2.cornerEigenValsAndVecs(image, _BLOCK, 3)
    blank = float(np.quantile(tensors[::_BLOCK, ::_BLOCK, :2].min(axis=-1), _BLANK))
    column, row = np.rint(px).astype(int).T
    values = tensors[row, column].astype(np.float64)
    directions = values[:, 2:].reshape(-1, 2, 2)
    signal = np.maximum(values[:, :2] - _NOISE * min(blank, _MAX_BLANK), 0.0)
    return np.einsum("nki,nk,nkj->nij", directions, signal / (signal + _EDGE), directions)
