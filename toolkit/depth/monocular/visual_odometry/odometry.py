"""Monocular visual odometry: feature tracks, and bundle adjustment over a window of keyframes."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from toolkit.base.geometry import se3
from toolkit.base.geometry.camera import Camera
from toolkit.depth.monocular.bundle_adjustment.problem import BundleOptions
from toolkit.depth.monocular.bundle_adjustment.solver import adjust
from toolkit.depth.monocular.visual_odometry.initialisation import MEDIAN_DEPTH, Refusal, initialise
from toolkit.depth.monocular.visual_odometry.landmarks import OdometryView, bundle, held
from toolkit.depth.monocular.visual_odometry.reversal import without_reversal
from toolkit.depth.monocular.visual_odometry.sparse_map import MAX_ERROR_PX, SparseMap
from toolkit.depth.monocular.visual_odometry.two_view import parallax_rad, triangulate
from toolkit.semantics.features.tracks import Features, FeatureTracks

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
# Fractions of the features that must fit: below the first, the frame is lost, and below the second,
# other initial poses are tried.
_MIN_FITTING = 0.4
_MOSTLY_FITTING = 0.7
# Measured landmarks around a new one from which its depth is assumed.
_NEIGHBOURS = 5
_MIN_PARALLAX_RAD = np.radians(0.5)
# Frames that wait for parallax; the first one moves on where its features get lost.
_MIN_FIRST = 60


class VisualOdometry:
    """Estimates the motion of a camera from its images.

    Args:
        camera: intrinsics of all images.
        options: defaults if absent.
        first_frame: number of the first image.

    Attributes:
        map: keyframes, landmarks and the poses of all frames.
    """

    def __init__(
        self, camera: Camera, options: OdometryOptions | None = None, first_frame: int = 0
    ) -> None:
        self.camera, self.options = camera, options or OdometryOptions()
        self.map = SparseMap(camera)
        self._tracks = FeatureTracks(self.options.features)
        self._waiting: list[tuple[int, Features]] = []
        self._frame = first_frame - 1
        self._last: list[Array] = []  # the last two poses
        self._assumed = 1.0 / MEDIAN_DEPTH
        self._image = self._view_image = np.zeros((camera.height, camera.width), np.uint8)

    def process(self, image: NDArray[np.uint8]) -> OdometryResult:
        """Estimate the pose of the next image [H, W]."""
        self._frame += 1
        self._image = image
        self._tracks.follow(image)
        if not self.map.views:
            return self._initialise()
        return self._track()

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
        self.map.views, self.map.table = found.views, found.table
        by_frame = {view.frame: n for n, view in enumerate(self.map.views)}
        for frame, waiting in self._waiting:
            if frame in by_frame:
                view = by_frame[frame]
                self.map.attach(frame, view, self.map.views[view].T_world_camera)
                continue
            view = int(np.searchsorted([v.frame for v in self.map.views], frame)) - 1
            T = self._located(waiting, self.map.views[view].T_world_camera)[0]
            self.map.attach(frame, view, T)
        T = self.map.views[-1].T_world_camera
        self._last = [T, T]
        self._replenish()
        return OdometryResult(State.TRACKING, T, True)

    def _restart(self) -> None:
        """Start again at the next frame."""
        self._tracks = FeatureTracks(self.options.features)
        self._waiting = []

    def _located(self, features: Features, T_start: Array) -> tuple[Array, NDArray[np.bool_]]:
        """Pose of a frame, and which of its features fit."""
        views = [*self.map.views, OdometryView(-1, T_start, features)]
        newest = [len(views) - 1]
        problem, landmarks, _ = bundle(self.camera, self.map.table, views, newest, newest)
        result = adjust(held(problem), BundleOptions(iterations=20))
        fits = np.isin(features.ids, landmarks[result.error_px < MAX_ERROR_PX])
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
        self._last = [self._last[-1], T]
        if not self._wants_keyframe(T):
            self.map.attach(self._frame, len(self.map.views) - 1, T)
            return OdometryResult(State.TRACKING, T)
        self.map.views.append(OdometryView(self._frame, T, self._tracks.features))
        self.map.attach(self._frame, len(self.map.views) - 1, T)
        self._triangulate()
        self._adjust()
        self._replenish()
        T = self.map.views[-1].T_world_camera
        self._last[-1] = T
        return OdometryResult(State.TRACKING, T, True)

    def _lost(self, reason: str) -> OdometryResult:
        """Let the next frame be compared with the last view, which it may show again."""
        last = self.map.views[-1]
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
            self.map.points(features.ids),
            features.px,
            self.camera.matrix,
            None,
            reprojectionError=MAX_ERROR_PX,
        )
        if not ok:
            return T, fits
        R, _ = cv2.Rodrigues(rotation)
        start = se3.inverse(se3.from_rotation_translation(R, translation.ravel()))
        other = self._located(features, start)
        return other if other[1].sum() > fits.sum() else (T, fits)

    def _wants_keyframe(self, T_world_camera: Array) -> bool:
        last, features = self.map.views[-1], self._tracks.features
        before = last.features
        _, at, now = np.intersect1d(before.ids, features.ids, return_indices=True)
        if len(at) < self.options.min_tracked * len(before):
            return True
        R = (se3.inverse(T_world_camera) @ last.T_world_camera)[:3, :3]
        parallax = parallax_rad(self.camera, R, before.px[at], features.px[now])
        return bool(np.median(parallax) > self.options.parallax_rad)

    def _triangulate(self) -> None:
        """Initialise the inverse depths of features that the newest view shows with parallax."""
        view = self.map.views[-1]
        new = view.features.select(~self.map.table.measured[view.features.ids])
        if not len(new):
            return
        anchors = np.array(
            [self.map.views[a].T_world_camera for a in self.map.table.anchor[new.ids]]
        )
        T = se3.inverse(view.T_world_camera) @ anchors
        first = self.map.table.px[new.ids]
        q = triangulate(self.camera, T, first, new.px)
        parallax = parallax_rad(self.camera, T[:, :3, :3], first, new.px)
        good = (q > 0) & (parallax > _MIN_PARALLAX_RAD)
        self.map.table.inverse_depth[new.ids[good]] = q[good]
        self.map.table.measured[new.ids[good]] = True

    def _adjust(self) -> None:
        """Bundle adjustment over the window of the newest view; removes what does not fit."""
        count = len(self.map.views)
        free = range(max(count - self.options.window, 2), count)
        window = range(max(count - self.options.window - self.options.overlap, 0), count)
        self.map.adjust(window, free, BundleOptions(iterations=10), clean=True)
        upright = without_reversal(self.map, window, free)
        if upright is not self.map:
            self.map = upright
            self.map.adjust(window, free, BundleOptions(iterations=10), clean=True)
            # The velocity was reversed, too.
            self._last = [self.map.views[-1].T_world_camera] * 2

    def _replenish(self) -> None:
        """Find new features in the newest view."""
        features = self._tracks.replenish()
        self.map.views[-1].features, self._view_image = features, self._image
        self.map.table.add(len(self.map.views) - 1, features)
        # Until there is parallax, new landmarks hold the direction of the camera and, at the depth
        # of the landmarks around them, roughly its position.
        self.map.table.assume(features.ids, self._expected(features))

    def _expected(self, features: Features) -> Array:
        """Inverse depths [N] of features in the newest view from those of the measured ones."""
        ids = features.ids[self.map.table.measured[features.ids]]
        if len(ids):
            T = se3.inverse(self.map.views[-1].T_world_camera)
            depth = se3.transform_points(T, self.map.points(ids))[:, 2]
            ahead = depth > 0
            if ahead.any():
                self._assumed = 1.0 / float(np.median(depth[ahead]))
            if ahead.sum() >= _NEIGHBOURS:
                px = features.px[np.isin(features.ids, ids[ahead])]
                _, near = cKDTree(px).query(features.px, _NEIGHBOURS)
                return np.asarray(np.median(1.0 / depth[ahead][near], axis=1))
        return np.full(len(features), self._assumed)
