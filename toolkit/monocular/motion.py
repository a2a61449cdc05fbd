"""Camera motion of a whole sequence, and what is known about its reliability."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace

import numpy as np

from toolkit.alignment.levels import intensity_of
from toolkit.depth_priors.multi_view import DepthView
from toolkit.frame import Frame
from toolkit.geometry.camera import Camera
from toolkit.geometry.trajectory import Trajectory
from toolkit.visual_odometry.odometry import FIRST_IMAGES, OdometryOptions, State, VisualOdometry

# Percentiles of a keyframe's landmark depths that count as near and far.
_NEAR_PERCENT, _FAR_PERCENT = 2.0, 98.0
# A keyframe with fewer landmarks has no range of depths.
_MIN_LANDMARKS = 10

# Limits of a reliable reconstruction. RMS distance of the camera from its mean position, relative
# to the median depth: replica_office0 0.2, fr1_rpy, which only turns, 0.03.
_MIN_EXTENT = 0.05
_MAX_MISSING = 0.2
# The HoloLens walk, whose scale changes where the camera turns, has 2 or 3; fr1_rpy 21 to 58.
_MIN_CONNECTED = 75
# Median reprojection error relative to the width of the image.
_MAX_ERROR = 1.0 / 320.0
_MAX_FOCAL_SIGMA = 0.05

# The focal length is estimated again until its relative change is smaller.
_SAME_FOCAL = 0.005
_FOCAL_ROUNDS = 5


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
    """Estimated motion of a camera, up to scale unless `scale` is known.

    Attributes:
        trajectory: poses of all frames that have one.
        camera: intrinsics; its focal length is estimated if it was not known.
        focal_sigma: relative standard deviation of an estimated focal length; None if it was known.
        views: keyframes whose depth can be estimated.
        frames: number of frames.
        extent: RMS distance of the camera from its mean position relative to the median depth.
        error_px: median reprojection error; nan without keyframes.
        weakest: smallest number of points with a measured depth that connect a frame with the
            keyframes before where most points have none, and the frame's number; None if that
            never happened.
        scale: how the motion was scaled to metres; None if its unit is arbitrary.
        without_pose: why frames have no pose: number of frames by reason.
        doubts: why the result is not reliable; empty if it is.
    """

    trajectory: Trajectory
    camera: Camera
    views: list[DepthView]
    frames: int
    extent: float = 0.0
    error_px: float = float("nan")
    weakest: tuple[int, int] | None = None
    focal_sigma: float | None = None
    scale: MetricScale | None = None
    without_pose: dict[str, int] = field(default_factory=dict)
    doubts: list[str] = field(default_factory=list)

    @property
    def reliable(self) -> bool:
        """Whether nothing speaks against the result."""
        return not self.doubts

    def metrics(self) -> dict[str, float | int | str | bool | None]:
        """Entries of metrics.json."""
        known = bool(self.views)
        return {
            "monocular_reliable": self.reliable,
            "monocular_doubts": "; ".join(self.doubts),
            "monocular_keyframes": len(self.views),
            "monocular_extent": self.extent if known else None,
            "monocular_weakest_connection": None if self.weakest is None else self.weakest[0],
            "monocular_reprojection_px": self.error_px if known else None,
            "monocular_focal_px": self.camera.fx if self.focal_sigma is not None else None,
            "monocular_focal_sigma_percent": None
            if self.focal_sigma is None or not np.isfinite(self.focal_sigma)
            else 100.0 * self.focal_sigma,
            "monocular_metric_scale": None if self.scale is None else self.scale.factor,
            "monocular_scale_sigma_percent": None
            if self.scale is None
            else 100.0 * self.scale.sigma,
            "monocular_convention": "extent: RMS distance of the camera from its mean position "
            "relative to the median depth; the unit of length is "
            + ("arbitrary" if self.scale is None else f"the metre, by {self.scale.source}"),
        }


def estimate_motion(
    frames: Callable[[], Iterable[Frame]],
    camera: Camera,
    calibrated: bool = True,
    options: OdometryOptions | None = None,
    focal_sigma: float | None = None,
) -> CameraMotion:
    """Estimate the motion of the camera from all frames of a sequence.

    Args:
        frames: returns the frames in order, from the first one at every call; only their images
            are used.
        camera: intrinsics.
        calibrated: whether the focal length is known. Otherwise it is estimated together with the
            motion, repeatedly, because the first motion follows from a wrong one.
        focal_sigma: relative standard deviation of a focal length that is to be estimated, with
            which the estimate is combined; None if it is only a guess.
    """
    if calibrated:
        return _estimate(frames(), camera, False, options)[0]
    stated = camera
    for _ in range(_FOCAL_ROUNDS):
        motion, factor = _estimate(frames(), camera, True, options)
        if motion.focal_sigma is None:
            return motion
        change, sigma = factor, motion.focal_sigma
        if focal_sigma is not None:
            before = camera.fx / stated.fx
            relative, sigma = combined_focal(focal_sigma, factor * before, sigma)
            change = relative / before
        if abs(change - 1.0) < _SAME_FOCAL:
            break
        camera = replace(camera, fx=change * camera.fx, fy=change * camera.fy)
    if abs(factor / change - 1.0) >= _SAME_FOCAL:
        # The last poses belong to another focal length than the combined one.
        motion, _ = _estimate(frames(), camera, False, options)
    if not motion.views:
        return motion
    motion = replace(motion, focal_sigma=sigma)
    return replace(motion, doubts=_doubts(motion))


def combined_focal(stated_sigma: float, estimated: float, sigma: float) -> tuple[float, float]:
    """Combine a stated focal length with an estimate of it, both with normal logarithms.

    Args:
        stated_sigma: relative standard deviation of the stated focal length, > 0.
        estimated: estimate relative to the stated focal length.
        sigma: relative standard deviation of the estimate; infinite if it is not determined.

    Returns:
        The combination relative to the stated focal length, and its relative standard deviation.
    """
    information = stated_sigma**-2 + sigma**-2
    return float(estimated ** (sigma**-2 / information)), float(information**-0.5)


def _estimate(
    frames: Iterable[Frame], camera: Camera, focal: bool, options: OdometryOptions | None
) -> tuple[CameraMotion, float]:
    """Estimate the motion, and a factor by which the focal length should be multiplied."""
    odometry = VisualOdometry(camera, options)
    reasons: Counter[str] = Counter()
    times: list[float] = []
    for frame in frames:
        image = np.round(255.0 * intensity_of(frame.rgb).numpy()).clip(0, 255).astype(np.uint8)
        result = odometry.process(image)
        times.append(frame.timestamp_s)
        if result.state is not State.TRACKING and result.reason != FIRST_IMAGES:
            reasons[result.reason] += 1
    adjusted = odometry.adjust_all(focal)
    poses = [odometry.T_world_camera(n) for n in range(len(times))]
    known = [n for n, pose in enumerate(poses) if pose is not None]
    trajectory = Trajectory(
        np.array([times[n] for n in known]),
        np.array([poses[n] for n in known]).reshape(-1, 4, 4),
    )
    views, depths = [], []
    for number, view in enumerate(odometry.views):
        depth = odometry.landmark_depths(number)
        if len(depth) < _MIN_LANDMARKS:
            continue
        near, far = np.percentile(depth, [_NEAR_PERCENT, _FAR_PERCENT])
        views.append(DepthView(view.frame, view.T_world_camera, float(near), float(far)))
        depths.append(float(np.median(depth)))
    # Frames before the initialisation have a pose afterwards.
    without = dict(reasons.most_common()) if len(known) < len(times) else {}
    if len(views) < 2 or adjusted is None:
        reason = reasons.most_common(1)[0][0] if reasons else "there are too few frames"
        doubts = [f"the motion of the camera could not be determined: {reason}"]
        empty = Trajectory(np.zeros(0), np.zeros((0, 4, 4)))
        return CameraMotion(empty, camera, [], len(times), without_pose=without, doubts=doubts), 1.0
    centres = trajectory.T_world_camera[:, :3, 3]
    spread = float(np.sqrt(((centres - centres.mean(0)) ** 2).sum(1).mean()))
    motion = CameraMotion(
        trajectory,
        camera,
        views,
        len(times),
        extent=spread / float(np.median(depths)),
        error_px=float(np.median(adjusted.error_px)),
        weakest=odometry.weakest,
        focal_sigma=adjusted.focal_sigma if focal else None,
        without_pose=without,
    )
    return replace(motion, doubts=_doubts(motion)), adjusted.focal_factor


def _doubts(motion: CameraMotion) -> list[str]:
    """What speaks against a motion."""
    doubts = []
    if motion.extent < _MIN_EXTENT:
        doubts.append(
            f"the camera hardly moved from its place ({100 * motion.extent:.1f} % of the distance "
            "to the scene), so that distances are not determined"
        )
    missing = motion.frames - len(motion.trajectory)
    if missing > _MAX_MISSING * motion.frames:
        reason = next(iter(motion.without_pose), "tracking failed")
        doubts.append(f"{missing} of {motion.frames} frames have no pose ({reason})")
    if motion.weakest is not None and motion.weakest[0] < _MIN_CONNECTED:
        count, frame = motion.weakest
        doubts.append(
            f"only {count} points of known distance connect frame {frame} with those before, so "
            "that the scale may have changed there: the camera turned without moving, or too fast"
        )
    if motion.error_px > _MAX_ERROR * motion.camera.width:
        doubts.append(
            f"image points miss their places by {motion.error_px:.1f} pixels, as with a wrong "
            "focal length, distortion or a moving scene"
        )
    if motion.focal_sigma is not None and motion.focal_sigma > _MAX_FOCAL_SIGMA:
        doubts.append("the motion does not determine the focal length; specify the field of view")
    return doubts
