"""Free space: removes Gaussians from space that keyframes measured as empty.

The measured depth of a keyframe implies that the space in front of it is empty. Wrong depth (at
edges, of glass and plants, filled in by the device, or from matching beside object borders) places
Gaussians in such space, where they hide what other keyframes see behind them. A Gaussian is removed
if the keyframes that measured through it outweigh those that measured a surface at its place.

Each measurement has a confidence: it decreases with the obliqueness of the surface and with the
distance, and it is 0 beside depth edges, where a pixel may belong to either side.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from toolkit.base.geometry import se3
from toolkit.base.geometry.camera import Camera
from toolkit.base.geometry.free_space import FREE_SPACE, FREE_SPACE_M, free_space_margin_m
from toolkit.base.geometry.voxels import voxel_keys, voxels_of
from toolkit.base.keyframe import Keyframe, evenly_spaced
from toolkit.base.native import address, kernels_for
from toolkit.slam.mapping.depth_views import MIN_DEPTH_M, DepthImage, DepthView, DepthViews
from toolkit.splatting.gaussians.cloud import GaussianCloud

Array = NDArray[np.float64]

# Maximum fraction of the seeds of a keyframe that earlier keyframes may rule out.
_MAX_DROPPED = 0.2
# Minimum sum of the confidences of the keyframes that measured through a Gaussian, in general and
# where no keyframe measured a surface; and its minimum ratio to the number of those that measured a
# surface at its place.
_MIN_THROUGH, _MIN_THROUGH_UNMEASURED, _MIN_RATIO = 1.0, 0.1, 0.33
# Maximum number of keyframes compared while the map grows, spread over those of the submap.
_VIEWS = 8
# Maximum radius of Gaussians at such points, as an angle in any frame that shows them: ten times
# that of a pixel of a usual camera. A small one for a keyframe at four metres covered half a frame
# that passed it at a quarter of a metre.
_MAX_UNMEASURED_RAD = 0.03

# Distance in metres in front of a camera within which it sees no surface: sensors do not measure
# that near, and a single Gaussian there would hide the scene.
_CLEAR_M = 0.15


def is_measured(keyframes: Iterable[Keyframe]) -> bool:
    """Whether the depth of these keyframes is measured.

    The depth of priors is no measurement: it is aligned with the map, and may be noisy everywhere.
    """
    return all(keyframe.prior_m is None for keyframe in keyframes)


@dataclass(frozen=True)
class Evidence:
    """Evidence about N points: sums over keyframes.

    Attributes:
        through: [N] confidences of the keyframes that measured a surface behind the point.
        support: [N] number of the keyframes that measured a surface at the point.
        nearest_m: [N] smallest depth of the point in a frame that shows it, or infinity.
    """

    through: Tensor
    support: Tensor
    nearest_m: Tensor

    @classmethod
    def of(cls, means: Tensor, views: Iterable[DepthView], whole_map: bool = True) -> Evidence:
        """Evidence of views about points [N, 3].

        Args:
            whole_map: the points are those of a map, so that the reliability of each view follows
                from them. Otherwise views are reliable.
        """
        zeros = means.new_zeros(len(means))
        evidence = cls(zeros, zeros.clone(), torch.full_like(zeros, torch.inf))
        for view in views:
            evidence.add(view, means, whole_map)
        return evidence

    def add(self, view: DepthView, means: Tensor, whole_map: bool) -> None:
        """Add the evidence of a view about the points [N, 3], in place."""
        module = kernels_for(means)
        if module is None:
            self._add_torch(view, means, whole_map)
            return
        image, points = view.image, means.contiguous()
        images = [torch.from_numpy(a) for a in (image.depth_m, image.empty_m, image.confidence)]
        module.add_evidence(
            address(points),
            len(points),
            *view.geometry,
            [address(values) for values in images],
            (MIN_DEPTH_M, FREE_SPACE_M, FREE_SPACE),
            whole_map,
            [address(values) for values in (self.through, self.support, self.nearest_m)],
        )

    def _add_torch(self, view: DepthView, means: Tensor, whole_map: bool) -> None:
        """As `add`, in torch: reference and fallback of the native kernel, and for GPUs."""
        chosen, pixel, z = view.pixels_of(means)
        if not len(chosen):
            return
        image = view.image
        depth, empty, confidence = (
            torch.from_numpy(values.reshape(-1)).to(means.device).index_select(0, pixel)
            for values in (image.depth_m, image.empty_m, image.confidence)
        )
        margin = free_space_margin_m(depth)
        # Beside edges, a surface is as well measured as elsewhere; only its border is not.
        near, through = (depth > 0) & ((z - depth).abs() <= margin), z < empty
        reliability = 1.0
        if whole_map:
            # A keyframe at a wrong pose or with wrong depth contradicts much of the map.
            agreeing, contradicting = int(near.sum()), int(through.sum())
            reliability = (agreeing / max(agreeing + contradicting, 1)) ** 2
        self.through.index_add_(0, chosen, reliability * confidence * through)
        self.support.index_add_(0, chosen, near.to(means.dtype))
        self.nearest_m[chosen] = torch.minimum(self.nearest_m[chosen], z)

    def pass_by(self, means: Tensor, camera: Camera, T_map_cameras: Array) -> None:
        """Let frames without depth come near the points [N, 3] that no keyframe measured.

        Args:
            camera: intrinsics of all frames.
            T_map_cameras: [P, 4, 4] poses of the frames.
        """
        unmeasured = (self.support == 0).nonzero().squeeze(1)
        nothing, some = DepthImage.missing(camera), means.index_select(0, unmeasured)
        passed = Evidence.of(some, (DepthView.at(T, nothing) for T in T_map_cameras))
        nearest_m = self.nearest_m.index_select(0, unmeasured)
        self.nearest_m[unmeasured] = torch.minimum(nearest_m, passed.nearest_m)

    def contradicts(self) -> Tensor:
        """Mask [N] of the points in empty space."""
        enough = self.through >= _MIN_THROUGH
        return enough & (self.through > _MIN_RATIO * self.support)

    def contradicts_in_map(self, radii_m: Tensor) -> Tensor:
        """Mask [N] of the Gaussians in empty space, by the evidence of all keyframes of a map.

        Gaussians without support are in doubt: only their colour was observed. One keyframe that
        measured through them suffices, or one so near that it would be a blob.

        Args:
            radii_m: [N] radii of the Gaussians.
        """
        in_doubt = self.through >= _MIN_THROUGH_UNMEASURED
        in_doubt |= radii_m > _MAX_UNMEASURED_RAD * self.nearest_m
        return self.contradicts() | ((self.support == 0) & in_doubt)


def hides_view(means: Tensor, camera: Camera, T_map_cameras: Array) -> Tensor:
    """Mask [N] of the points [N, 3] right in front of any camera of a path.

    The path leads through empty space, also between keyframes.

    Args:
        camera: intrinsics of all frames.
        T_map_cameras: [P, 4, 4] poses of the frames.
    """
    points = means.double().cpu().numpy()
    finite = np.flatnonzero(np.isfinite(points).all(axis=1))
    voxels = voxels_of(points[finite], _CLEAR_M)
    steps = np.stack(np.meshgrid(*[(-1, 0, 1)] * 3), axis=-1).reshape(-1, 3)
    around = voxels_of(T_map_cameras[:, :3, 3], _CLEAR_M)[:, None] + steps
    near = finite[np.isin(voxel_keys(voxels), voxel_keys(around.reshape(-1, 3)))]
    hides = np.zeros(len(near), bool)
    for T_camera_map in se3.inverse(T_map_cameras) if len(near) else ():
        of_camera = se3.transform_points(T_camera_map, points[near])
        ahead = (of_camera[:, 2] > 0) & (np.linalg.norm(of_camera, axis=1) < _CLEAR_M)
        uv = camera.project(of_camera[ahead])
        ahead[ahead] = ((uv > -0.5) & (uv < np.array(camera.size) - 0.5)).all(axis=1)
        hides |= ahead
    mask = torch.zeros(len(means), dtype=torch.bool)
    mask[near] = torch.from_numpy(hides)
    return mask.to(means.device)


def evidence_of_all(gaussians: GaussianCloud, keyframes: Iterable[Keyframe]) -> Evidence:
    """Evidence of all keyframes of a map about its N Gaussians."""
    return Evidence.of(gaussians.means, (DepthView.of(keyframe) for keyframe in keyframes))


def contradicted_by_all(
    gaussians: GaussianCloud, evidence: Evidence, camera: Camera, T_map_cameras: Array
) -> Tensor:
    """Mask [N] of the Gaussians in space that keyframes together measured as empty.

    Args:
        evidence: that of all keyframes; it is completed by the frames in place.
        camera: intrinsics of the frames.
        T_map_cameras: [P, 4, 4] poses of frames, in front of which space is empty, too.
    """
    evidence.pass_by(gaussians.means, camera, T_map_cameras)
    mask = evidence.contradicts_in_map(gaussians.radii_m)
    return mask | hides_view(gaussians.means, camera, T_map_cameras)


class FreeSpace:
    """What the keyframes of a map measured as empty, while the map grows."""

    def __init__(self) -> None:
        self._views = DepthViews()

    def contradicted(self, means: Tensor, newest: Keyframe, others: Sequence[Keyframe]) -> Tensor:
        """Mask [N] of the points in empty space, of those the newest keyframe measured through.

        Args:
            means: [N, 3] points.
            others: earlier keyframes of the same map; a few of them are compared.
        """
        through = Evidence.of(means, [self._views.of(newest)]).through
        mask = through > 0
        candidates = mask.nonzero().squeeze(1)
        some = means.index_select(0, candidates)
        evidence = Evidence.of(some, self._some(others), whole_map=False)
        evidence.through.add_(through.index_select(0, candidates))
        return mask.index_copy(0, candidates, evidence.contradicts())

    def seen_through(self, seeds: Tensor, others: Sequence[Keyframe]) -> Tensor:
        """Mask [N] of the points that earlier keyframes contradict; none if they contradict many.

        Args:
            seeds: [N, 3] points that a new keyframe measured.
            others: as in `contradicted`.
        """
        evidence = Evidence.of(seeds, self._some(others), whole_map=False)
        evidence.support.add_(1.0)
        mask = evidence.contradicts()
        # Then the pose of the new keyframe is in doubt, not its depth.
        return mask if mask.sum() <= _MAX_DROPPED * len(mask) else torch.zeros_like(mask)

    def _some(self, keyframes: Sequence[Keyframe]) -> list[DepthView]:
        return [self._views.of(k) for k in evenly_spaced(keyframes, _VIEWS)]
