"""Open datasets by kind."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Literal

from toolkit.datasets import (
    bag,
    colmap,
    folder,
    nerfstudio,
    photos,
    polycam,
    record3d,
    replica,
    scannet,
    seven_scenes,
    stray_scanner,
    tum,
    video,
)
from toolkit.datasets.agreement.refine import with_refined_intrinsics
from toolkit.datasets.base import RecordedDataset, Recording
from toolkit.datasets.carrier import without_carrier
from toolkit.datasets.depth_offset import estimate_depth_offset, frames_for_offset
from toolkit.datasets.depth_samples import with_usable_depth
from toolkit.datasets.findings import camera_faults, pose_faults
from toolkit.datasets.options import BagTopics
from toolkit.datasets.shutter.recording import estimate_readout, with_readout
from toolkit.datasets.times import is_impossible, unit_fault
from toolkit.errors import DatasetError
from toolkit.frame import Frame

_log = logging.getLogger(__name__)

# Larger images without depth are reduced to a longer side of _REDUCED_SIDE: a phone's film has
# nine times as many pixels, and time and Gaussians grow with them.
_MAX_PIXELS = 400_000
_REDUCED_SIDE = 640

KINDS: dict[str, Callable[[Path], Recording]] = {
    "synthetic": replica.describe,
    "tum": tum.describe,
    "replica": replica.describe,
    "seven-scenes": seven_scenes.describe,
    "scannet": scannet.describe,
    "nerfstudio": nerfstudio.describe,
    "stray-scanner": stray_scanner.describe,
    "record3d": record3d.describe,
    "polycam": polycam.describe,
    "colmap": colmap.describe,
    "folder": folder.describe,
    "video": video.describe,
    "images": photos.describe,
    "bag": bag.describe,
}


def open_dataset(  # noqa: PLR0913 - everything that a user can specify about a recording
    kind: str,
    path: str | os.PathLike[str],
    image_size: tuple[int, int] | None = None,
    max_frames: int | None = None,
    needs_depth: bool = True,
    fov_deg: float | None = None,
    topics: BagTopics | None = None,
    depth_offset: Literal["auto"] | tuple[float, float] | None = None,
    readout_ms: Literal["auto"] | float = "auto",
    ignore_carrier: bool = True,
    refine_intrinsics: bool = False,
) -> RecordedDataset:
    """Open a dataset; frames are loaded on access.

    The first frame is loaded immediately to detect a wrong path, image size or scale early.

    Args:
        kind: one of `KINDS`; synthetic rooms use the layout of Replica.
        path: folder of the dataset.
        image_size: (width, height) in pixels to scale and crop to. By default, images keep their
            size, except large ones without depth, which are reduced.
        max_frames: maximum number of frames from the start, or None for all.
        needs_depth: whether a recording without depth is an error.
        fov_deg: horizontal field of view of a recording without intrinsics; None to estimate it.
        topics: names of topics of a bag; None to choose them.
        depth_offset: (x, y) in pixels of the files by which colour is offset from depth, or "auto"
            to estimate it; depth is shifted by it.
        readout_ms: time in milliseconds from the exposure of the first row of an image to that of
            the last; "auto" for that of the recording, which is estimated from its images if it is
            not specified. Not used without depth.
        ignore_carrier: whether parts of the image that move with the camera, such as the body of
            a robot, are found and ignored. Not used without depth.
        refine_intrinsics: whether intrinsics that contradict depth and colour are replaced by those
            that agree. Not used without depth.

    Raises:
        DatasetError: the kind is unknown, or the dataset is missing or inconsistent.
        FormatError: a text file is malformed.
    """
    recording = describe(kind, path, topics)
    if not needs_depth and recording.colour_camera is not None:
        recording = replace(recording, camera=recording.colour_camera)
    if fov_deg is not None:
        recording = _with_fov(recording, fov_deg, path)
    if image_size is None and not needs_depth:
        image_size = _reduced(recording)
    if needs_depth:
        recording = with_usable_depth(recording, max_frames)
        recording = _with_offset(recording, depth_offset, max_frames)
        recording = without_carrier(recording, max_frames) if ignore_carrier else recording
    else:  # motion is estimated from features of the images as they are
        readout_ms = 0.0
    if readout_ms != "auto":
        recording = replace(recording, readout_s=1e-3 * readout_ms)
    dataset = RecordedDataset(recording, image_size, max_frames)
    _check_times(dataset, path)
    first = dataset[0]
    if needs_depth:
        _check_depth(dataset, first, path)
        if refine_intrinsics:
            recording = with_refined_intrinsics(recording, max_frames)
            dataset = RecordedDataset(recording, image_size, max_frames)
    if recording.readout_s is None:
        recording = _with_readout(recording, max_frames)
        dataset = RecordedDataset(recording, image_size, max_frames)
    for flaw in dataset.recording.flaws:
        _log.warning("%s: %s", dataset.name, flaw)
    for note in dataset.recording.notes:
        _log.info("%s: %s", dataset.name, note)
    return dataset


def _check_times(dataset: RecordedDataset, path: str | os.PathLike[str]) -> None:
    """Check that the times of the frames are seconds.

    Raises:
        DatasetError: they cannot be.
    """
    fault = unit_fault(dataset.timestamps_s)
    if fault and is_impossible(dataset.timestamps_s):
        raise DatasetError(f"{path}: {fault}")
    if fault:
        _log.warning("%s: %s", dataset.name, fault)


def _check_depth(dataset: RecordedDataset, first: Frame, path: str | os.PathLike[str]) -> None:
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


def _with_fov(recording: Recording, fov_deg: float, path: str | os.PathLike[str]) -> Recording:
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
    found = estimate_depth_offset(frames[n] for n in frames_for_offset(len(frames)))
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


def _reduced(recording: Recording) -> tuple[int, int] | None:
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


def describe(kind: str, path: str | os.PathLike[str], topics: BagTopics | None = None) -> Recording:
    """Describe the recording at a path without loading its frames.

    Raises:
        DatasetError: the kind is unknown, or the dataset is missing or inconsistent.
        FormatError: a text file is malformed.
    """
    if kind not in KINDS:
        raise DatasetError(f"unknown dataset kind {kind!r}; supported are {', '.join(KINDS)}")
    if topics is not None and topics != BagTopics():
        if kind != "bag":
            raise DatasetError(f"dataset.topics is for bags; remove it for {kind}")
        recording = bag.describe(Path(path), topics)
    else:
        recording = KINDS[kind](Path(path))
    flaws = (*recording.flaws, *pose_faults(recording))
    if recording.calibrated:
        flaws += camera_faults(recording.camera)
    return replace(recording, flaws=flaws)
