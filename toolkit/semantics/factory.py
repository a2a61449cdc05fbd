"""Build the segmenter and the semantic code from options."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from toolkit.base.errors import DatasetError, SettingsError
from toolkit.base.geometry.image_sides import ImageSide
from toolkit.semantics.codes import ColourCode, SemanticCode, binary_code, flat_code, one_hot_code
from toolkit.semantics.options import (
    CodeOptions,
    GeometricOptions,
    LabelImageOptions,
    SegmenterOptions,
)
from toolkit.semantics.palette import Palette
from toolkit.semantics.segmenters.dataset_labels import RecordedLabels
from toolkit.semantics.segmenters.geometric import GeometricSegmenter
from toolkit.semantics.segmenters.image_folder import LabelImageFolder
from toolkit.semantics.segmenters.indoor.encoder import IndoorEncoder
from toolkit.semantics.segmenters.indoor.segmenter import IndoorSegmenter
from toolkit.semantics.segmenters.segmenter import Segmenter, Unlabelled
from toolkit.semantics.taxonomy import Taxonomy

# Minimum probability of a class that a model predicts; pixels below it are unlabelled.
_MIN_CONFIDENCE = 0.5
_HEADED = {"flat": flat_code, "one-hot": one_hot_code, "binary": binary_code}


def build_code(options: CodeOptions, taxonomy: Taxonomy) -> SemanticCode | None:
    """Build the semantic code; None for a map without semantics.

    Raises:
        SettingsError: the colour code is to start at random values.
    """
    if options.kind == "none":
        return None
    if options.kind == "colour":
        if options.start == "random":
            raise SettingsError(
                "semantics.code.start random is not supported by the colour code; "
                "set semantics.code.start to labels"
            )
        palette = Palette(taxonomy).classes[1:].astype(np.float32) / 255.0
        return ColourCode(taxonomy, palette)
    return _HEADED[options.kind](taxonomy, options)


def build_segmenter(
    options: SegmenterOptions,
    label_names: Mapping[int, str] | None,
    stems: Sequence[str] | None = None,
    side: ImageSide = "top",
) -> Segmenter:
    """Build the segmenter.

    Args:
        label_names: the dataset's class names by id, or None if it has no labels.
        stems: file names of the frames' images without suffix, by frame index; required to
            assign label images by stem.
        side: the side of the images that is up, for labels from depth alone.

    Raises:
        SettingsError: a path required by this kind of segmenter is not set.
        DatasetError: the dataset or the folder of label images is incomplete.
        DependencyError: transformers cannot be loaded.
        FormatError: the folder of a model is invalid.
    """
    kind = options.kind
    if kind == "auto":
        kind = "recorded" if label_names else "indoor"
    if kind == "recorded":
        if not label_names:
            raise DatasetError(
                "the dataset has no labels with names; choose another --segmenter.kind"
            )
        return RecordedLabels(label_names)
    if kind == "images":
        return _label_images(options.images, stems)
    if kind == "model":
        return _model(options, side)
    if kind == "none":
        return Unlabelled()
    _check_heights(options.geometric)
    of_depth = GeometricSegmenter if kind == "geometric" else IndoorSegmenter
    return of_depth(options.geometric, side)


def _check_heights(options: GeometricOptions) -> None:
    lowest_m, highest_m = options.camera_height_m
    if lowest_m >= highest_m:
        raise SettingsError(
            "segmenter.geometric.camera_height_m must be a minimum and a larger maximum, "
            f"got {lowest_m:g} {highest_m:g}"
        )


def _label_images(options: LabelImageOptions, stems: Sequence[str] | None) -> Segmenter:
    if options.folder is None:
        raise SettingsError("--segmenter.kind images needs --segmenter.images.folder DIR")
    if options.pairing == "number":
        return LabelImageFolder(options.folder, None, options.gaps)
    if stems is None:
        raise SettingsError(
            "these frames have no file names; set --segmenter.images.pairing number"
        )
    return LabelImageFolder(options.folder, stems, options.gaps)


def _model(options: SegmenterOptions, side: ImageSide) -> Segmenter:
    folder, file = options.model.folder, options.model.head
    # Imported on demand: torch and transformers take seconds to load.
    from toolkit.semantics.segmenters.linear_head import HeadSegmenter, LinearHead
    from toolkit.semantics.segmenters.patch_features import PatchEncoder
    from toolkit.semantics.segmenters.transformers_models import TransformersSegmenter

    if file is not None:
        head = LinearHead.load(file)
        if folder is not None:
            return HeadSegmenter(PatchEncoder(folder, head.longest_side), head, _MIN_CONFIDENCE)
        _check_heights(options.geometric)
        return HeadSegmenter(IndoorEncoder(options.geometric, side), head, _MIN_CONFIDENCE)
    if folder is None:
        raise SettingsError(
            "--segmenter.kind model needs --segmenter.model.folder DIR, or --segmenter.model.head "
            "FILE of a head that semsplat train-head has trained without --model"
        )
    return TransformersSegmenter(folder, _MIN_CONFIDENCE)
