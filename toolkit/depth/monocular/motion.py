"""Camera motion of a whole sequence, and what is known about its reliability."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from toolkit.base.frame import Frame
from toolkit.base.geometry.camera import Camera
from toolkit.base.geometry.trajectory import Trajectory
from toolkit.depth.depth_priors.multi_view import SweptKeyframe
from toolkit.depth.monocular.loop_closure import LoopClosure, close_loops
from toolkit.depth.monocular.segments import SegmentedOdometry, connected, largest
from toolkit.depth.monocular.visual_odometry.odometry import FIRST_IMAGES, OdometryOptions, State
from toolkit.depth.monocular.visual_odometry.scale_drift import scale_matters, scale_sigma
from toolkit.depth.monocular.visual_odometry.sparse_map import SparseMap
from toolkit.semantics.features.keypoints import Keypoints
from toolkit.splatting.alignment.levels import intensity_of

# Percentiles of a keyframe's landmark depths that count as near and far.
_NEAR_PERCENT, _FAR_PERCENT = 2.0, 98.0
# A keyframe with fewer landmarks has no range of depths.
_MIN_LANDMARKS = 10
# A map with fewer of such keyframes is left out.
_MIN_VIEWS = 3

# Limits of a reliable reconstruction. RMS distance of the camera from its mean position, relative
# to the median depth: replica_office0 0.2, fr1_rpy, which only turns, 0.03.
_MIN_EXTENT = 0.05
_MAX_MISSING = 0.2
# Relative change of scale that image errors of one pixel cause at one place. Recordings with a
# correct scale have 0.003 to 0.015; fr1_rpy 0.03, the HoloLens walk 0.1, where the camera turns.
_MAX_SCALE_SIGMA = 0.02
_SHOWN_FRAMES = 5
# Median reprojection error relative to the width of the image.
_MAX_ERROR = 1.0 / 320.0
_MAX_FOCAL_SIGMA = 0.05
# Revisits that contradict the rest: recordings with a correct scale have at most 8 %, those whose
# scale drifted, and rooms that look alike, 26 to 99 %. A fast walk had 5 of 19, and its scale was
# three times as large at its end.
_MAX_REJECTED, _FEW_REJECTED = 0.15, 3

# The focal length is estimated again until its relative change is smaller.
_SAME_FOCAL = 0.005
FOCAL_ROUNDS = 5

# Why a part of a sequence is apart, and why frames of one are left out.
UNCONNECTED = "no image after the camera was lost shows a place from before"
TOO_SHORT = "the camera was lost again too soon"


@dataclass(frozen=True)
class MetricScale:
    """How a motion was scaled to metres.

    Attributes:
        factor: metres per former unit.
        sigma: relative standard deviation of the length in the images that it follows from.
        source: what that length is.
    """

    factor: float
    sigma: float
    source: str


@dataclass(frozen=True)
class CameraMotion:
    """Estimated motion of a camera, up to scale unless `metric_scale` is known.

    Attributes:
        trajectory: poses of all frames that have one.
        camera: intrinsics; its focal length is estimated if it was not known.
        focal_sigma: relative standard deviation of an estimated focal length; None if it was known.
        views: keyframes whose depth can be estimated.
        frames: number of frames.
        extent: RMS distance of the camera from its mean position relative to the median depth.
        error_px: median reprojection error; nan without keyframes.
        scale_sigma: largest relative change of scale within the sequence that image errors of one
            pixel can cause.
        scale_frames: frames after which it may change, the most uncertain first.
        loops: places that the camera visited again.
        metric_scale: how the motion was scaled to metres; None if its unit is arbitrary.
        without_pose: why frames have no pose: number of frames by reason.
        doubts: reliability checks that failed, one message each.
        others: motions of the same camera whose position and scale relative to this one, the
            longest, are unknown: the camera was lost in between, and no image shows a place of
            both.
    """

    trajectory: Trajectory
    camera: Camera
    views: list[SweptKeyframe]
    frames: int
    extent: float = 0.0
    error_px: float = float("nan")
    scale_sigma: float = float("nan")
    scale_frames: tuple[int, ...] = ()
    loops: LoopClosure = field(default_factory=LoopClosure)
    focal_sigma: float | None = None
    metric_scale: MetricScale | None = None
    without_pose: dict[str, int] = field(default_factory=dict)
    doubts: list[str] = field(default_factory=list)
    others: tuple[CameraMotion, ...] = ()

    @property
    def frames_in_others(self) -> int:
        """Number of frames with a pose in another motion."""
        return sum(len(other.trajectory) for other in self.others)

    @property
    def reliable(self) -> bool:
        """Whether no reliability check failed."""
        return not self.doubts

    def metrics(self) -> dict[str, float | int | str | bool | None]:
        """Group "monocular" of metrics.json."""
        known, metric = bool(self.views), self.metric_scale
        return {
            "reliable": self.reliable,
            "doubts": "; ".join(self.doubts),
            "keyframes": len(self.views),
            "extent": self.extent if known else None,
            "scale_sigma_percent": 100.0 * self.scale_sigma if known else None,
            "scale_frames": " ".join(map(str, self.scale_frames)),
            "metric_scale": None if metric is None else metric.factor,
            "metric_scale_sigma_percent": None if metric is None else 100.0 * metric.sigma,
            "frames_in_other_parts": self.frames_in_others,
            "revisits": self.loops.revisits,
            "revisits_rejected": self.loops.rejected,
            "reprojection_px": self.error_px if known else None,
            "focal_px": self.camera.fx if self.focal_sigma is not None else None,
            "focal_sigma_percent": None
            if self.focal_sigma is None or not np.isfinite(self.focal_sigma)
            else 100.0 * self.focal_sigma,
            "convention": "extent: RMS distance of the camera from its mean position "
            "relative to the median depth; scale sigma: largest relative change of scale that "
            "image errors of one pixel can cause; the unit of length is "
            + ("arbitrary" if metric is None else f"the metre, by {metric.source}"),
        }


class ImageSequence(Protocol):
    """Frames of a sequence; only their images are used."""

    def __iter__(self) -> Iterator[Frame]: ...

    def __getitem__(self, index: int, /) -> Frame: ...


def estimate_motion(
    frames: ImageSequence,
    camera: Camera,
    calibrated: bool = True,
    options: OdometryOptions | None = None,
    focal_sigma: float | None = None,
    progress: Callable[[ImageSequence], Iterable[Frame]] = iter,
) -> CameraMotion:
    """Estimate the motion of the camera from all frames of a sequence.

    Args:
        camera: intrinsics.
        calibrated: whether the focal length is known. Otherwise it is estimated together with the
            motion, repeatedly, because the first motion follows from a wrong one.
        focal_sigma: relative standard deviation of a focal length that is to be estimated, with
            which the estimate is combined; None if it is only a guess.
        progress: iterates over the frames, for instance with a progress bar.
    """
    prior, sigma = camera, None
    for _ in range(1 if calibrated else FOCAL_ROUNDS):
        odometry = _followed(progress(frames), camera, options)
        adjusted = odometry.sparse_map.adjust_all(focal=not calibrated)
        before, estimated = camera, odometry.sparse_map.camera
        camera = estimated
        if focal_sigma is not None and adjusted is not None and not calibrated:
            factor, sigma = combined_focal(
                focal_sigma, estimated.fx / prior.fx, adjusted.focal_sigma
            )
            camera = replace(prior, fx=factor * prior.fx, fy=factor * prior.fy)
        if abs(camera.fx / before.fx - 1.0) < _SAME_FOCAL:
            break
    if abs(estimated.fx / camera.fx - 1.0) >= _SAME_FOCAL:
        # The last map belongs to another focal length than the combined one, which is kept.
        odometry, calibrated = _followed(progress(frames), camera, options), True
    motion = _evaluated(odometry, frames, calibrated)
    if sigma is None or not motion.views:
        return motion
    motion = replace(motion, focal_sigma=sigma)
    return replace(motion, doubts=doubts_about(motion))


def combined_focal(prior_sigma: float, estimated: float, sigma: float) -> tuple[float, float]:
    """Combine a prior focal length with an estimate of it, both with normal logarithms.

    Args:
        prior_sigma: relative standard deviation of the prior focal length, > 0.
        estimated: estimate relative to the prior focal length.
        sigma: relative standard deviation of the estimate; infinite if it is not determined.

    Returns:
        The combination relative to the prior focal length, and its relative standard deviation.
    """
    information = prior_sigma**-2 + sigma**-2
    return float(estimated ** (sigma**-2 / information)), float(information**-0.5)


@dataclass(frozen=True)
class _Followed:
    """The maps of visual odometry, the timestamps of all frames, and why some have no pose."""

    maps: list[SparseMap]
    times_s: list[float]
    reasons: Counter[str]

    @property
    def sparse_map(self) -> SparseMap:
        """The largest map."""
        return largest(self.maps)


def _followed(
    frames: Iterable[Frame], camera: Camera, options: OdometryOptions | None
) -> _Followed:
    odometry = SegmentedOdometry(camera, options)
    times_s: list[float] = []
    reasons: Counter[str] = Counter()
    for frame in frames:
        result = odometry.process(grey_image(frame))
        times_s.append(frame.timestamp_s)
        if result.state is not State.TRACKING and result.reason != FIRST_IMAGES:
            reasons[result.reason] += 1
    return _Followed(odometry.maps, times_s, reasons)


def grey_image(frame: Frame) -> NDArray[np.uint8]:
    """The image of a frame as features are found in it, [H, W]."""
    return np.round(255.0 * intensity_of(frame.rgb).numpy()).clip(0, 255).astype(np.uint8)


def _evaluated(odometry: _Followed, frames: ImageSequence, calibrated: bool) -> CameraMotion:
    """The motion after correction by revisits, with the reliability checks that failed."""
    times_s = odometry.times_s
    detected: dict[int, Keypoints] = {}

    def image(index: int) -> NDArray[np.uint8]:
        return grey_image(frames[index])

    groups = connected(odometry.maps, image, detected)
    maps = [group for group in groups if len(_depth_views(group)[0]) >= _MIN_VIEWS]
    # Frames before the initialisation have a pose afterwards.
    reasons = Counter(odometry.reasons)
    reasons[TOO_SHORT] = sum(map(len, groups[1:])) - sum(map(len, maps[1:]))
    known = sum(map(len, maps or groups[:1]))
    without = dict((+reasons).most_common()) if known < len(times_s) else {}
    if not maps:
        reason = next(iter(without), "there are too few frames")
        doubts = [f"the motion of the camera could not be determined: {reason}"]
        nothing = Trajectory(np.zeros(0), np.zeros((0, 4, 4)))
        return CameraMotion(
            nothing, groups[0].camera, [], len(times_s), without_pose=without, doubts=doubts
        )
    main = _corrected(maps[0], image, detected, times_s, calibrated)
    # The longest part determines the focal length.
    others = [_corrected(m, image, detected, times_s, True) for m in maps[1:]]
    motion = replace(main, without_pose=without, others=tuple(others))
    return replace(motion, doubts=doubts_about(motion))


def _corrected(
    sparse_map: SparseMap,
    image: Callable[[int], NDArray[np.uint8]],
    detected: dict[int, Keypoints],
    times_s: list[float],
    calibrated: bool,
) -> CameraMotion:
    """The motion of a map after correction by revisits, without the doubts about it."""
    known = [n for n in range(len(times_s)) if sparse_map.T_world_camera(n) is not None]
    sparse_map, loops = close_loops(sparse_map, image, detected)
    adjusted = sparse_map.adjust_all(focal=not calibrated)
    assert adjusted is not None, "there are three views"
    poses = [sparse_map.T_world_camera(n) for n in known]
    trajectory = Trajectory(
        np.array([times_s[n] for n in known]), np.array(poses).reshape(-1, 4, 4)
    )
    views, depths = _depth_views(sparse_map)
    centres = trajectory.T_world_camera[:, :3, 3]
    spread = float(np.sqrt(((centres - centres.mean(0)) ** 2).sum(1).mean()))
    sigma = np.where(scale_matters(sparse_map), scale_sigma(sparse_map), 0.0)
    order = np.argsort(-sigma, kind="stable")
    uncertain = order[sigma[order] > _MAX_SCALE_SIGMA]
    return CameraMotion(
        trajectory,
        sparse_map.camera,
        views,
        len(times_s),
        extent=spread / float(np.median(depths)) if depths else 0.0,
        error_px=float(np.median(adjusted.error_px)),
        scale_sigma=float(sigma.max()),
        scale_frames=tuple(sparse_map.views[gap].frame for gap in uncertain),
        loops=loops,
        focal_sigma=None if calibrated else adjusted.focal_sigma,
    )


def _depth_views(sparse_map: SparseMap) -> tuple[list[SweptKeyframe], list[float]]:
    """Views whose depth can be estimated, and their median depths."""
    views, depths = [], []
    for number, view in enumerate(sparse_map.views):
        points = sparse_map.landmarks_of(number)
        swept = swept_keyframe(view.frame, view.T_world_camera, points)
        if swept is not None:
            views.append(swept)
            depths.append(float(np.median(points[:, 2])))
    return views, depths


def swept_keyframe(
    frame: int, T_world_camera: NDArray[np.float64], points: NDArray[np.float64]
) -> SweptKeyframe | None:
    """A view with its known points [N, 3] (pixel and depth) and their range; None with too few."""
    if len(points) < _MIN_LANDMARKS:
        return None
    near, far = np.percentile(points[:, 2], [_NEAR_PERCENT, _FAR_PERCENT])
    return SweptKeyframe(frame, T_world_camera, float(near), float(far), points)


def doubts_about(motion: CameraMotion) -> list[str]:
    """The reliability checks that failed for a motion, one message each."""
    doubts = []
    if motion.extent < _MIN_EXTENT:
        doubts.append(
            f"the camera hardly moved from its place ({100 * motion.extent:.1f} % of the distance "
            "to the scene), so that distances are not determined"
        )
    apart = motion.frames_in_others
    missing = motion.frames - len(motion.trajectory) - apart
    if apart > _MAX_MISSING * motion.frames:
        doubts.append(
            f"{apart} of {motion.frames} frames are in {len(motion.others)} other part(s), whose "
            f"position and scale are unknown ({UNCONNECTED})"
        )
    if missing > _MAX_MISSING * motion.frames:
        reason = next(iter(motion.without_pose), "tracking failed")
        doubts.append(f"{missing} of {motion.frames} frames have no pose ({reason})")
    if motion.scale_frames:
        shown = sorted(motion.scale_frames[:_SHOWN_FRAMES])
        doubts.append(
            f"the scale may have changed after frame {', '.join(map(str, shown))}, where little "
            "connects the images before and after: the camera turned without moving, or too fast"
        )
    rejected, compared = motion.loops.rejected, motion.loops.rejected + motion.loops.revisits
    if rejected > max(_FEW_REJECTED, _MAX_REJECTED * compared):
        doubts.append(
            f"{rejected} of {compared} pairs of images that seem to show the same place contradict "
            "the motion: it has drifted, or places look alike"
        )
    if motion.error_px > _MAX_ERROR * motion.camera.width:
        doubts.append(
            f"the median reprojection error is {motion.error_px:.1f} pixels, as with a wrong focal "
            "length, a wrong distortion or a moving scene"
        )
    if motion.focal_sigma is not None and motion.focal_sigma > _MAX_FOCAL_SIGMA:
        doubts.append("the focal length is ill-conditioned; specify the field of view")
    return doubts
