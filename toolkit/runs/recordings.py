"""The recording that a run's settings name."""

from __future__ import annotations

import os

from toolkit.datasets.base import RecordedDataset
from toolkit.datasets.registry import open_dataset
from toolkit.runs.settings import RunSettings


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
    """
    place = settings.dataset
    return open_dataset(
        place.kind,
        path,
        image_size or settings.image_size,
        settings.max_frames,
        needs_depth=settings.depth == "sensor",
        fov_deg=place.fov_deg,
        topics=place.topics,
        depth_offset=place.depth_offset,
        readout_ms=place.readout_ms,
    )
