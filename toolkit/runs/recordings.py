"""The recording that a run's settings name."""

from __future__ import annotations

import logging
import os

from toolkit.datasets.base import RecordedDataset
from toolkit.datasets.pose_convention import judge_convention
from toolkit.datasets.registry import open_dataset
from toolkit.errors import SettingsError
from toolkit.geometry.trajectory import Trajectory
from toolkit.runs.modes import mode_of
from toolkit.runs.settings import RunSettings

_log = logging.getLogger(__name__)


def open_recording(
    settings: RunSettings,
    path: str | os.PathLike[str],
    image_size: tuple[int, int] | None = None,
) -> RecordedDataset:
    """Open the dataset of a run.

    Args:
        path: of the dataset; that of the settings may be relative, missing or moved.
        image_size: width and height in pixels; by default those of the settings.

    Raises:
        DatasetError: it does not exist or is inconsistent.
        SettingsError: no poses are left by the delay of the settings.
    """
    place, needs_depth = settings.dataset, mode_of(settings).needs_depth
    dataset = open_dataset(
        place.kind,
        path,
        image_size or settings.image_size,
        settings.max_frames,
        needs_depth=needs_depth,
        fov_deg=place.fov_deg,
        topics=place.topics,
        depth_offset=place.depth_offset,
        readout_ms=place.readout_ms,
        ignore_carrier=place.ignore_carrier,
        refine_intrinsics=place.intrinsics == "refine",
    )
    given = dataset.recording.ground_truth
    if given is not None and place.pose_convention == "correct" and needs_depth:
        given = _corrected(dataset, given)
    if given is not None and place.pose_delay:
        given = given.delayed(place.pose_delay)
        if not len(given):
            raise SettingsError(
                f"--dataset.pose-delay {place.pose_delay:g} leaves no poses of {dataset.name}; "
                f"give a shorter time"
            )
    if given is not dataset.recording.ground_truth:
        dataset.use_poses(given)
    return dataset


def _corrected(dataset: RecordedDataset, given: Trajectory) -> Trajectory:
    """Poses that contradict depth and colour, in the convention that agrees with them."""
    judged = judge_convention(dataset)
    if judged is None or judged.found is None or judged.found.is_ours:
        return given
    _log.info(
        "%s: the given poses are converted, because depth and colour agree if %s",
        dataset.name,
        judged.found,
    )
    return judged.found.applied(given)
