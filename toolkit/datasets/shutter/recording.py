"""The shutter of a recording, from small images of some of its frames."""

from __future__ import annotations

from dataclasses import replace

from toolkit.datasets.base import RecordedDataset, Recording
from toolkit.datasets.samples import SMALL_WIDTH
from toolkit.datasets.shutter.estimate import ShutterEstimate, estimate_shutter


def estimate_readout(recording: Recording, max_frames: int | None = None) -> ShutterEstimate:
    """Estimate the readout time of a recording, and the delay from its colour to its depth.

    Args:
        recording: with depth.
        max_frames: maximum number of frames from the start that may be read, or None for all.

    Raises:
        DatasetError: the recording has no frames.
    """
    if not recording.files or any(files.depth is None for files in recording.files[:max_frames]):
        return ShutterEstimate(fault="there are frames without depth")
    # With a readout of one second, that of the frames is the share of rows that are not cropped.
    known = replace(recording, readout_s=1.0)
    # Rows move by fractions of a pixel of this size, which are averaged over thousands of them.
    frames = RecordedDataset(known, known.camera.size_up_to(SMALL_WIDTH), max_frames)
    found = estimate_shutter(frames)
    return replace(
        found,
        readout_s=found.readout_s / frames.readout_s,
        readout_sigma_s=found.readout_sigma_s / frames.readout_s,
    )


def with_readout(recording: Recording, found: ShutterEstimate) -> Recording:
    """A recording with an estimated readout time, 0 if that is uncertain."""
    return replace(
        recording, readout_s=found.certain_readout_s, readout_sigma_s=found.remaining_sigma_s
    )
