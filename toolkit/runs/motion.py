"""The motion of the camera of a sequence without depth, before its first frame is mapped."""

from __future__ import annotations

import logging
from collections.abc import Iterable
from dataclasses import replace

from toolkit.base.errors import DatasetError
from toolkit.base.frame import Frame
from toolkit.base.geometry.image_sides import ImageSide
from toolkit.datasets.base import RecordedDataset
from toolkit.datasets.images_only import ImagesOnly
from toolkit.datasets.options import DatasetOptions
from toolkit.depth.depth_priors.provider import DepthProvider
from toolkit.depth.monocular.confirmed_depth import with_confirmed_depth
from toolkit.depth.monocular.given import motion_of_given_poses
from toolkit.depth.monocular.motion import FOCAL_ROUNDS, CameraMotion, estimate_motion
from toolkit.depth.monocular.options import ScaleOptions
from toolkit.depth.monocular.prior_check import doubt_about_priors
from toolkit.depth.monocular.scale import with_metric_scale
from toolkit.runs.expected_time import with_expected_motion_time
from toolkit.runs.image_side import FoundSide, find_side
from toolkit.runs.observers import Progress
from toolkit.runs.settings import RunSettings

_log = logging.getLogger(__name__)


def estimated_motion(dataset: RecordedDataset, progress: Progress) -> CameraMotion:
    """Estimate the motion of the camera from the images alone."""
    _log.info("Estimating the motion of the camera from the images.")
    total = len(dataset)
    calibrated = dataset.recording.calibrated
    passes = 1 if calibrated else FOCAL_ROUNDS
    begun = False

    def watched(frames: Iterable[Frame]) -> Iterable[Frame]:
        """Frames with a progress bar; the first pass states how long it takes."""
        nonlocal begun
        if not begun:
            frames = with_expected_motion_time(frames, total, passes)
        begun = True
        return progress(frames, total, 0)

    motion = estimate_motion(
        dataset,
        dataset.camera,
        calibrated,
        focal_sigma=dataset.recording.focal_sigma,
        progress=watched,
    )
    if not calibrated:
        _log.info("The focal length is %.0f pixels.", motion.camera.fx)
        dataset.use_camera(motion.camera)
    if motion.views:
        _log.info(
            "Found the motion of %d of %d frames, with %d keyframes.",
            len(motion.trajectory),
            total,
            len(motion.views),
        )
        if motion.others:
            _log.info(
                "%d more frames are in %d other part(s), each with a unit of length of its own.",
                motion.frames_in_others,
                len(motion.others),
            )
    return motion


def side_of_motion(
    motion: CameraMotion, dataset: RecordedDataset, options: DatasetOptions
) -> FoundSide:
    """Find the side of the images that is up by the depth of some keyframes of a motion.

    Args:
        options: may state the side.
    """
    # What states or measures the side makes the depth unnecessary.
    frames = (frame for _, frame in with_confirmed_depth(motion, ImagesOnly(dataset)))
    return find_side(dataset, frames, options)


def in_metres(
    motion: CameraMotion, dataset: RecordedDataset, options: ScaleOptions, side: ImageSide
) -> CameraMotion:
    """Scale a motion by the length that is known, if one is, and log it.

    Args:
        side: the side of the images that is up.
    """
    motion = with_metric_scale(motion, dataset, dataset.timestamps_s, options, side)
    if motion.metric_scale is not None:
        _log.info(
            "The unit of length is the metre, by %s (uncertain by %.1f %%).",
            motion.metric_scale.source,
            100.0 * motion.metric_scale.sigma,
        )
    return motion


def log_doubts(motion: CameraMotion, dataset: RecordedDataset) -> None:
    """Log why the motion of a sequence is not reliable."""
    for doubt in motion.doubts:
        _log.warning("The result is not reliable: %s.", doubt)
    if motion.doubts and dataset.ground_truth is not None and dataset.recording.calibrated:
        _log.warning("The dataset has poses; --poses given uses them instead.")


def with_prior_doubts(
    motion: CameraMotion, dataset: RecordedDataset, provider: DepthProvider, settings: RunSettings
) -> CameraMotion:
    """Compare depth priors with the points of a motion; log what contradicts it."""
    options = settings.depth_prior
    option = {"maps": "--depth-prior.maps.values", "transformers": "--depth-prior.model.values"}
    doubt = doubt_about_priors(
        motion, ImagesOnly(dataset, motion.camera), provider, options, option.get(options.kind)
    )
    if doubt is None:
        return motion
    _log.warning("The result is not reliable: %s.", doubt)
    return replace(motion, doubts=[*motion.doubts, doubt])


def motion_at_given_poses(
    dataset: RecordedDataset, settings: RunSettings, progress: Progress
) -> CameraMotion:
    """The motion by the poses of the dataset, with keyframes whose depth can be estimated.

    Raises:
        DatasetError: it has no poses or intrinsics, or they do not suit its images.
    """
    if dataset.ground_truth is None:
        raise DatasetError(f"{settings.dataset.path} has no poses; remove --poses given")
    if not dataset.recording.calibrated:
        raise DatasetError(
            f"{settings.dataset.path} has no intrinsics, which given poses need; add them "
            "(docs/guides/datasets.md), or specify --dataset.fov-deg"
        )
    _log.info("Matching images at the given poses.")
    # The models of COLMAP, and what was made from them, have an arbitrary unit.
    metric = settings.dataset.kind not in ("colmap", "nerfstudio")
    frames = progress(iter(dataset), len(dataset), 0)
    try:
        motion = motion_of_given_poses(frames, dataset.camera, dataset.ground_truth, metric)
    except DatasetError as error:
        raise DatasetError(f"{settings.dataset.path}: {error}") from error
    _log.info("The depth of %d keyframes can be estimated.", len(motion.views))
    return motion
