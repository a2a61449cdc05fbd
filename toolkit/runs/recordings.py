"""The recording that a run's settings name."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

from toolkit.datasets.base import RecordedDataset
from toolkit.datasets.estimates import RecordingEstimates
from toolkit.datasets.registry import open_place
from toolkit.runs.modes import mode_of
from toolkit.runs.settings import RunSettings


def open_recording(
    settings: RunSettings,
    path: str | os.PathLike[str],
    image_size: tuple[int, int] | None = None,
    known: RecordingEstimates | None = None,
) -> RecordedDataset:
    """Open the dataset of a run.

    Args:
        path: of the dataset; that of the settings may be relative, missing or moved.
        image_size: width and height in pixels; by default those of the settings.
        known: what a finished run has estimated of the recording, which is not estimated again.

    Raises:
        DatasetError: it does not exist or is inconsistent.
        SettingsError: no poses are left by the delay of the settings.
    """
    place = replace(settings.dataset, path=Path(path))
    size, needs_depth = image_size or settings.image_size, mode_of(settings).needs_depth
    return open_place(place, size, settings.max_frames, needs_depth, known)
