"""Build the labeller and the taxonomy from options."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence

from toolkit.base.errors import FormatError
from toolkit.base.geometry.image_sides import ImageSide
from toolkit.semantics.factory import build_segmenter
from toolkit.semantics.labeller import Labeller
from toolkit.semantics.lexicon.matching import selected_nodes
from toolkit.semantics.options import SegmenterOptions, SemanticsOptions
from toolkit.semantics.taxonomy import Taxonomy
from toolkit.semantics.taxonomy_building.builder import build_taxonomy
from toolkit.semantics.taxonomy_building.rules import RuleGrouper
from toolkit.semantics.trees import taxonomy_for, taxonomy_named

# Number of classes that an error lists.
_SHOWN = 8

_log = logging.getLogger(__name__)


def choose_taxonomy(setting: str, names: Mapping[int, str]) -> Taxonomy:
    """Return the taxonomy of an option, or for "auto" one that contains the classes.

    Args:
        setting: a YAML file, the name of a shipped tree, or "auto": the smallest shipped tree
            with all classes, or if there is none, a tree built by the rules.
        names: class names by id.

    Raises:
        FormatError: the setting is neither a file with a valid tree nor a shipped tree.
    """
    if setting != "auto":
        return taxonomy_named(setting)
    classes = [names[i] for i in sorted(names)]
    shipped = taxonomy_for(classes)
    return build_taxonomy(classes, RuleGrouper()) if shipped is None else shipped


def build_labeller(
    options: SemanticsOptions,
    source: SegmenterOptions,
    names: Mapping[int, str] | None,
    stems: Sequence[str] | None = None,
    unmatched: dict[str, FormatError] | None = None,
    side: ImageSide = "top",
) -> Labeller | None:
    """Build the labeller of a dataset's frames; None for a map without semantics.

    Args:
        options: options of semantics.
        source: source of the labels.
        names, stems, side: see `build_segmenter`.
        unmatched: receives the texts of `ignore` that mean no class, with the reasons; by default,
            they are errors.

    Raises:
        ToolkitError: see `build_segmenter` and `choose_taxonomy`; or the tree lacks a class, or a
            name of `ignore` means none of them.
    """
    if options.code.kind == "none" or source.kind == "none":
        return None
    segmenter = build_segmenter(source, names, stems, side)
    taxonomy = choose_taxonomy(options.taxonomy, segmenter.class_names)
    ignored = _ignored_classes(options.ignore, taxonomy, unmatched)
    return Labeller(segmenter, taxonomy, ignored, f"{source.kind} labels")


def _ignored_classes(
    names: Sequence[str], taxonomy: Taxonomy, unmatched: dict[str, FormatError] | None
) -> list[int]:
    """Return the ids of the classes that names and nouns of --semantics.ignore mean."""
    shown = ", ".join(taxonomy.classes[:_SHOWN])
    more = f" and {len(taxonomy) - _SHOWN} more" if len(taxonomy) > _SHOWN else ""
    nodes = []
    for name in names:
        try:
            nodes += selected_nodes([name], taxonomy, f"its classes are {shown}{more}")
        except FormatError as error:
            if unmatched is None:
                raise
            unmatched[name] = error
    if nodes:
        _log.info("Not tracked against or mapped: %s.", ", ".join(node.name for node in nodes))
    return [i for node in nodes for i in node.class_ids]
