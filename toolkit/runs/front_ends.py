"""Where the poses of a run come from: a depth camera, images alone, or the dataset."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toolkit.datasets.base import Dataset, RecordedDataset
from toolkit.depth_priors.correction import DepthCorrection
from toolkit.errors import DatasetError, ToolkitError
from toolkit.evaluation.timing import StageRecorder
from toolkit.geometry.trajectory import Trajectory
from toolkit.loops.closing.factory import ClosingContext, build_loop_closer
from toolkit.loops.closing.given_parts import GivenParts
from toolkit.loops.closing.interface import LoopClosing, NoLoopClosing
from toolkit.loops.log import LoopLog
from toolkit.monocular.sequence import MonocularSequence
from toolkit.runs.folder import RunFolder
from toolkit.runs.settings import RunSettings
from toolkit.semantics.codes import SemanticCode
from toolkit.slam.front_end import FrontEnd
from toolkit.slam.length_unit import METRE, LengthUnit
from toolkit.tracking.factory import build_tracker
from toolkit.tracking.given import GivenPoses
from toolkit.tracking.guided import GuidedTracker
from toolkit.tracking.initial_velocity import initial_velocity
from toolkit.tracking.placement import KeyframePlacement


@dataclass(frozen=True)
class FrontEndParts:
    """What front ends are built from.

    Attributes:
        settings: of the run.
        dataset: the sequence; None for frames of another source.
        recorder: measures the time of each stage.
        context: of loop closure.
        code: of the semantic features; None without semantics.
        folder: stores the loop log; None keeps it nowhere.
        record_in_metres: converts a record of the loop log from the unit of the system.
        correction: see `FrontEnd`.
    """

    settings: RunSettings
    dataset: Dataset | None
    recorder: StageRecorder
    context: ClosingContext
    code: SemanticCode | None
    folder: RunFolder | None
    record_in_metres: Callable[[Mapping[str, Any]], dict[str, Any]]
    correction: DepthCorrection | None


def build_front_end(parts: FrontEndParts) -> FrontEnd:
    """Build the front end that the settings describe; the only place that asks for the mode.

    Raises:
        ToolkitError: the settings need something that the dataset lacks.
    """
    if parts.settings.poses == "given":
        return _given(parts)
    if parts.settings.depth == "none":
        return _from_images(parts)
    return _with_depth(parts)


def _with_depth(parts: FrontEndParts) -> FrontEnd:
    settings = parts.settings
    # A map that is extended may be loaded before the first frame.
    fixed = parts.dataset is None and settings.map is not None
    unit = METRE if fixed else LengthUnit.of(parts.dataset)
    closer: LoopClosing = NoLoopClosing()
    if settings.loops.use:
        log = None
        if parts.folder is not None:
            log = LoopLog(parts.folder.loops, convert=parts.record_in_metres)
        closer = build_loop_closer(settings.loops, parts.context, log, parts.recorder)
    # The papers' tracker is a baseline, whose keyframe poses are not refined.
    dense = settings.tracking.kind == "dense"
    return FrontEnd(
        build_tracker(settings.tracking, settings.backend, parts.recorder, parts.code),
        closer,
        KeyframePlacement(settings.placement) if dense and settings.placement.use else None,
        start_velocity=_start_velocity(parts.dataset, unit),
        centred=dense,
        gains=dense and settings.tracking.dense.exposure,
        unit=unit,
    )


def _from_images(parts: FrontEndParts) -> FrontEnd:
    settings, dataset = parts.settings, parts.dataset
    trajectories = [_poses_of(dataset)]
    closer: LoopClosing = NoLoopClosing()
    if isinstance(dataset, MonocularSequence):
        trajectories = list(dataset.trajectories)
        closer = GivenParts(dataset.part_of_keyframe)
    tracker = GuidedTracker(trajectories, settings.backend, parts.recorder)
    return FrontEnd(tracker, closer, correction=parts.correction, gains=True)


def _given(parts: FrontEndParts) -> FrontEnd:
    trajectory = _poses_of(parts.dataset)
    if parts.settings.depth == "none":
        return FrontEnd(GivenPoses(trajectory), correction=parts.correction)
    unit = LengthUnit.of(parts.dataset)
    return FrontEnd(GivenPoses((unit or METRE).trajectory(trajectory)), unit=unit)


def _poses_of(dataset: Dataset | None) -> Trajectory:
    if dataset is None or dataset.ground_truth is None:
        name = "this sequence" if dataset is None else dataset.name
        raise DatasetError(f"poses 'given' needs poses, but {name} has none; set poses to 'slam'")
    return dataset.ground_truth


def _start_velocity(dataset: Dataset | None, unit: LengthUnit | None) -> NDArray[np.float64] | None:
    """Velocity [6] of a camera with a rolling shutter at the start of a sequence, if known.

    It is estimated before any thread reads the dataset.
    """
    if unit is None:
        return None
    if not isinstance(dataset, RecordedDataset) or dataset.readout_s == 0.0:
        return None
    try:
        return initial_velocity(unit.frame(dataset[0]), unit.frame(dataset[1]))
    except (ToolkitError, IndexError):
        return None  # the file is named when the frame is processed
