"""Build a SLAM system from the settings of a run."""

from __future__ import annotations

import numpy as np

from toolkit.closing.factory import ClosingContext, build_loop_closer
from toolkit.datasets.base import Dataset, RecordedDataset
from toolkit.errors import DatasetError
from toolkit.evaluation.timing import StageRecorder
from toolkit.loops.log import LoopLog
from toolkit.mapping.factory import build_mapper, build_semantic_mapping
from toolkit.registration.factory import build_placement
from toolkit.rendering import map_device
from toolkit.runs.folder import RunFolder
from toolkit.semantics.factory import build_code, build_labeller
from toolkit.semantics.labeller import Labeller
from toolkit.settings.run import RunSettings
from toolkit.slam import Slam
from toolkit.submaps.factory import build_atlas
from toolkit.tracking.factory import build_tracker
from toolkit.tracking.given import GivenPoses


def build_slam(
    settings: RunSettings, dataset: Dataset, watch: StageRecorder, folder: RunFolder | None = None
) -> Slam:
    """The system that the settings describe.

    Args:
        folder: where submaps rest and loops are written down; None keeps all in memory.
    """
    labeller = labeller_of(settings, dataset)
    code = build_code(settings.semantics.code, labeller.taxonomy) if labeller else None
    # The papers' tracker compares pixels as they are drawn; with given poses none compares any.
    centred = settings.mapping.centred
    centred &= settings.poses == "slam" and settings.tracking.kind == "dense"
    mapper = build_mapper(
        settings.mapping.model_copy(update={"centred": centred}),
        np.random.default_rng(settings.seed),
        settings.backend,
        watch,
        build_semantic_mapping(settings.semantics, code, settings.seed),
        map_device(settings.device, settings.backend),
    )
    atlas = build_atlas(settings.submaps, mapper, labeller, folder.submaps if folder else None)
    if settings.poses == "slam":
        tracker = build_tracker(settings.tracking, settings.backend, watch, code, centred)
        closer = None
        if settings.loops.use:
            taxonomy = labeller.taxonomy if labeller else None
            context = ClosingContext(
                settings.seed, settings.backend, mapper.semantics, taxonomy, centred
            )
            log = LoopLog(folder.loops) if folder else None
            closer = build_loop_closer(settings.loops, context, log, watch)
        # The papers' tracker is there to be compared with.
        dense = settings.tracking.kind == "dense"
        placement = build_placement(settings.placement) if dense else None
        return Slam(tracker, mapper, watch, labeller, atlas, closer, settings.denoise, placement)
    if dataset.ground_truth is None:
        raise DatasetError(
            f"--poses given needs poses, and {settings.dataset.path} has none; use --poses slam"
        )
    poses = GivenPoses(dataset.ground_truth)
    return Slam(poses, mapper, watch, labeller, atlas, denoise=settings.denoise)


def labeller_of(settings: RunSettings, dataset: Dataset) -> Labeller | None:
    """Who labels the frames of a data set, None for a map without semantics.

    Raises:
        ToolkitError: the settings ask for labels that cannot be had.
    """
    stems = dataset.stems if isinstance(dataset, RecordedDataset) else None
    return build_labeller(settings.semantics, dataset.label_names, stems)
