"""Which segmenter the settings make."""

from __future__ import annotations

import json

import numpy as np
import pytest

from toolkit.base.errors import DatasetError, FormatError, SettingsError
from toolkit.base.options import validated
from toolkit.io.images import write_png
from toolkit.semantics.factory import build_segmenter
from toolkit.semantics.options import SegmenterOptions
from toolkit.semantics.segmenters.dataset_labels import RecordedLabels
from toolkit.semantics.segmenters.geometric import CLASS_NAMES, GeometricSegmenter
from toolkit.semantics.segmenters.image_folder import LabelImageFolder
from toolkit.semantics.segmenters.indoor.classes import INDOOR_CLASSES
from toolkit.semantics.segmenters.indoor.segmenter import IndoorSegmenter
from toolkit.semantics.segmenters.segmenter import Unlabelled


def settings(**values) -> SegmenterOptions:
    return validated(SegmenterOptions, values)


def test_auto_takes_the_data_sets_labels_or_else_the_network_for_rooms():
    recorded = build_segmenter(settings(), {1: "wall"})
    assert isinstance(recorded, RecordedLabels)
    assert recorded.class_names == {1: "wall"}
    for names in (None, {}):
        indoor = build_segmenter(settings(), names)
        assert isinstance(indoor, IndoorSegmenter)
        assert tuple(indoor.class_names.values())[:-1] == INDOOR_CLASSES


def test_geometry_is_a_choice():
    geometric = build_segmenter(settings(kind="geometric"), {1: "wall"})
    assert isinstance(geometric, GeometricSegmenter)
    assert geometric.class_names == CLASS_NAMES


def test_none_is_a_segmenter_without_classes():
    segmenter = build_segmenter(settings(kind="none"), {1: "wall"})
    assert isinstance(segmenter, Unlabelled)
    assert segmenter.class_names == {}


def test_images_pair_as_the_settings_say(tmp_path):
    write_png(tmp_path / "0.png", np.ones((4, 4), np.uint8))
    (tmp_path / "classes.json").write_text(json.dumps({"classes": {"1": "wall"}}))
    images = {"folder": tmp_path, "pairing": "number"}
    made = build_segmenter(settings(kind="images", images=images), None)
    assert isinstance(made, LabelImageFolder)
    images["pairing"] = "stem"
    with pytest.raises(SettingsError, match="pairing number"):
        build_segmenter(settings(kind="images", images=images), None)
    with pytest.raises(DatasetError, match="expected for instance frame7"):
        build_segmenter(settings(kind="images", images=images), None, ["frame7"])


@pytest.mark.parametrize(
    ("values", "error", "named"),
    [
        ({"kind": "recorded"}, DatasetError, "no labels with names"),
        ({"kind": "images"}, SettingsError, "--segmenter.images.folder"),
        ({"kind": "model"}, SettingsError, "--segmenter.model.folder"),
        ({"kind": "model", "model": {"folder": "nowhere"}}, FormatError, "nowhere has no config"),
        (
            {"kind": "model", "model": {"folder": "nowhere", "head": "h.safetensors"}},
            FormatError,
            "h.safetensors does not exist",
        ),
        (
            {"kind": "geometric", "geometric": {"camera_height_m": (3.0, 2.5)}},
            SettingsError,
            "must be a minimum and a larger maximum, got 3 2.5",
        ),
    ],
)
def test_what_is_missing_is_named(values, error, named):
    with pytest.raises(error, match=named):
        build_segmenter(settings(**values), None)


@pytest.mark.parametrize(
    "values",
    [
        {"kind": "magic"},
        {"images": {"gaps": 1.5}},
        {"geometric": {"columns": 160}},
    ],
)
def test_unknown_keys_and_values_out_of_range_are_errors(values):
    with pytest.raises(SettingsError, match="option"):
        settings(**values)
