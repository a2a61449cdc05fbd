"""`semsplat build-taxonomy`: build a taxonomy from class names, by rules or a language model."""

from __future__ import annotations

import logging
import math
import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from tqdm import tqdm

from toolkit.base.errors import DatasetError, DependencyError, FormatError, SettingsError
from toolkit.datasets.prefetch import prefetched
from toolkit.datasets.registry import describe, open_dataset
from toolkit.io.class_names import read_class_names
from toolkit.io.guarded.content import DamagedError
from toolkit.io.user_files import read_text
from toolkit.semantics.taxonomy import Taxonomy
from toolkit.semantics.taxonomy_building.builder import BuildOptions, build_taxonomy
from toolkit.semantics.taxonomy_building.grouper import Grouper, Grouping, Question
from toolkit.semantics.taxonomy_building.language_model.chat import ChatModel, NoModelError
from toolkit.semantics.taxonomy_building.language_model.endpoint import endpoint_from_environment
from toolkit.semantics.taxonomy_building.language_model.exchanges import (
    CachedModel,
    RecordingModel,
    ReplayedModel,
)
from toolkit.semantics.taxonomy_building.language_model.grouper import LanguageModelGrouper
from toolkit.semantics.taxonomy_building.measured_shapes import (
    LabelledScan,
    MeshShapes,
    ScanShapes,
    labelled_scan,
)
from toolkit.semantics.taxonomy_building.rules import RuleGrouper
from toolkit.semantics.taxonomy_building.shapes import ShapeProvider, read_shape_table
from toolkit.semantics.taxonomy_drawing import SUFFIXES as PICTURE_SUFFIXES
from toolkit.semantics.taxonomy_drawing import draw_taxonomy
from toolkit.semantics.taxonomy_text import tree_text
from toolkit.tools.cli.checks import check_output
from toolkit.tools.cli.programs import BuildTaxonomyOptions, DatasetChoice

logger = logging.getLogger(__name__)

# Options that need a language model.
_MODEL_OPTIONS = ("base_url", "model", "cache", "record", "replay", "fall_back")
_UP = {"y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}
# Maximum number of measured frames of a scan; more have little effect on the shape of a class.
_MAX_FRAMES = 100
_SUFFIXES = (".yaml", ".yml", ".json")
_MAX_LINES_BYTES = 2**24


def main(options: BuildTaxonomyOptions) -> int:
    """Build a taxonomy, write it and print it.

    Returns:
        0.

    Raises:
        ToolkitError: options contradict each other, class names are invalid, the shapes cannot be
            read, the language model is not available, or a file cannot be written.
    """
    _check(options)
    taxonomy = _build(_class_names(options), options)
    if options.review:
        print(tree_text(taxonomy))
    print(f"{taxonomy}; {_channel_counts(taxonomy)}")
    if options.out:
        taxonomy.save(options.out)
        print(f"wrote {options.out}")
    if options.picture:
        draw_taxonomy(taxonomy, options.picture)
        print(f"wrote {options.picture}")
    return 0


def _check(options: BuildTaxonomyOptions) -> None:
    if not (options.out or options.review or options.picture):
        raise SettingsError("give --out FILE.yaml to write the taxonomy, or --review to print it")
    for name, suffixes in (("out", _SUFFIXES), ("picture", PICTURE_SUFFIXES)):
        path = getattr(options, name)
        if path is not None:
            check_output(f"--{name}", path, suffixes)
    sources = (options.classes is not None) + (options.dataset.path is not None)
    if sources == 0 or (sources == 2 and options.shapes != ("scans",)):
        raise SettingsError("give either --classes FILE or --dataset.path FOLDER")
    given = [name for name in _MODEL_OPTIONS if getattr(options, name)]
    if options.grouper == "rules" and given:
        raise SettingsError(f"{_option(given[0])} requires --grouper language-model")
    others = [name for name in given if name not in ("replay", "record")]
    if options.replay and others:
        raise SettingsError(
            f"--replay reads all answers from a file; {_option(others[0])} cannot be used with it"
        )
    if not 0 <= options.seed < 2**32:
        raise SettingsError(f"--seed must be in [0, 2^32), got {options.seed}")
    if options.shapes == ("scans",) and options.dataset.path is None:
        raise SettingsError("--shapes scans needs labelled frames; give --dataset.path")


def _option(name: str) -> str:
    return f"--{name.replace('_', '-')}"


def _class_names(options: BuildTaxonomyOptions) -> list[str]:
    """Return the class names in the order of their ids or lines."""
    source = options.classes or options.dataset.path
    assert source is not None
    if options.classes and options.classes.suffix != ".json":
        classes = _lines(options.classes)
    else:
        if options.classes:
            names = read_class_names(options.classes)
        else:
            names = describe(options.dataset.kind, source).label_names or {}
            if not names:
                raise DatasetError(f"{source} has no labels/classes.json; give --classes FILE")
        classes = [names[number] for number in sorted(names)]
    try:
        Taxonomy.flat(classes)
    except FormatError as error:
        raise FormatError(f"{source}: {error}") from error
    return classes


def _lines(path: Path) -> list[str]:
    try:
        lines = read_text(path, _MAX_LINES_BYTES).splitlines()
    except OSError as error:
        raise DatasetError(f"cannot read {path}: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise DatasetError(f"{path} is not UTF-8 text; save it in this encoding") from error
    except DamagedError as error:
        raise DatasetError(f"cannot read {path}: {error}; give a file of names") from error
    return [line.strip() for line in lines if line.strip() and not line.startswith("#")]


def _build(classes: Sequence[str], options: BuildTaxonomyOptions) -> Taxonomy:
    name = options.out.stem if options.out else "taxonomy"
    shapes = _shapes(options)

    def build(grouper: Grouper) -> Taxonomy:
        return build_taxonomy(classes, grouper, shapes, BuildOptions(name=name), options.seed)

    if options.grouper == "rules":
        return build(RuleGrouper())
    try:
        with tqdm(unit="question", disable=None) as bar:
            return build(_CountingGrouper(LanguageModelGrouper(_model(options), options.seed), bar))
    except (NoModelError, DependencyError) as error:
        if not options.fall_back:
            raise
        logger.warning("%s; the taxonomy is built by rules instead", error)
        return build(RuleGrouper())


def _shapes(options: BuildTaxonomyOptions) -> ShapeProvider | None:
    match options.shapes:
        case ("table", path):
            return read_shape_table(path)
        case ("meshes", path):
            return MeshShapes(path, _UP[options.mesh_up])
        case ("scans",):
            return ScanShapes([_scan(options.dataset)])
    return None


def _scan(choice: DatasetChoice) -> LabelledScan:
    """Collect the labelled points of a dataset with ground-truth poses."""
    assert choice.path is not None
    dataset = open_dataset(choice.kind, choice.path)
    if dataset.ground_truth is None or not dataset.label_names:
        raise DatasetError(f"{choice.path}: --shapes scans needs labels and ground-truth poses")
    step = -(-len(dataset) // _MAX_FRAMES)
    frames = tqdm(
        prefetched(dataset, range(0, len(dataset), step)),
        total=-(-len(dataset) // step),
        unit="frame",
        disable=None,
    )
    posed = ((frame, dataset.ground_truth.at(frame.timestamp_s)) for frame in frames)
    views = ((frame, T) for frame, T in posed if T is not None)
    return labelled_scan(views, dataset.label_names)


def _model(options: BuildTaxonomyOptions) -> ChatModel:
    model: ChatModel
    if options.replay:
        model = ReplayedModel(options.replay)
    else:
        generator = np.random.default_rng(options.seed)
        model = endpoint_from_environment(options.base_url, options.model, generator, os.environ)
    if options.cache:
        model = CachedModel(model, options.cache)
    return RecordingModel(model, options.record) if options.record else model


class _CountingGrouper:
    """A grouper that counts questions in a progress bar, whose total is unknown."""

    def __init__(self, grouper: Grouper, bar: tqdm) -> None:
        self._grouper = grouper
        self._bar = bar

    def group(self, question: Question, complaint: str = "") -> Grouping:
        self._bar.update()
        return self._grouper.group(question, complaint)


def _channel_counts(taxonomy: Taxonomy) -> str:
    one_hot = sum(taxonomy.level_widths)
    binary = sum(math.ceil(math.log2(width)) for width in taxonomy.level_widths)
    return f"{one_hot} channels one-hot, {binary} binary"
