"""Keyframes and landmarks of a monocular sequence, and the frames between the keyframes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from toolkit.base.geometry import se3
from toolkit.base.geometry.camera import Camera
from toolkit.depth.monocular.bundle_adjustment.problem import BundleOptions, BundleResult
from toolkit.depth.monocular.bundle_adjustment.solver import adjust
from toolkit.depth.monocular.visual_odometry.landmarks import LandmarkTable, OdometryView, bundle
from toolkit.depth.monocular.visual_odometry.two_view import rays
from toolkit.semantics.features.tracks import Features

Array = NDArray[np.float64]

# Observations with a larger reprojection error are outliers.
MAX_ERROR_PX = 3.0


@dataclass(frozen=True)
class PointTracks:
    """Points of the scene that several views show.

    Attributes:
        anchor: [L] view with which each point's inverse depth is stored.
        px: [L, 2] pixel there.
        inverse_depth: [L] > 0.
        point: [O] index of the point of each observation. view: [O]. observed_px: [O, 2]. The
            anchor's observation is among them.
    """

    anchor: NDArray[np.int32]
    px: Array
    inverse_depth: Array
    point: NDArray[np.int64]
    view: NDArray[np.int64]
    observed_px: Array


class SparseMap:
    """What visual odometry has found out.

    Attributes:
        camera: intrinsics of all images.
        views: the keyframes.
        table: landmarks of all features.
    """

    def __init__(self, camera: Camera) -> None:
        self.camera = camera
        self.views: list[OdometryView] = []
        self.table = LandmarkTable()
        self._poses: dict[int, tuple[int, Array]] = {}  # by frame: view and T_view_camera
        # By view: T_view_next when the next one was created, to which frames between them belong.
        self._steps: dict[int, Array] = {}

    def __len__(self) -> int:
        """Number of frames with a pose."""
        return len(self._poses)

    def attach(self, frame: int, view: int, T_world_camera: Array) -> None:
        """Store a frame's pose; it moves with a view, and with the next one, from now on."""
        T_view_world = se3.inverse(self.views[view].T_world_camera)
        self._poses[frame] = view, T_view_world @ T_world_camera
        if view > 0 and self.views[view].frame == frame:
            T_last_world = se3.inverse(self.views[view - 1].T_world_camera)
            self._steps[view - 1] = T_last_world @ T_world_camera

    def T_world_camera(self, frame: int) -> Array | None:
        """Present estimate of a frame's pose; None if it was not estimated."""
        if frame not in self._poses:
            return None
        number, T_view_camera = self._poses[frame]
        view = self.views[number]
        if number not in self._steps:
            return view.T_world_camera @ T_view_camera
        # What has changed the step to the next view has changed the way there, too.
        following = self.views[number + 1]
        T_view_next = se3.inverse(view.T_world_camera) @ following.T_world_camera
        change = se3.log(se3.inverse(self._steps[number]) @ T_view_next)
        share = (frame - view.frame) / (following.frame - view.frame)
        return view.T_world_camera @ T_view_camera @ se3.exp(share * change)

    def landmarks_of(self, number: int) -> Array:
        """Column and row in pixels, and depth > 0 [N, 3], of the landmarks that a view shows."""
        view = self.views[number]
        measured = self.table.measured[view.features.ids]
        points = self.points(view.features.ids[measured])
        z = se3.transform_points(se3.inverse(view.T_world_camera), points)[:, 2]
        return np.column_stack([view.features.px[measured], z])[z > 0]

    def points(self, ids: NDArray[np.int64]) -> Array:
        """Positions [N, 3] of landmarks in the world."""
        anchors = [self.views[a].T_world_camera for a in self.table.anchor[ids]]
        T = np.array(anchors).reshape(-1, 4, 4)
        local = rays(self.camera, self.table.px[ids]) / self.table.inverse_depth[ids, None]
        return np.asarray(np.einsum("nij,nj->ni", T[:, :3, :3], local) + T[:, :3, 3])

    def adjust(
        self, window: Sequence[int], free: Sequence[int], options: BundleOptions, clean: bool
    ) -> BundleResult:
        """Bundle adjustment.

        Args:
            window: numbers of the views whose image points count.
            free: numbers of those whose poses change.
            clean: whether image points that do not fit afterwards are removed.
        """
        problem, landmarks, poses = bundle(self.camera, self.table, self.views, window, free)
        result = adjust(problem, options)
        for n, T in zip(poses, result.T_world_camera, strict=True):
            self.views[n].T_world_camera = T
        self.table.inverse_depth[landmarks] = result.inverse_depth
        if options.focal:
            fx, fy = (result.focal_factor * f for f in (self.camera.fx, self.camera.fy))
            self.camera = replace(self.camera, fx=fx, fy=fy)
        bad = result.error_px > MAX_ERROR_PX
        if clean and bad.any():
            ids = landmarks[problem.observations.landmark[bad]]
            at = poses[problem.observations.pose[bad]]
            for n in np.unique(at):
                view = self.views[n]
                view.features = view.features.select(~np.isin(view.features.ids, ids[at == n]))
        return result

    def adjust_all(self, focal: bool = False, clean: bool = False) -> BundleResult | None:
        """Bundle adjustment over all views, of which the first is held; None if they are too few.

        Args:
            focal: estimate the focal length as well, which changes `camera`.
            clean: whether image points that do not fit afterwards are removed.
        """
        if len(self.views) < 3:
            return None
        everything = range(len(self.views))
        # The focal length changes slowly together with all poses.
        options = BundleOptions(iterations=200, min_decrease=1e-7) if focal else BundleOptions()
        return self.adjust(everything, everything[1:], replace(options, focal=focal), clean)

    def transform(self, T_world_view: Sequence[Array], scale: Array) -> None:
        """Give each view [V] another pose, and what belongs to it another scale (a similarity)."""
        for view, T in zip(self.views, T_world_view, strict=True):
            view.T_world_camera = T
        known = self.table.inverse_depth > 0
        self.table.inverse_depth[known] /= scale[self.table.anchor[known]]
        for frame, (number, T_view_camera) in self._poses.items():
            self._poses[frame] = number, _scaled(T_view_camera, scale[number])
        for number, T_view_next in self._steps.items():
            self._steps[number] = _scaled(T_view_next, scale[number])

    def add(self, tracks: PointTracks) -> None:
        """Add measured landmarks and the image points that show them."""
        ids = self.table.append(tracks.anchor, tracks.px, tracks.inverse_depth)
        order = np.argsort(tracks.view, kind="stable")
        ends = np.searchsorted(tracks.view[order], np.arange(1, len(self.views) + 1))
        for view, rows in zip(self.views, np.split(order, ends)[:-1], strict=True):
            before = view.features
            view.features = Features(
                np.concatenate([before.ids, ids[tracks.point[rows]]]),
                np.concatenate([before.px, tracks.observed_px[rows]]),
            )

    @classmethod
    def joined(cls, maps: Sequence[SparseMap], camera: Camera) -> SparseMap:
        """One map of several parts of a sequence in order, which have the same world frame."""
        joined = cls(camera)
        for part in maps:
            first, ids = len(joined.views), len(joined.table.anchor)
            joined.views += [
                replace(view, features=Features(view.features.ids + ids, view.features.px))
                for view in part.views
            ]
            joined.table.extend(part.table, first)
            for frame, (view, T_view_camera) in part._poses.items():
                joined._poses[frame] = view + first, T_view_camera
            joined._steps |= {view + first: T for view, T in part._steps.items()}
        return joined

    def copy(self) -> SparseMap:
        """An independent copy."""
        other = SparseMap(self.camera)
        other.views = [replace(view) for view in self.views]
        other.table = self.table.copy()
        other._poses, other._steps = dict(self._poses), dict(self._steps)
        return other


def _scaled(T: Array, scale: float) -> Array:
    """A pose with a longer or shorter translation."""
    scaled = T.copy()
    scaled[:3, 3] *= scale
    return scaled
