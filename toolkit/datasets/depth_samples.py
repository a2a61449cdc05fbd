"""Depth images of some frames of a recording, from which properties of all are found."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from toolkit.base.errors import DatasetError
from toolkit.datasets.base import FrameFiles, Recording
from toolkit.datasets.far_values import without_far_value
from toolkit.datasets.samples import evenly_spaced
from toolkit.datasets.sparse_depth import sparsity
from toolkit.io import images

# Number of frames that are read.
_FRAMES = 8


def depth_samples(recording: Recording, max_frames: int | None = None) -> list[NDArray]:
    """Depth values [H, W] of evenly spaced frames in the unit of the images, 0 where not finite.

    Args:
        recording: its files.
        max_frames: maximum number of frames from the start that may be read, or None for all.

    Returns:
        Nothing if a file cannot be read, which reading the frames reports, or without depth.
    """
    files = [frame for frame in recording.files[:max_frames] if frame.depth is not None]
    if not files:
        return []
    try:
        return [_values(recording, files[n]) for n in evenly_spaced(len(files), _FRAMES)]
    except DatasetError:
        return []


def _values(recording: Recording, frame: FrameFiles) -> NDArray:
    if recording.container is not None and frame.number is not None:
        return np.nan_to_num(recording.container.depth_m(frame.number), posinf=0.0, neginf=0.0)
    assert frame.depth is not None
    return images.read_depth_values(frame.depth)


def with_usable_depth(recording: Recording, max_frames: int | None = None) -> Recording:
    """A recording whose far value counts as missing, and whose sparse depth is filled.

    Args:
        recording: its files.
        max_frames: maximum number of frames from the start that may be read, or None for all.
    """
    depths = depth_samples(recording, max_frames)
    return _with_gaps_filled(without_far_value(recording, depths), depths)


def _with_gaps_filled(recording: Recording, depths: Sequence[NDArray]) -> Recording:
    """A recording whose gaps are filled if its depth is sparse, with a note."""
    per_metre = recording.depth_scale if recording.container is None else 1.0
    missing_from = min(recording.missing_from_m * per_metre, float(images.SATURATED_DEPTH))
    found = sparsity([np.where(depth < missing_from, depth, 0) for depth in depths])
    if not found.is_sparse:
        return recording
    note = (
        f"depth covers {found.covered:.0%} of the image, in single pixels or lines; it is "
        f"interpolated between samples of the same surface"
    )
    return replace(recording, gap_px=found.window_px, notes=(*recording.notes, note))
