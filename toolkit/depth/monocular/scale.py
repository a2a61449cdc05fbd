"""Metric scale of a camera motion from a known length."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from toolkit.base.errors import SettingsError
from toolkit.base.geometry import se3
from toolkit.base.geometry.image_sides import ImageSide
from toolkit.base.geometry.trajectory import Trajectory
from toolkit.datasets.base import Dataset
from toolkit.depth.monocular.confirmed_depth import with_confirmed_depth
from toolkit.depth.monocular.floor import height_above_floor
from toolkit.depth.monocular.markers import detect_markers, side_length
from toolkit.depth.monocular.motion import CameraMotion, MetricScale
from toolkit.depth.monocular.options import ScaleOptions

Array = NDArray[np.float64]

# Step between the pixels that the floor is found in.
_FLOOR_STEP = 6
# Parts of the film that form two halves alternately.
_BLOCKS = 8
# A result that is less certain is not used.
_MAX_SIGMA = 0.2


def check_scale(options: ScaleOptions, frames: int | None = None) -> None:
    """Check that at most one length is given, and that its frames exist.

    Args:
        frames: number of frames of the dataset, if it is known.

    Raises:
        SettingsError: with the option to change.
    """
    given = [
        name
        for name in ("marker_m", "distance_m", "camera_height_m")
        if getattr(options, name) is not None
    ]
    if len(given) > 1:
        names = " and ".join(f"--scale.{name.replace('_', '-')}" for name in given)
        raise SettingsError(f"{names} both give the scale; remove all but one")
    if (options.distance_m is None) != (options.distance_frames is None):
        raise SettingsError(
            "--scale.distance-m and --scale.distance-frames belong together; specify both"
        )
    if options.distance_frames is None:
        return
    first, second = options.distance_frames
    if first == second or (frames is not None and max(first, second) >= frames):
        raise SettingsError(
            f"--scale.distance-frames must be two different frames"
            f"{'' if frames is None else f' below {frames}'}, got {first} {second}"
        )


def with_metric_scale(
    motion: CameraMotion,
    dataset: Dataset,
    timestamps_s: Array,
    options: ScaleOptions,
    side: ImageSide = "top",
) -> CameraMotion:
    """Scale a motion to metres by the length that is given, if one is; so each of its parts.

    Args:
        dataset: source of the images.
        timestamps_s: of all frames [N].
        options: the known length.
        side: the side of the images that is up.

    Returns:
        The motion in metres with its `metric_scale`; unchanged without a known length, and with a
        doubt if the length could not be found in the images, or not in those of another part.
    """
    if not motion.others:
        return _in_metres(motion, dataset, timestamps_s, options, side)
    others = [with_metric_scale(m, dataset, timestamps_s, options, side) for m in motion.others]
    main = replace(motion, others=())
    scaled_motion = _in_metres(main, dataset, timestamps_s, options, side)
    doubts = list(scaled_motion.doubts)
    doubts += [f"in another part, {doubt}" for one in others for doubt in one.doubts]
    return replace(scaled_motion, others=tuple(others), doubts=doubts)


def _in_metres(
    motion: CameraMotion,
    dataset: Dataset,
    timestamps_s: Array,
    options: ScaleOptions,
    side: ImageSide,
) -> CameraMotion:
    """One part of a motion in metres."""
    known_m: float | None
    found: Callable[[], _Length | str]
    if options.marker_m is not None:
        known_m, found = options.marker_m, lambda: _marker_side(motion, dataset, options)
    elif options.distance_m is not None and options.distance_frames is not None:
        ends = timestamps_s[list(options.distance_frames)]
        known_m, found = options.distance_m, lambda: _distance(motion, ends)
    elif options.camera_height_m is not None:
        known_m, found = options.camera_height_m, lambda: _camera_height(motion, dataset, side)
    else:
        return motion
    length = found()
    if isinstance(length, _Length) and not length.sigma <= _MAX_SIGMA:
        length = f"{length.source} is uncertain by {100 * length.sigma:.0f} %"
    if isinstance(length, str):
        doubt = f"the metric scale could not be determined: {length}"
        return replace(motion, doubts=[*motion.doubts, doubt])
    scale = MetricScale(known_m / length.value, length.sigma, length.source)
    return replace(scaled(motion, scale.factor), metric_scale=scale)


def scaled(motion: CameraMotion, factor: float) -> CameraMotion:
    """Multiply all lengths of a motion."""

    def grown(T: Array) -> Array:
        T = T.copy()
        T[..., :3, 3] *= factor
        return T

    trajectory = Trajectory(motion.trajectory.timestamps_s, grown(motion.trajectory.T_world_camera))
    views = [v.scaled(grown(v.T_world_camera), factor) for v in motion.views]
    return replace(motion, trajectory=trajectory, views=views)


@dataclass(frozen=True)
class _Length:
    """A length in the unit of the motion, its relative standard deviation, and what it is."""

    value: float
    sigma: float
    source: str


def _marker_side(motion: CameraMotion, dataset: Dataset, options: ScaleOptions) -> _Length | str:
    seen = [
        marker
        for view in motion.views
        for marker in detect_markers(
            dataset[view.frame].rgb, view.T_world_camera, options.marker_dictionary
        )
    ]
    side = side_length(seen, motion.camera)
    if side is None:
        return (
            f"no {options.marker_dictionary} marker is seen sharply from different sides in the "
            f"{len(motion.views)} keyframes"
            if not seen
            else f"the views of {len({m.marker for m in seen})} marker(s) do not agree, or are too "
            "similar"
        )
    return _Length(side.length, side.sigma, f"the side of {side.markers} marker(s)")


def _distance(motion: CameraMotion, ends_s: Array) -> _Length | str:
    """The distance between two poses; its uncertainty is that of points at the median depth."""
    times = motion.trajectory.timestamps_s
    places = [int(np.abs(times - end).argmin()) for end in ends_s]
    if any(abs(times[place] - end) > 1e-9 for place, end in zip(places, ends_s, strict=True)):
        return "a frame of the known distance has no pose"
    first, second = motion.trajectory.positions_m[places]
    distance = float(np.linalg.norm(second - first))
    depth = float(np.median([np.sqrt(view.near * view.far) for view in motion.views]))
    position = motion.error_px / motion.camera.focal * depth
    if distance <= 0:
        return "the camera is at the same position in both frames"
    return _Length(
        distance, float(np.sqrt(2.0)) * position / distance, "the distance of two frames"
    )


def _camera_height(motion: CameraMotion, dataset: Dataset, side: ImageSide) -> _Length | str:
    """The height above the floor; its uncertainty is the difference between halves of the film."""
    points = []
    for view, frame in with_confirmed_depth(motion, dataset):
        sampled = frame.depth_m[_FLOOR_STEP // 2 :: _FLOOR_STEP, _FLOOR_STEP // 2 :: _FLOOR_STEP]
        seen = motion.camera.unproject(frame.depth_m, _FLOOR_STEP)[sampled > 0]
        points.append(se3.transform_points(view.T_world_camera, seen))
    blocks = [part for part in np.array_split(np.arange(len(points)), _BLOCKS) if len(part)]
    whole, *halves = (
        height_above_floor(
            np.concatenate([points[n] for block in chosen for n in block]),
            motion.trajectory.T_world_camera,
            np.random.default_rng(0),
            side,
        )
        for chosen in (blocks, blocks[::2], blocks[1::2] or blocks)
    )
    if whole is None:
        return "no floor is visible below the camera"
    if halves[0] is None or halves[1] is None:
        return "the floor is visible in too few keyframes"
    difference = abs(halves[1].height - halves[0].height) / whole.height
    return _Length(whole.height, max(whole.sigma, difference), "the height above the floor")
