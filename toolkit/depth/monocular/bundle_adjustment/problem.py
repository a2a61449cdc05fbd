"""Data of a bundle adjustment."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from toolkit.base.geometry.camera import Camera


@dataclass(frozen=True)
class Landmarks:
    """Points of the scene, each a pixel of one image with an inverse depth.

    Attributes:
        anchor: [L] int32 pose of the image.
        anchor_px: [L, 2] float64 pixel in it.
        inverse_depth: [L] float64 inverse z-depth there, > 0.
        prior: [L, 2] float64 expected inverse depth and its information, the inverse variance; an
            information of 0 means that nothing is known.
    """

    anchor: NDArray[np.int32]
    anchor_px: NDArray[np.float64]
    inverse_depth: NDArray[np.float64]
    prior: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.anchor)


@dataclass(frozen=True)
class Observations:
    """Pixels of landmarks in other images than their anchors'.

    Attributes:
        landmark: [O] int32, ascending. pose: [O] int32. px: [O, 2] float64.
    """

    landmark: NDArray[np.int32]
    pose: NDArray[np.int32]
    px: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.landmark)


@dataclass(frozen=True)
class BundleProblem:
    """Image points to be explained by poses and inverse depths.

    Attributes:
        camera: intrinsics of all images, without distortion.
        T_world_camera: [P, 4, 4] initial poses.
        fixed: [P] bool, poses that are held. Two poses fix the coordinate frame and the scale.
        landmarks: with initial inverse depths.
        observations: of the landmarks.

    Raises:
        ValueError: shapes disagree, an index is out of range, observations are not in the order of
            their landmarks, or an observation is in its landmark's anchor.
    """

    camera: Camera
    T_world_camera: NDArray[np.float64]
    fixed: NDArray[np.bool_]
    landmarks: Landmarks
    observations: Observations

    def __post_init__(self) -> None:
        poses, count = len(self.T_world_camera), len(self.landmarks)
        marks, seen = self.landmarks, self.observations
        shapes = {
            "T_world_camera": (self.T_world_camera, (poses, 4, 4)),
            "fixed": (self.fixed, (poses,)),
            "anchor_px": (marks.anchor_px, (count, 2)),
            "inverse_depth": (marks.inverse_depth, (count,)),
            "prior": (marks.prior, (count, 2)),
            "pose": (seen.pose, (len(seen),)),
            "px": (seen.px, (len(seen), 2)),
        }
        for name, (array, shape) in shapes.items():
            if array.shape != shape:
                raise ValueError(f"{name} must have shape {list(shape)}, got {list(array.shape)}")
        _check_range("anchor", marks.anchor, poses)
        _check_range("pose", seen.pose, poses)
        _check_range("landmark", seen.landmark, count)
        if (np.diff(seen.landmark) < 0).any():
            raise ValueError("observations must be in the order of their landmarks")
        if (marks.anchor[seen.landmark] == seen.pose).any():
            raise ValueError("an observation must not be in the anchor of its landmark")


def _check_range(name: str, indices: NDArray[np.int32], count: int) -> None:
    if len(indices) and (indices.min() < 0 or indices.max() >= count):
        raise ValueError(f"{name} must be in [0, {count}), got {indices.min()} to {indices.max()}")


@dataclass(frozen=True)
class BundleOptions:
    """When to stop, and what to estimate.

    Attributes:
        iterations: maximum number of linearisations.
        huber_px: reprojection errors above it have linear cost.
        min_inverse_depth: lower bound of the inverse depths.
        min_decrease: a smaller relative decrease of the cost ends the iterations.
        focal: estimate a common factor of both focal lengths, too.
    """

    iterations: int = 20
    huber_px: float = 1.0
    min_inverse_depth: float = 1e-4
    min_decrease: float = 1e-4
    focal: bool = False


@dataclass(frozen=True)
class BundleResult:
    """Adjusted parameters.

    Attributes:
        T_world_camera: [P, 4, 4].
        inverse_depth: [L].
        error_px: [O] distance of each observation from its landmark's projection; 1000 for points
            behind the camera.
        cost_before, cost: Huber's cost of the errors and the squared deviations from the priors.
        focal_factor: of both focal lengths; 1 unless it was estimated.
        focal_sigma: standard deviation of its logarithm for errors of one pixel; infinite if it is
            not determined, 0 unless it was estimated.
        iterations: number of linearisations.
        converged: whether the cost has stopped decreasing.
    """

    T_world_camera: NDArray[np.float64]
    inverse_depth: NDArray[np.float64]
    error_px: NDArray[np.float64]
    cost_before: float
    cost: float
    focal_factor: float
    focal_sigma: float
    iterations: int
    converged: bool
