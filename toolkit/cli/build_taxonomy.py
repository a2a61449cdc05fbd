"""`semsplat build-taxonomy`: sort class names into a tree, by rules or a language model."""

from __future__ import annotations

import logging
import math
import os
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from tqdm import tqdm

from toolkit.cli.arguments import parse_arguments
from toolkit.cli.programs import BuildTaxonomyOptions, DatasetChoice
from toolkit.datasets.prefetch import prefetched
from toolkit.datasets.registry import describe, open_dataset
from toolkit.errors import DatasetError, DependencyError, FormatError, SettingsError
from toolkit.io.class_names import read_class_names
from toolkit.semantics.taxonomy import Taxonomy
from toolkit.semantics.taxonomy_drawing import SUFFIXES as PICTURES
from toolkit.semantics.taxonomy_drawing import draw_taxonomy
from toolkit.semantics.taxonomy_text import tree_text
from toolkit.taxonomy_building.builder import BuildOptions, build_taxonomy
from toolkit.taxonomy_building.grouper import Grouper, Grouping, Question
from toolkit.taxonomy_building.language_model.chat import ChatModel, NoModelError
from toolkit.taxonomy_building.language_model.endpoint import endpoint_from_environment
from toolkit.taxonomy_building.language_model.exchanges import (
    CachedModel,
    RecordingModel,
    ReplayedModel,
)
from toolkit.taxonomy_building.language_model.grouper import LanguageModelGrouper
from toolkit.taxonomy_building.measured_shapes import (
    LabelledScan,
    MeshShapes,
    ScanShapes,
    labelled_scan,
)
from toolkit.taxonomy_building.rules import RuleGrouper
from toolkit.taxonomy_building.shapes import ShapeProvider, read_shape_table

logger = logging.getLogger(__name__)

_OF_A_MODEL = ("base_url", "model", "cache", "record", "replay", "fall_back")
_UP = {"y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}
# Frames of a scan that are measured; more hardly change a class's shape.
_MOST_FRAMES = 100
_SUFFIXES = (".yaml", ".yml", ".json")


def main(argv: Sequence[str]) -> int:
    """Build a tree, write it, print it.

    Returns:
        0.

    Raises:
        ToolkitError: options contradict each other, the names make no tree, the shapes or
            the model cannot be had, or the file cannot be written.
    """
    options = parse_arguments(BuildTaxonomyOptions, argv, "build-taxonomy")
    _check(options)
    taxonomy = _built(_class_names(options), options)
    if options.review:
        print(tree_text(taxonomy))
    print(f"{taxonomy}; {_channels(taxonomy)}")
    if options.out:
        taxonomy.save(options.out)
        print(f"wrote {options.out}")
    if options.picture:
        draw_taxonomy(taxonomy, options.picture)
        print(f"wrote {options.picture}")
    return 0


def _check(options: BuildTaxonomyOptions) -> None:
    if not (options.out or options.review or options.picture):
        raise SettingsError("give --out FILE.yaml to write the tree, or --review to see it")
    for name, suffixes in (("out", _SUFFIXES), ("picture", PICTURES)):
        path = getattr(options, name)
        if path and path.suffix not in suffixes:
            raise SettingsError(f"--{name} {path} must end in {', '.join(suffixes)}")
        if path and not path.parent.is_dir():
            raise SettingsError(f"--{name} {path}: there is no folder {path.parent}; make it")
    sources = (options.classes is not None) + (options.dataset.path is not None)
    if sources == 0 or (sources == 2 and options.shapes != ("scans",)):
        raise SettingsError("give --classes FILE or --dataset.path FOLDER, one of them")
    given = [name for name in _OF_A_MODEL if getattr(options, name)]
    if options.grouper == "rules" and given:
        raise SettingsError(f"{_option(given[0])} is of use with --grouper language-model alone")
    others = [name for name in given if name not in ("replay", "record")]
    if options.replay and others:
        raise SettingsError(f"--replay answers from its file; leave {_option(others[0])} out")
    if not 0 <= options.seed < 2**32:
        raise SettingsError(f"--seed must lie in [0, 2^32), got {options.seed}")
    if options.shapes == ("scans",) and options.dataset.path is None:
        raise SettingsError("--shapes scans measures labelled frames: give --dataset.path")


def _option(name: str) -> str:
    return f"--{name.replace('_', '-')}"


def _class_names(options: BuildTaxonomyOptions) -> list[str]:
    """Names in the order of their ids, or of their lines."""
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
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except OSError as error:
        raise DatasetError(f"cannot read {path}: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise DatasetError(f"{path} is no text in UTF-8; save it so") from error
    return [line.strip() for line in lines if line.strip() and not line.startswith("#")]


def _built(classes: Sequence[str], options: BuildTaxonomyOptions) -> Taxonomy:
    name = options.out.stem if options.out else "taxonomy"
    shapes = _shapes(options)

    def built(grouper: Grouper) -> Taxonomy:
        return build_taxonomy(classes, grouper, shapes, BuildOptions(name=name), options.seed)

    if options.grouper == "rules":
        return built(RuleGrouper())
    try:
        with tqdm(unit="question", file=sys.stderr, disable=not sys.stderr.isatty()) as bar:
            return built(_Counted(LanguageModelGrouper(_model(options), options.seed), bar))
    except (NoModelError, DependencyError) as error:
        if not options.fall_back:
            raise
        logger.warning("%s; the rules build the whole tree instead", error)
        return built(RuleGrouper())


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
    """What the labelled frames of a data set saw, from its true poses."""
    assert choice.path is not None
    dataset = open_dataset(choice.kind, choice.path)
    if dataset.ground_truth is None or not dataset.label_names:
        raise DatasetError(f"{choice.path}: --shapes scans needs labels and true poses")
    step = -(-len(dataset) // _MOST_FRAMES)
    frames = tqdm(
        prefetched(dataset, range(0, len(dataset), step)),
        total=-(-len(dataset) // step),
        unit="frame",
        file=sys.stderr,
        disable=not sys.stderr.isatty(),
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


class _Counted:
    """A grouper whose questions a progress bar counts; how many there will be nobody knows."""

    def __init__(self, grouper: Grouper, bar: tqdm) -> None:
        self._grouper = grouper
        self._bar = bar

    def group(self, question: Question, complaint: str = "") -> Grouping:
        self._bar.update()
        return self._grouper.group(question, complaint)


def _channels(taxonomy: Taxonomy) -> str:
    one_hot = sum(taxonomy.level_widths)
    binary = sum(math.ceil(math.log2(width)) for width in taxonomy.level_widths)
    return f"{one_hot} channels one-hot, {binary} binary"
