"""Build a SLAM system from the settings of a run."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from toolkit.baselines.factory import build_tracker
from toolkit.closing.factory import ClosingContext, build_loop_closer
from toolkit.closing.given_parts import GivenParts
from toolkit.closing.interface import LoopClosing
from toolkit.datasets.base import Dataset, RecordedDataset
from toolkit.depth_priors.correction import DepthCorrection
from toolkit.errors import DatasetError, ToolkitError
from toolkit.evaluation.timing import StageRecorder
from toolkit.length_unit import LengthUnit
from toolkit.loops.log import LoopLog
from toolkit.mapping.factory import build_semantic_mapping
from toolkit.mapping.mapper import Mapper
from toolkit.monocular.sequence import MonocularSequence
from toolkit.rendering import map_device
from toolkit.runs.folder import RunFolder
from toolkit.runs.settings import RunSettings
from toolkit.semantics.factory import build_code
from toolkit.semantics.labeller import Labeller
from toolkit.slam import Slam
from toolkit.submaps.factory import build_atlas
from toolkit.taxonomy_building.factory import build_labeller
from toolkit.tracking.given import GivenPoses
from toolkit.tracking.guided import GuidedTracker
from toolkit.tracking.initial_velocity import initial_velocity
from toolkit.tracking.placement import KeyframePlacement
from toolkit.tracking.tracker import Tracker


def build_slam(
    dataset: Dataset | None = None,
    settings: RunSettings | None = None,
    folder: RunFolder | None = None,
    recorder: StageRecorder | None = None,
    correction: DepthCorrection | None = None,
) -> Slam:
    """Build the SLAM system that the settings describe.

    Args:
        dataset: the sequence to process, a `MonocularSequence` if `depth` is "none". It supplies
            class names, and the poses if they are given or monocular; None for frames of another
            source, such as a camera driver.
        settings: settings of the run; defaults if absent.
        folder: stores submaps and the loop log; without it, they stay in memory.
        recorder: measures the time of each stage.
        correction: gives frames the depth of priors, as that of a `MonocularSequence`.

    Raises:
        ToolkitError: the settings need something that the dataset or this machine lacks.
    """
    settings = settings or RunSettings()
    recorder = recorder or StageRecorder()
    # A map that is extended may have been loaded before the first frame.
    fixed = settings.depth == "none" or (dataset is None and settings.map is not None)
    unit = LengthUnit() if fixed else LengthUnit.of(dataset)
    labeller = build_run_labeller(settings, dataset)
    code = build_code(settings.semantics.code, labeller.taxonomy) if labeller else None
    # Centred colours are only valid for the dense tracker: the papers' tracker compares rendered
    # pixels directly, and given poses need no comparison.
    centred = settings.mapping.centred
    tracked = settings.poses == "slam" and settings.depth == "sensor"
    centred &= tracked and settings.tracking.kind == "dense"
    mapper = Mapper(
        replace(settings.mapping, centred=centred),
        np.random.default_rng(settings.seed),
        settings.backend,
        recorder,
        build_semantic_mapping(settings.semantics, code, settings.seed),
        map_device(settings.device, settings.backend),
    )
    # Without tracking, and in the papers' tracker, exposures are not estimated.
    dense = settings.tracking.kind == "dense" and settings.tracking.dense.exposure
    mapper.exposures.gains = settings.poses == "slam" and (dense or not tracked)
    atlas = build_atlas(settings.submaps, mapper, labeller, folder.submaps if folder else None)
    if tracked:
        tracker = build_tracker(settings.tracking, settings.backend, recorder, code)
        closer = None
        if settings.loops.use:
            taxonomy = labeller.taxonomy if labeller else None
            context = ClosingContext(settings.seed, settings.backend, mapper.semantics, taxonomy)
            log = None
            if folder is not None:
                # The unit may follow from the first frame, long before the first record.
                log = LoopLog(folder.loops, convert=lambda r: slam.unit.record_in_metres(r))
            closer = build_loop_closer(settings.loops, context, log, recorder)
        # The papers' tracker is a baseline, whose keyframe poses are not refined.
        use_placement = settings.tracking.kind == "dense" and settings.placement.use
        placement = KeyframePlacement(settings.placement) if use_placement else None
        slam = Slam(
            tracker,
            mapper,
            recorder,
            labeller,
            atlas,
            closer,
            settings.denoise,
            placement,
            start_velocity=_start_velocity(dataset, unit),
            unit=unit,
        )
        return slam
    poses, parts = _known_poses(dataset, settings, recorder, unit or LengthUnit())
    return Slam(
        poses,
        mapper,
        recorder,
        labeller,
        atlas,
        parts,
        denoise=settings.denoise,
        correction=correction,
        unit=unit,
    )


def _known_poses(
    dataset: Dataset | None, settings: RunSettings, recorder: StageRecorder, unit: LengthUnit
) -> tuple[Tracker, LoopClosing | None]:
    """The poses of the dataset, or of the motion of a sequence without depth and its parts."""
    if dataset is None or dataset.ground_truth is None:
        name = "this sequence" if dataset is None else dataset.name
        raise DatasetError(f"poses 'given' needs poses, but {name} has none; set poses to 'slam'")
    if settings.poses == "given":
        return GivenPoses(unit.trajectory(dataset.ground_truth)), None
    if not isinstance(dataset, MonocularSequence):
        return GuidedTracker([dataset.ground_truth], settings.backend, recorder), None
    tracker = GuidedTracker(dataset.trajectories, settings.backend, recorder)
    return tracker, GivenParts(dataset.part_of_keyframe)


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


def build_run_labeller(settings: RunSettings, dataset: Dataset | None) -> Labeller | None:
    """Build the labeller of a run's frames, None for a map without semantics.

    Raises:
        ToolkitError: the settings require labels that are not available.
    """
    names = dataset.label_names if dataset is not None else None
    stems = dataset.stems if isinstance(dataset, RecordedDataset) else None
    return build_labeller(settings.semantics, names, stems)
