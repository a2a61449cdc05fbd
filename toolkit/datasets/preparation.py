"""Preparation of recordings: what options specify, and what is estimated from their images."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path
from typing import Literal

from toolkit.base.errors import DatasetError, SettingsError
from toolkit.base.frame import Frame
from toolkit.base.geometry.trajectory import Trajectory
from toolkit.datasets.agreement.refine import with_intrinsics, with_refined_intrinsics
from toolkit.datasets.base import RecordedDataset, Recording
from toolkit.datasets.carrier import without_carrier
from toolkit.datasets.depth_offset import OFFSET_FRAMES, estimate_depth_offset
from toolkit.datasets.depth_samples import with_usable_depth
from toolkit.datasets.estimates import RecordingEstimates
from toolkit.datasets.options import DatasetOptions
from toolkit.datasets.pose_convention import judge_convention
from toolkit.datasets.readers import video
from toolkit.datasets.samples import SmallFrames, evenly_spaced
from toolkit.datasets.shutter.recording import estimate_readout, with_readout
from toolkit.datasets.times import is_impossible, unit_fault

_log = logging.getLogger(__name__)

# Larger images without depth are reduced to a longer side of _REDUCED_SIDE: a phone's film has
# nine times as many pixels, and time and Gaussians grow with them.
_MAX_PIXELS = 400_000
_REDUCED_SIDE = 640


def with_depth(
    recording: Recording,
    options: DatasetOptions,
    max_frames: int | None,
    known: RecordingEstimates | None,
) -> Recording:
    """Prepare the depth of a recording: leave out unusable depth, shift it, find the carrier.

    Args:
        max_frames: maximum number of frames from the start, or None for all.
        known: replaces what would be estimated.
    """
    recording = with_usable_depth(recording, max_frames)
    offset = options.depth_offset
    if offset == "auto" and known is not None:
        offset = known.depth_offset_px
    recording = _with_offset(recording, offset, max_frames)
    if options.ignore_carrier:
        recording = without_carrier(recording, max_frames)
    if options.readout_ms != "auto":
        recording = replace(recording, readout_s=1e-3 * options.readout_ms)
    return recording


def without_depth(recording: Recording) -> Recording:
    """Return a recording whose depth is not used: the larger of its cameras, and no readout.

    Motion is estimated from features of the images as they are.
    """
    return replace(recording, camera=recording.colour_camera or recording.camera, readout_s=0.0)


def with_estimates(
    recording: Recording,
    options: DatasetOptions,
    max_frames: int | None,
    known: RecordingEstimates | None,
) -> Recording:
    """Estimate the intrinsics, if the options demand it, and the readout, if it is not known.

    Args:
        recording: with depth and intrinsics.
        max_frames: maximum number of frames from the start, or None for all.
        known: replaces what would be estimated.
    """
    if options.intrinsics == "refine" and known is not None:
        recording = with_intrinsics(recording, known.camera, known.distortion)
    elif options.intrinsics == "refine":
        recording = with_refined_intrinsics(recording, max_frames)
    if recording.readout_s is None and known is not None:
        recording = known.with_readout(recording)
    if recording.readout_s is None:
        recording = _with_readout(recording, max_frames)
    return recording


def use_given_poses(dataset: RecordedDataset, options: DatasetOptions, needs_depth: bool) -> None:
    """Convert the poses of a recording and undo their delay, as the options demand.

    Raises:
        SettingsError: no poses are left by the delay.
    """
    given = stated = dataset.recording.ground_truth
    if given is not None and options.pose_convention == "correct" and needs_depth:
        given = _corrected(dataset, given)
    if given is not None and options.pose_delay:
        given = given.delayed(options.pose_delay)
        if not len(given):
            raise SettingsError(
                f"--dataset.pose-delay {options.pose_delay:g} leaves no poses of {dataset.name}; "
                f"give a shorter time"
            )
    if given is not stated:
        dataset.use_poses(given)


def _corrected(dataset: RecordedDataset, given: Trajectory) -> Trajectory:
    """Poses that contradict depth and colour, in the convention that agrees with them."""
    judged = judge_convention(SmallFrames(dataset))
    if judged is None or judged.found is None or judged.found.is_ours:
        return given
    _log.info(
        "%s: the given poses are converted, because depth and colour agree if %s",
        dataset.name,
        judged.found,
    )
    return judged.found.applied(given)


def check_times(dataset: RecordedDataset, path: Path) -> None:
    """Check that the times of the frames are seconds.

    Raises:
        DatasetError: they cannot be.
    """
    fault = unit_fault(dataset.timestamps_s)
    if fault and is_impossible(dataset.timestamps_s):
        raise DatasetError(f"{path}: {fault}")
    if fault:
        _log.warning("%s: %s", dataset.name, fault)


def check_depth(dataset: RecordedDataset, first: Frame, path: Path) -> None:
    """Check that a recording has depth and intrinsics.

    Raises:
        DatasetError: it has not.
    """
    recording, depth = dataset.recording, dataset.files(0).depth
    if depth is None:
        raise DatasetError(
            f"{path}: {recording.depth_fault}"
            if recording.depth_fault
            else f"{path} has no depth images; add them, or estimate depth from the images with "
            "--depth none"
        )
    if not recording.calibrated:
        raise DatasetError(
            f"{path} has no intrinsics; add them (docs/guides/datasets.md), or specify the field "
            f"of view with --dataset.fov-deg"
        )
    if not first.depth_m.any():
        start = next((i for i in range(1, len(dataset)) if dataset[i].depth_m.any()), None)
        if start is None:
            raise DatasetError(
                f"{depth} and all later depth images contain no valid depth; check how depth was "
                f"saved"
            )
        _log.warning(
            "%s: the first %d frame(s) have no depth; the map starts at frame %d or later",
            dataset.name,
            start,
            start,
        )


def with_fov(recording: Recording, fov_deg: float, path: Path) -> Recording:
    """A recording without intrinsics, with a camera of a horizontal field of view."""
    if recording.calibrated:
        raise DatasetError(f"{path} has intrinsics; remove the field of view")
    camera = video.camera_with_fov(recording.camera, fov_deg)
    return replace(recording, camera=camera, calibrated=True, focal_sigma=None)


def _with_offset(
    recording: Recording,
    offset: Literal["auto"] | tuple[float, float] | None,
    max_frames: int | None,
) -> Recording:
    """A recording whose depth is shifted to match its colour images; None does not shift it."""
    if offset is None:
        return recording
    if offset != "auto":
        return replace(recording, depth_offset_px=offset)
    frames = RecordedDataset(recording, max_frames=max_frames)
    found = estimate_depth_offset(frames[n] for n in evenly_spaced(len(frames), OFFSET_FRAMES))
    if found.fault is not None:
        _log.warning(
            "%s: the offset of colour from depth is not determined (%s); depth is not shifted",
            recording.name, found.fault,
        )  # fmt: skip
        return recording
    _log.info(
        "%s: depth is shifted by %s to match colour, with a standard error of %.2f px",
        recording.name, found, found.sigma_px,
    )  # fmt: skip
    return replace(recording, depth_offset_px=(found.x_px, found.y_px))


def _with_readout(recording: Recording, max_frames: int | None) -> Recording:
    """A recording with the estimated time of its rolling shutter, 0 if that is uncertain."""
    found = estimate_readout(recording, max_frames)
    _log.info(
        "%s: rolling shutter: %s; %s",
        recording.name,
        found,
        f"{1e3 * found.certain_readout_s:.1f} ms is undone"
        if found.certain_readout_s
        else "it is not undone",
    )
    return with_readout(recording, found)


def reduced_size(recording: Recording) -> tuple[int, int] | None:
    """A size at which depth can be estimated in reasonable time; None for images that small."""
    width, height = recording.camera.size
    if width * height <= _MAX_PIXELS:
        return None
    scale = _REDUCED_SIDE / max(width, height)
    size = round(scale * width), round(scale * height)
    _log.info(
        "%s: images of %dx%d pixels are reduced to %dx%d; --image-size selects another size",
        recording.name, width, height, *size,
    )  # fmt: skip
    return size
