"""Build the labeller and the taxonomy from options."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from toolkit.semantics.factory import build_segmenter
from toolkit.semantics.labeller import Labeller
from toolkit.semantics.options import SegmenterOptions, SemanticsOptions
from toolkit.semantics.taxonomy import Taxonomy
from toolkit.semantics.trees import taxonomy_for, taxonomy_named
from toolkit.taxonomy_building.builder import build_taxonomy
from toolkit.taxonomy_building.rules import RuleGrouper


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
) -> Labeller | None:
    """Build the labeller of a dataset's frames; None for a map without semantics.

    Args:
        options: options of semantics.
        source: source of the labels.
        names, stems: see `build_segmenter`.

    Raises:
        ToolkitError: see `build_segmenter` and `choose_taxonomy`; or the tree lacks a class.
    """
    if options.code.kind == "none" or source.kind == "none":
        return None
    segmenter = build_segmenter(source, names, stems)
    taxonomy = choose_taxonomy(options.taxonomy, segmenter.class_names)
    ignored = [i for node in options.ignore for i in taxonomy.find(node).class_ids]
    return Labeller(segmenter, taxonomy, ignored, f"{source.kind} labels")
