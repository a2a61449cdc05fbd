"""Open datasets by kind."""

from __future__ import annotations

import logging
import os
from dataclasses import replace
from importlib import import_module
from pathlib import Path

from toolkit.base.errors import DatasetError
from toolkit.datasets.base import RecordedDataset, Recording
from toolkit.datasets.estimates import RecordingEstimates
from toolkit.datasets.findings import camera_faults, pose_faults
from toolkit.datasets.options import READERS, BagTopics, DatasetOptions
from toolkit.datasets.preparation import (
    check_depth,
    check_times,
    reduced_size,
    use_given_poses,
    with_depth,
    with_estimates,
    with_fov,
    without_depth,
)

_log = logging.getLogger(__name__)


def open_dataset(
    kind: str,
    path: str | os.PathLike[str],
    image_size: tuple[int, int] | None = None,
    max_frames: int | None = None,
    needs_depth: bool = True,
    options: DatasetOptions | None = None,
) -> RecordedDataset:
    """Open a dataset; frames are loaded on access.

    The first frame is loaded immediately to detect a wrong path, image size or scale early.

    Args:
        kind: one of `READERS`; synthetic rooms use the layout of Replica.
        path: folder of the dataset.
        image_size: (width, height) in pixels to scale and crop to. By default, images keep their
            size, except large ones without depth, which are reduced.
        max_frames: maximum number of frames from the start, or None for all.
        needs_depth: whether a recording without depth is an error. Otherwise, depth is not used,
            nor are the options for it.
        options: what is stated or estimated of the recording; its kind and path are those above.

    Raises:
        DatasetError: the kind is unknown, or the dataset is missing or inconsistent.
        FormatError: a text file is malformed.
        SettingsError: no poses are left by the delay of the options.
    """
    options = replace(options or DatasetOptions(), kind=kind, path=Path(path))
    return open_place(options, image_size, max_frames, needs_depth)


def open_place(
    place: DatasetOptions,
    image_size: tuple[int, int] | None = None,
    max_frames: int | None = None,
    needs_depth: bool = True,
    known: RecordingEstimates | None = None,
) -> RecordedDataset:
    """Open the dataset that options name; see `open_dataset`.

    Args:
        place: with the path of the dataset.
        known: what a run has estimated of the recording, which is not estimated again unless its
            images have another size.
    """
    assert place.path is not None
    recording = describe(place.kind, place.path, place.topics)
    if not needs_depth:
        recording = without_depth(recording)
    if place.fov_deg is not None:
        recording = with_fov(recording, place.fov_deg, place.path)
    if known is not None and not known.fit(recording):
        known = None
    if needs_depth:
        recording = with_depth(recording, place, max_frames, known)
    else:
        image_size = image_size or reduced_size(recording)
    dataset = RecordedDataset(recording, image_size, max_frames)
    check_times(dataset, place.path)
    first = dataset[0]
    if needs_depth:
        check_depth(dataset, first, place.path)
        recording = with_estimates(recording, place, max_frames, known)
        dataset = RecordedDataset(recording, image_size, max_frames)
    for flaw in recording.flaws:
        _log.warning("%s: %s", dataset.name, flaw)
    for note in recording.notes:
        _log.info("%s: %s", dataset.name, note)
    use_given_poses(dataset, place, needs_depth)
    return dataset


def describe(kind: str, path: str | os.PathLike[str], topics: BagTopics | None = None) -> Recording:
    """Describe the recording at a path without loading its frames.

    Raises:
        DatasetError: the kind is unknown, or the dataset is missing or inconsistent.
        FormatError: a text file is malformed.
    """
    if kind not in READERS:
        raise DatasetError(f"unknown dataset kind {kind!r}; supported are {', '.join(READERS)}")
    reader = import_module(f"toolkit.datasets.readers.{READERS[kind]}")
    if topics is not None and topics != BagTopics():
        if kind != "bag":
            raise DatasetError(f"dataset.topics is for bags; remove it for {kind}")
        recording: Recording = reader.describe(Path(path), topics)
    else:
        recording = reader.describe(Path(path))
    flaws = (*recording.flaws, *pose_faults(recording))
    if recording.calibrated:
        flaws += camera_faults(recording.camera)
    return replace(recording, flaws=flaws)
