"""Taxonomy, code and labels from settings."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from toolkit.semantics.codes import (
    CodeOptions,
    ColourCode,
    SemanticCode,
    binary_code,
    flat_code,
    one_hot_code,
)
from toolkit.semantics.labeller import Labeller
from toolkit.semantics.palette import Palette
from toolkit.semantics.segmenters.recorded import RecordedLabels
from toolkit.semantics.taxonomy import Taxonomy
from toolkit.semantics.taxonomy_building.builder import build_taxonomy
from toolkit.semantics.taxonomy_building.rules import RuleGrouper
from toolkit.semantics.trees import taxonomy_for, taxonomy_named
from toolkit.settings.semantics import CodeSettings, SemanticsSettings

_HEADED = {"flat": flat_code, "one-hot": one_hot_code, "binary": binary_code}


def build_code(settings: CodeSettings, taxonomy: Taxonomy) -> SemanticCode | None:
    """The code that the settings describe, None for a map without semantics."""
    if settings.kind == "none":
        return None
    if settings.kind == "colour":
        palette = Palette(taxonomy).classes[1:].astype(np.float32) / 255.0
        return ColourCode(taxonomy, palette)
    options = CodeOptions(settings.start_confidence, settings.normalise)
    return _HEADED[settings.kind](taxonomy, options)


def choose_taxonomy(setting: str, names: Mapping[int, str]) -> Taxonomy:
    """The tree of a setting: a file, a shipped tree, or one that fits the class names.

    Raises:
        FormatError: neither a file with a valid tree nor a shipped one.
    """
    if setting != "auto":
        return taxonomy_named(setting)
    classes = [names[i] for i in sorted(names)]
    shipped = taxonomy_for(classes)
    if shipped is not None:
        return shipped
    return build_taxonomy(classes, RuleGrouper())


def build_labeller(settings: SemanticsSettings, names: Mapping[int, str] | None) -> Labeller | None:
    """Who labels the frames of a data set, None where nobody can.

    Args:
        names: class names of the data set's own labels, without void, or None.
    """
    if settings.code.kind == "none" or not names:
        return None
    segmenter = RecordedLabels(names)
    taxonomy = choose_taxonomy(settings.taxonomy, segmenter.class_names)
    ignored = [i for node in settings.ignore for i in taxonomy.find(node).class_ids]
    return Labeller(segmenter, taxonomy, ignored, "labels/classes.json")
