"""Monocular visual odometry: feature tracks, and bundle adjustment over a window of keyframes."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import Enum

import cv2
import numpy as np
from numpy.typing import NDArray

from toolkit.bundle_adjustment.problem import BundleOptions, BundleResult
from toolkit.bundle_adjustment.solver import adjust
from toolkit.geometry import se3
from toolkit.geometry.camera import Camera
from toolkit.visual_odometry.initialisation import MEDIAN_DEPTH, Refusal, initialise
from toolkit.visual_odometry.landmarks import LandmarkTable, View, bundle, held
from toolkit.visual_odometry.tracks import Features, FeatureTracks
from toolkit.visual_odometry.two_view import parallax_rad, rays, triangulate

Array = NDArray[np.float64]


@dataclass(frozen=True)
class OdometryOptions:
    """Visual odometry.

    Attributes:
        features: features per image.
        window: keyframes whose poses bundle adjustment changes.
        overlap: older keyframes whose image points count with their poses held.
        parallax_rad: median parallax to the last keyframe at which a new one is created.
        min_tracked: fraction of the last keyframe's landmarks below which a new one is created.
    """

    features: int = 800
    window: int = 8
    overlap: int = 4
    parallax_rad: float = np.radians(2.0)
    min_tracked: float = 0.6


# Why the first images have no pose yet.
FIRST_IMAGES = "the first images"


class State(Enum):
    """What odometry knows about the newest frame."""

    INITIALISING = "initialising"
    TRACKING = "tracking"
    LOST = "lost"


@dataclass(frozen=True)
class OdometryResult:
    """The newest frame.

    Attributes:
        state: whether its pose is known.
        T_world_camera: [4, 4], or None.
        keyframe: whether it became a keyframe.
        reason: why its pose is not known.
    """

    state: State
    T_world_camera: Array | None = None
    keyframe: bool = False
    reason: str = ""


_MIN_TRACKED = 15
_MAX_ERROR_PX = 3.0
# Fractions of the features that must fit: below the first, the frame is lost, and below the second,
# other initial poses are tried.
_MIN_FITTING = 0.4
_MOSTLY_FITTING = 0.7
_MIN_PARALLAX_RAD = np.radians(0.5)
# Fraction of a frame's landmarks below which those with a measured depth are few.
_WEAK = 0.4
# Frames that wait for parallax; the first one moves on where its features get lost.
_MIN_FIRST = 60


class VisualOdometry:
    """Estimates the motion of a camera from its images.

    Args:
        camera: intrinsics of all images.
        options: defaults if absent.

    Attributes:
        views: the keyframes.
        table: landmarks of all features.
        weakest: smallest number of measured landmarks that connect a frame with the views where
            most landmarks are assumed, and that frame; None where that never happened.
    """

    def __init__(self, camera: Camera, options: OdometryOptions | None = None) -> None:
        self.camera, self.options = camera, options or OdometryOptions()
        self.views: list[View] = []
        self.table = LandmarkTable()
        self.weakest: tuple[int, int] | None = None
        self._tracks = FeatureTracks(self.options.features)
        self._waiting: list[tuple[int, Features]] = []
        self._frame = -1
        self._poses: dict[int, tuple[int, Array]] = {}  # by frame: view and T_view_camera
        self._last: list[Array] = []  # the last two poses
        self._assumed = 1.0 / MEDIAN_DEPTH
        self._image = self._view_image = np.zeros((camera.height, camera.width), np.uint8)

    def process(self, image: NDArray[np.uint8]) -> OdometryResult:
        """Estimate the pose of the next image [H, W]."""
        self._frame += 1
        self._image = image
        self._tracks.follow(image)
        if not self.views:
            return self._initialise()
        return self._track()

    def T_world_camera(self, frame: int) -> Array | None:
        """Present estimate of a frame's pose; None if it was not estimated."""
        if frame not in self._poses:
            return None
        view, T_view_camera = self._poses[frame]
        return self.views[view].T_world_camera @ T_view_camera

    def _initialise(self) -> OdometryResult:
        features = self._tracks.features
        if not self._waiting:
            features = self._tracks.replenish()
        if len(features) < _MIN_FIRST:
            reason = "features were lost" if self._waiting else "there are too few features"
            self._restart()
            return OdometryResult(State.INITIALISING, reason=reason)
        self._waiting.append((self._frame, features))
        if len(self._waiting) < 3:
            return OdometryResult(State.INITIALISING, reason=FIRST_IMAGES)
        found = initialise(self.camera, self._waiting)
        if isinstance(found, Refusal):
            return OdometryResult(State.INITIALISING, reason=found.reason)
        self.views, self.table = found.views, found.table
        by_frame = {view.frame: n for n, view in enumerate(self.views)}
        for frame, waiting in self._waiting:
            if frame in by_frame:
                self._poses[frame] = by_frame[frame], np.eye(4)
                continue
            view = int(np.searchsorted([v.frame for v in self.views], frame)) - 1
            T = self._located(waiting, self.views[view].T_world_camera)[0]
            self._poses[frame] = view, se3.inverse(self.views[view].T_world_camera) @ T
        T = self.views[-1].T_world_camera
        self._last = [T, T]
        self._replenish()
        return OdometryResult(State.TRACKING, T, True)

    def _restart(self) -> None:
        """Start again at the next frame."""
        self._tracks = FeatureTracks(self.options.features)
        self._waiting = []

    def _located(self, features: Features, T_start: Array) -> tuple[Array, NDArray[np.bool_]]:
        """Pose of a frame, and which of its features fit."""
        views = [*self.views, View(-1, T_start, features)]
        newest = [len(views) - 1]
        problem, landmarks, _ = bundle(self.camera, self.table, views, newest, newest)
        result = adjust(held(problem), BundleOptions(iterations=20))
        fits = np.isin(features.ids, landmarks[result.error_px < _MAX_ERROR_PX])
        return result.T_world_camera[-1], fits

    def _track(self) -> OdometryResult:
        features = self._tracks.features
        if len(features) < _MIN_TRACKED:
            return self._lost("too few features are followed")
        T, fits = self._best(features)
        if fits.sum() < max(_MIN_TRACKED, _MIN_FITTING * len(features)):
            return self._lost("features do not fit the map")
        # A feature that does not fit follows something that moves, or an edge.
        self._tracks.keep(fits)
        measured = int(self.table.measured[self._tracks.features.ids].sum())
        weak = measured < _WEAK * len(self._tracks.features)
        if weak and (self.weakest is None or measured < self.weakest[0]):
            self.weakest = measured, self._frame
        self._last = [self._last[-1], T]
        view = len(self.views) - 1
        if not self._wants_keyframe(T):
            self._poses[self._frame] = view, se3.inverse(self.views[view].T_world_camera) @ T
            return OdometryResult(State.TRACKING, T)
        self.views.append(View(self._frame, T, self._tracks.features))
        self._poses[self._frame] = view + 1, np.eye(4)
        self._triangulate()
        self._adjust()
        self._replenish()
        T = self.views[-1].T_world_camera
        self._last[-1] = T
        return OdometryResult(State.TRACKING, T, True)

    def _lost(self, reason: str) -> OdometryResult:
        """Let the next frame be compared with the last view, which it may show again."""
        last = self.views[-1]
        self._tracks.continue_from(self._view_image, last.features)
        self._last = [last.T_world_camera, last.T_world_camera]
        return OdometryResult(State.LOST, reason=reason)

    def _best(self, features: Features) -> tuple[Array, NDArray[np.bool_]]:
        """Pose from constant velocity or, if few features fit then, from random samples."""
        before, last = self._last
        T, fits = self._located(features, last @ se3.inverse(before) @ last)
        if fits.sum() > _MOSTLY_FITTING * len(features):
            return T, fits
        ok, rotation, translation, _ = cv2.solvePnPRansac(
            self._points(features.ids),
            features.px,
            self.camera.matrix,
            None,
            reprojectionError=_MAX_ERROR_PX,
        )
        if not ok:
            return T, fits
        R, _ = cv2.Rodrigues(rotation)
        start = se3.inverse(se3.from_rotation_translation(R, translation.ravel()))
        other = self._located(features, start)
        return other if other[1].sum() > fits.sum() else (T, fits)

    def _wants_keyframe(self, T_world_camera: Array) -> bool:
        last, features = self.views[-1], self._tracks.features
        before = last.features
        _, at, now = np.intersect1d(before.ids, features.ids, return_indices=True)
        if len(at) < self.options.min_tracked * len(before):
            return True
        R = (se3.inverse(T_world_camera) @ last.T_world_camera)[:3, :3]
        parallax = parallax_rad(self.camera, R, before.px[at], features.px[now])
        return bool(np.median(parallax) > self.options.parallax_rad)

    def _triangulate(self) -> None:
        """Initialise the inverse depths of features that the newest view shows with parallax."""
        view = self.views[-1]
        new = view.features.select(~self.table.measured[view.features.ids])
        if not len(new):
            return
        anchors = np.array([self.views[a].T_world_camera for a in self.table.anchor[new.ids]])
        T = se3.inverse(view.T_world_camera) @ anchors
        first = self.table.px[new.ids]
        q = triangulate(self.camera, T, first, new.px)
        parallax = parallax_rad(self.camera, T[:, :3, :3], first, new.px)
        good = (q > 0) & (parallax > _MIN_PARALLAX_RAD)
        self.table.inverse_depth[new.ids[good]] = q[good]
        self.table.measured[new.ids[good]] = True

    def _adjust(self) -> None:
        """Bundle adjustment over the window of the newest view; removes what does not fit."""
        count = len(self.views)
        free = range(max(count - self.options.window, 2), count)
        window = range(max(count - self.options.window - self.options.overlap, 0), count)
        problem, landmarks, poses = bundle(self.camera, self.table, self.views, window, free)
        result = adjust(problem, BundleOptions(iterations=10))
        for n, T in zip(poses, result.T_world_camera, strict=True):
            self.views[n].T_world_camera = T
        self.table.inverse_depth[landmarks] = result.inverse_depth
        bad = result.error_px > _MAX_ERROR_PX
        if not bad.any():
            return
        ids = landmarks[problem.observations.landmark[bad]]
        at = poses[problem.observations.pose[bad]]
        for n in np.unique(at):
            view = self.views[n]
            view.features = view.features.select(~np.isin(view.features.ids, ids[at == n]))

    def landmark_depths(self, number: int) -> Array:
        """Depths [N] > 0 of the landmarks that a view shows."""
        view = self.views[number]
        ids = view.features.ids[self.table.measured[view.features.ids]]
        z = se3.transform_points(se3.inverse(view.T_world_camera), self._points(ids))[:, 2]
        return np.asarray(z[z > 0])

    def _points(self, ids: NDArray[np.int64]) -> Array:
        """Positions [N, 3] of landmarks in the world."""
        anchors = [self.views[a].T_world_camera for a in self.table.anchor[ids]]
        T = np.array(anchors).reshape(-1, 4, 4)
        local = rays(self.camera, self.table.px[ids]) / self.table.inverse_depth[ids, None]
        return np.asarray(np.einsum("nij,nj->ni", T[:, :3, :3], local) + T[:, :3, 3])

    def adjust_all(self, focal: bool = False) -> BundleResult | None:
        """Bundle adjustment over all views, of which the first is held; None without views.

        Args:
            focal: estimate the focal length as well; `camera` does not change.
        """
        if len(self.views) < 3:
            return None
        everything = range(len(self.views))
        problem, landmarks, poses = bundle(
            self.camera, self.table, self.views, everything, everything[1:]
        )
        # The focal length changes slowly together with all poses.
        options = BundleOptions(iterations=200, min_decrease=1e-7) if focal else BundleOptions()
        result = adjust(problem, replace(options, focal=focal))
        for n, T in zip(poses, result.T_world_camera, strict=True):
            self.views[n].T_world_camera = T
        self.table.inverse_depth[landmarks] = result.inverse_depth
        return result

    def _replenish(self) -> None:
        """Find new features in the newest view."""
        features = self._tracks.replenish()
        self.views[-1].features, self._view_image = features, self._image
        self.table.add(len(self.views) - 1, features)
        # Until there is parallax, new landmarks hold the direction of the camera and, at the depth
        # of the scene around, roughly its position.
        measured = self.table.measured[features.ids]
        if measured.any():
            self._assumed = 1.0 / float(np.median(self.landmark_depths(len(self.views) - 1)))
        self.table.assume(features.ids, self._assumed)
