"""Defects of a recording that a few of its frames show; a run reports them, too."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from toolkit.base.frame import Frame
from toolkit.base.geometry.camera import Camera
from toolkit.datasets.base import Recording
from toolkit.datasets.depth_kind import depth_kind_fault
from toolkit.datasets.pairing import listed
from toolkit.datasets.registration_check import measure_registration

# Range of the median depth of most recordings, and of any sensor, metres.
_USUAL_M, _POSSIBLE_M = (0.1, 30.0), (0.01, 200.0)
# Intrinsics of usual cameras: place of the principal point in the image, as shares of its sides;
# horizontal field of view; ratio of the focal lengths, which images resized to another shape have.
_CENTRAL, _USUAL_FOV_DEG, _MAX_ASPECT = (0.2, 0.8), (3.0, 150.0), 1.8
# A pose is an outlier from this distance to both neighbours, in metres and in usual steps, if these
# are closer to each other than this share of it; usual steps need some poses.
_JUMP_M, _JUMP_STEPS, _RETURN, _MIN_POSES = 0.1, 10.0, 0.25, 5
_COMMON_SCALES = (1000.0, 5000.0, 6553.5)


def quick_findings(frames: Sequence[Frame], depth_scale: float) -> tuple[str, ...]:
    """One line for each defect or doubt that frames with depth show.

    Args:
        frames: evenly spaced ones of a recording.
        depth_scale: values of its depth images per metre.
    """
    scale = depth_scale_finding(median_depths_m(frames), depth_scale)
    return (*([scale] if scale else []), *depth_faults(frames))


def camera_faults(camera: Camera) -> tuple[str, ...]:
    """Lines about intrinsics that no usual camera has, such as those of another resolution."""
    size = f"the {camera.width}x{camera.height} images"
    remedy = "check that the intrinsics are those of this resolution"
    faults = []
    low, high = _CENTRAL
    if not (
        low * camera.width <= camera.cx + 0.5 <= high * camera.width
        and low * camera.height <= camera.cy + 0.5 <= high * camera.height
    ):
        faults.append(
            f"the principal point ({camera.cx:.1f}, {camera.cy:.1f}) is far from the centre of "
            f"{size}; {remedy}"
        )
    fov_deg = np.degrees(2.0 * np.arctan(0.5 * camera.width / camera.fx))
    if not _USUAL_FOV_DEG[0] <= fov_deg <= _USUAL_FOV_DEG[1]:
        faults.append(
            f"with a focal length of {camera.fx:.1f} pixels, {size} cover {fov_deg:.1f} degrees; "
            f"{remedy}"
        )
    if max(camera.fx / camera.fy, camera.fy / camera.fx) > _MAX_ASPECT:
        faults.append(
            f"the focal lengths {camera.fx:.1f} and {camera.fy:.1f} of {size} differ by more than "
            f"pixels of any camera; {remedy}"
        )
    return tuple(faults)


def pose_faults(recording: Recording) -> tuple[str, ...]:
    """A line about single poses that are far from those before and after, which are close."""
    truth = recording.ground_truth
    if truth is None or len(truth) < _MIN_POSES:
        return ()
    positions_m = truth.positions_m
    steps_m = np.linalg.norm(np.diff(positions_m, axis=0), axis=1)
    away_m = np.minimum(steps_m[:-1], steps_m[1:])
    past_m = np.linalg.norm(positions_m[2:] - positions_m[:-2], axis=1)
    jumps = away_m > max(_JUMP_M, _JUMP_STEPS * float(np.median(steps_m)))
    jumps &= past_m < _RETURN * away_m
    if not jumps.any():
        return ()
    names = {files.timestamp_s: files.name for files in recording.files}
    times_s = truth.timestamps_s[1:-1][jumps].tolist()
    jumping = [names.get(time_s, f"{time_s:.3f} s") for time_s in times_s]
    return (
        f"{len(jumping)} ground-truth pose(s) are up to {length(float(away_m[jumps].max()))} from "
        f"those of the frames before and after; correct or remove them: {listed(jumping)}",
    )


def depth_faults(frames: Sequence[Frame]) -> list[str]:
    """Lines about depth of another kind, and about depth that is not registered to colour."""
    lines = depth_kind_fault(frames), measure_registration(frames).verdict()
    return [line for line in lines if line]


def median_depths_m(frames: Iterable[Frame]) -> list[float]:
    """Median depth in metres, of every fourth pixel with depth, of each frame that has depth."""
    measured = (frame.depth_m[frame.depth_m > 0] for frame in frames)
    return [float(np.median(depth_m[::4])) for depth_m in measured if depth_m.size]


def depth_scale_finding(medians_m: Sequence[float], depth_scale: float) -> str | None:
    """A line about depths that are unusual or impossible.

    Args:
        medians_m: median depths of frames in metres.
        depth_scale: values of the depth images per metre.
    """
    if not medians_m:
        return None
    median_m = float(np.median(medians_m))
    if _USUAL_M[0] <= median_m <= _USUAL_M[1]:
        return None
    # The scale whose median depth is closest to 2 m.
    likely = min(_COMMON_SCALES, key=lambda s: abs(np.log(median_m * depth_scale / s / 2.0)))
    return (
        f"the median depth is {length(median_m)} with {depth_scale:g} values per metre; if the "
        f"scene is not at this distance, correct the depth scale ({likely:g} would give "
        f"{length(median_m * depth_scale / likely)})"
    )


def is_impossible_depth(medians_m: Sequence[float]) -> bool:
    """Whether no depth sensor measures these median depths in metres."""
    if not medians_m:
        return False
    return not _POSSIBLE_M[0] <= float(np.median(medians_m)) <= _POSSIBLE_M[1]


def length(metres: float) -> str:
    """A length with a suitable unit."""
    if metres < 0.1:
        return f"{metres * 1000:.3g} mm"
    return f"{metres:.3g} m" if metres < 1000 else f"{metres / 1000:.3g} km"
