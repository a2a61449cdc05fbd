"""Build a SLAM system from the settings of a run."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from toolkit.base.errors import FormatError, SettingsError
from toolkit.datasets.base import Dataset, RecordedDataset
from toolkit.depth.depth_priors.correction import DepthCorrection
from toolkit.runs.allocator import reuse_freed_memory
from toolkit.runs.evaluation.timing import StageRecorder
from toolkit.runs.folder import RunFolder
from toolkit.runs.image_side import up_side
from toolkit.runs.modes import FrontEndParts, mode_of
from toolkit.runs.settings import RunSettings
from toolkit.scene.growing.listener import SceneListener
from toolkit.scene.instances.factory import build_instances, may_ignore_masks
from toolkit.scene.instances.ignoring import IgnoredMasks, IgnoredTexts
from toolkit.scene.instances.listener import InstanceListener
from toolkit.scene.instances.tracking import InstanceTracker
from toolkit.semantics.factory import build_code
from toolkit.semantics.features.factory import build_differentiable_describer
from toolkit.semantics.features.sources import ViewDescriber
from toolkit.semantics.labeller import Labeller
from toolkit.semantics.taxonomy import Taxonomy
from toolkit.semantics.taxonomy_building.factory import build_labeller
from toolkit.slam.frame_preparation import FrameSources
from toolkit.slam.listeners import MapListener
from toolkit.slam.loops.closing.factory import ClosingContext
from toolkit.slam.mapping.mapper import Mapper
from toolkit.slam.mapping.semantic_mapping import build_semantic_mapping
from toolkit.slam.submaps.factory import build_atlas
from toolkit.slam.system import Slam
from toolkit.splatting.rendering import map_device


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
    reuse_freed_memory()
    settings = settings or RunSettings()
    recorder = recorder or StageRecorder()
    labels = _build_labels(settings, dataset)
    labeller, instances = labels.labeller, labels.instances
    taxonomy = labeller.taxonomy if labeller else None
    code = build_code(settings.semantics.code, taxonomy) if taxonomy else None
    semantics = build_semantic_mapping(settings.semantics, code, settings.seed)
    front_end = mode_of(settings).front_end(
        FrontEndParts(
            settings,
            dataset,
            recorder,
            ClosingContext(settings.seed, settings.backend, semantics, taxonomy, instances),
            code,
            folder,
            # The unit may follow from the first frame, long before the first record.
            lambda record: slam.unit.record_in_metres(record),
            correction,
        )
    )
    tracker = front_end.tracker
    mapper = Mapper(
        replace(settings.mapping, centred=settings.mapping.centred and tracker.centred),
        np.random.default_rng(settings.seed),
        settings.backend,
        recorder,
        semantics,
        map_device(settings.device, settings.backend),
        gains=tracker.gains,
        describer=refinement_describer(settings),
    )
    submaps = folder.submaps if folder else None
    atlas = build_atlas(settings.submaps, mapper.first_submap(), labeller, submaps)
    sources = _frame_sources(settings, labels)
    # A dataset ignores what moves with the camera itself.
    watches = dataset is None and settings.dataset.ignore_carrier
    sources = replace(sources, watches_carrier=watches)
    listeners = _build_listeners(settings, taxonomy, instances, recorder)
    slam = Slam(front_end, mapper, atlas, sources, recorder, listeners)
    slam.up_side = up_side(settings.dataset)
    return slam


def _build_listeners(
    settings: RunSettings,
    taxonomy: Taxonomy | None,
    instances: InstanceTracker | None,
    recorder: StageRecorder,
) -> list[MapListener]:
    """What follows the keyframes of a run: its objects, and the graph of its scene."""
    listeners: list[MapListener] = []
    if instances is not None:
        listeners.append(InstanceListener(instances, recorder))
    if settings.scene.graph:
        if taxonomy is None:
            raise SettingsError(
                "--scene.graph needs class labels: use a dataset with label images, or add a "
                "segmenter with --segmenter.kind"
            )
        # A continued map keeps its objects without masks, which new keyframes do not extend.
        tracker = instances if instances is not None and instances.source is not None else None
        listeners.append(SceneListener(taxonomy, tracker, recorder))
    return listeners


def refinement_describer(settings: RunSettings) -> ViewDescriber | None:
    """What computes the features that the final refinement compares; None if it compares none.

    Raises:
        ToolkitError: the encoder's weights are missing.
    """
    if settings.mapping.final_feature == 0:
        return None
    return build_differentiable_describer(settings.loops.features)


def build_run_labeller(
    settings: RunSettings,
    dataset: Dataset | None,
    unmatched: dict[str, FormatError] | None = None,
) -> Labeller | None:
    """Build the labeller of a run's frames, None for a map without semantics.

    Args:
        settings: of the run.
        dataset: its sequence; None for frames of another source.
        unmatched: receives the texts of --semantics.ignore that mean no class of the labels, with
            the reasons, if they may mean masks.

    Raises:
        ToolkitError: the settings require labels that are not available.
    """
    names = dataset.label_names if dataset is not None else None
    stems = dataset.stems if isinstance(dataset, RecordedDataset) else None
    if may_ignore_masks(settings.instances):
        unmatched = {} if unmatched is None else unmatched
    else:
        unmatched = None
    side = up_side(settings.dataset)
    return build_labeller(settings.semantics, settings.segmenter, names, stems, unmatched, side)


@dataclass(frozen=True)
class _Labels:
    """What labels the frames of a run, and what tracks its objects; None without."""

    labeller: Labeller | None
    instances: InstanceTracker | None


def _build_labels(settings: RunSettings, dataset: Dataset | None) -> _Labels:
    unmatched: dict[str, FormatError] = {}
    labeller = build_run_labeller(settings, dataset, unmatched)
    names = None if labeller is None else dict(enumerate(labeller.taxonomy.classes, start=1))
    stems = dataset.stems if isinstance(dataset, RecordedDataset) else None
    continues = settings.map is not None
    ignored = _ignored_texts(settings, labeller, unmatched)
    instances = build_instances(settings.instances, names, stems, continues, ignored)
    return _Labels(labeller, instances)


def build_frame_sources(settings: RunSettings, dataset: Dataset) -> FrameSources:
    """Build what frames of a dataset are prepared with.

    Raises:
        ToolkitError: the settings require labels or masks that are not available.
    """
    return _frame_sources(settings, _build_labels(settings, dataset))


def _frame_sources(settings: RunSettings, labels: _Labels) -> FrameSources:
    labeller, instances = labels.labeller, labels.instances
    masks = None if instances is None else instances.source
    if not isinstance(masks, IgnoredMasks):
        return FrameSources(labeller, settings.denoise)
    if labeller is None:
        return FrameSources(None, settings.denoise, masks)
    labeller.others = masks
    return FrameSources(labeller, settings.denoise)


def _ignored_texts(
    settings: RunSettings, labeller: Labeller | None, unmatched: dict[str, FormatError]
) -> IgnoredTexts:
    texts = settings.semantics.ignore
    if labeller is None:
        unmatched = {t: FormatError(f"the run has no labels with a class '{t}'") for t in texts}
        return IgnoredTexts(texts, unmatched=unmatched)
    return IgnoredTexts(texts, labeller.ignored_classes, labeller.taxonomy, unmatched)
