"""Masks from models of `transformers`, made on the spot with random weights."""

from __future__ import annotations

import json
import shutil
import sys
from types import SimpleNamespace

import numpy as np
import pytest
import tiny_mask_models
import torch
from panels import CAMERA, DISTANCE_M, keyframe

from toolkit.base.errors import DependencyError, FormatError, SettingsError
from toolkit.scene.instances.factory import build_instances
from toolkit.scene.instances.models.factory import model_masks
from toolkit.scene.instances.models.grounding_dino import box_mask
from toolkit.scene.instances.models.layers import layered
from toolkit.scene.instances.options import InstanceModelOptions, InstanceOptions
from toolkit.semantics.features.pretrained.preprocessing import ImagePreprocessing

pytest.importorskip("transformers")

KINDS = ("mask2former", "oneformer", "grounding_dino", "sam2")


@pytest.fixture(autouse=True)
def offline(monkeypatch):
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    """Folders of all models by kind."""
    place = tmp_path_factory.mktemp("models")
    return {kind: getattr(tiny_mask_models, f"save_{kind}")(place / kind) for kind in KINDS}


def source_of(folders, kind: str, **options):
    words = ("chair", "coffee table") if kind == "grounding_dino" else ()
    options = {"min_score": 0.0, "points": 4, "text": words, "device": "cpu"} | options
    return model_masks(folders[kind], InstanceModelOptions(folder=folders[kind], **options))


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_yields_masks_of_the_size_of_the_frame(folders, kind):
    masks = source_of(folders, kind).masks(keyframe(0))
    assert masks.ids.shape == (120, 160)
    assert set(np.unique(masks.ids)) - {0} == set(range(1, len(masks) + 1))
    again = source_of(folders, kind).masks(keyframe(0))
    np.testing.assert_array_equal(masks.ids, again.ids)


@pytest.mark.parametrize("kind", ["mask2former", "oneformer"])
def test_every_pixel_belongs_to_the_query_that_wins_it(folders, kind):
    source = source_of(folders, kind, min_score=0.6)
    logits = torch.full((1, 3, 4), -9.0)
    for query, label in enumerate((0, 1, 3)):  # 3 is no object
        logits[0, query, label] = 9.0
    left = torch.where(torch.arange(16) < 8, 9.0, -9.0).expand(1, 3, 12, 16).clone()
    left[0, 1] *= -1
    answer = SimpleNamespace(class_queries_logits=logits, masks_queries_logits=left)
    config = source._model.config
    source._model = lambda **_: answer
    assert config.num_labels == 3
    masks = source.masks(keyframe(0))
    assert masks.classes == ["chair", "table"]
    assert (masks.scores > 0.9).all()
    assert masks.ids[60, 20] == 1
    assert masks.ids[60, 140] == 2


def test_points_of_one_thing_make_one_mask(folders):
    source = source_of(folders, "sam2", min_score=0.5)
    halves = torch.where(torch.arange(16) < 8, 6.0, -6.0).expand(16, 16)

    def decoded(image_embeddings, input_points):
        left = input_points[0, :, 0, 0] < 32
        masks = torch.where(left[:, None, None], halves, -halves)
        # The second mask of each point has no clear border, the third one a low score.
        masks = torch.stack([masks, 0.1 * masks, masks], dim=1)[None]
        scores = torch.tensor([0.9, 0.9, 0.2]).expand(1, len(left), 3)
        return SimpleNamespace(pred_masks=masks, iou_scores=scores)

    decoded.get_image_embeddings = lambda pixels: [pixels]
    source._model = decoded
    masks = source.masks(keyframe(0))
    assert len(masks) == 2
    np.testing.assert_allclose(masks.scores, 0.9)
    assert masks.ids[0, 0] != masks.ids[0, -1]
    assert (masks.ids[:, :70] == masks.ids[0, 0]).all()


def test_boxes_have_the_words_that_they_show(folders):
    source = source_of(folders, "grounding_dino", min_score=0.5)
    chair, table = source._spans
    assert len(chair) == 1
    assert len(table) == 2
    logits = torch.full((1, 3, 32), -9.0)
    logits[0, 0, table[1]], logits[0, 1, chair[0]] = 2.0, 1.0
    boxes = torch.tensor([[[0.25, 0.5, 0.4, 0.5], [0.75, 0.5, 0.4, 0.5], [0.5, 0.5, 1, 1]]])
    answer = SimpleNamespace(logits=logits, pred_boxes=boxes)
    source._model = lambda **_: answer
    masks = source.masks(keyframe(0))
    assert sorted(masks.classes) == ["chair", "coffee table"]
    names = [masks.classes[masks.ids[60, column] - 1] for column in (40, 120)]
    assert names == ["coffee table", "chair"]


def test_a_box_is_the_surface_that_it_frames():
    depth_m = np.full((120, 160), 2 * DISTANCE_M, np.float32)
    depth_m[40:80, 50:110] = DISTANCE_M
    mask = box_mask(depth_m, np.array([45.0, 35.0, 115.0, 85.0]), CAMERA)
    inner = np.zeros_like(mask)
    inner[42:78, 52:108] = True
    assert mask[inner].all()
    assert not mask[depth_m > DISTANCE_M].any()
    assert not box_mask(np.zeros_like(depth_m), np.array([45.0, 35.0, 115.0, 85.0]), CAMERA).any()
    assert not box_mask(depth_m, np.array([-90.0, -90.0, -3.0, 500.0]), CAMERA).any()


def test_small_masks_lie_in_front_and_hidden_ones_are_left_out():
    large = np.ones((6, 8), bool)
    small = np.zeros((6, 8), bool)
    small[2:4, 2:4] = True
    masks = layered(
        [small, large, np.zeros((6, 8), bool)], [0.5, 1.2, 0.7], ["a", "b", "c"], (6, 8)
    )
    assert [masks.classes[masks.ids[3, 3] - 1], masks.classes[masks.ids[0, 0] - 1]] == ["a", "b"]
    assert len(masks) == 2
    assert masks.scores.max() == 1.0


@pytest.mark.parametrize(
    ("size", "shape"),
    [
        ({"height": 10, "width": 20}, (10, 20)),
        ({"shortest_edge": 30}, (30, 60)),
        ({"shortest_edge": 30, "longest_edge": 40}, (20, 40)),
        (None, (50, 100)),
    ],
)
def test_images_have_the_size_and_values_that_a_model_wants(tmp_path, size, shape):
    values = {"size": size, "image_mean": [0.5] * 3, "image_std": [0.25] * 3}
    (tmp_path / "processor_config.json").write_text(json.dumps({"image_processor": values}))
    rgb = torch.full((3, 50, 100), 255, dtype=torch.uint8)
    prepared = ImagePreprocessing.load(tmp_path).prepared(rgb)
    assert tuple(prepared.shape) == (1, 3, *shape)
    np.testing.assert_allclose(prepared.numpy(), 2.0, rtol=1e-5)


def build(**options):
    return build_instances(InstanceOptions("model", model=InstanceModelOptions(**options)))


def one_line(error: pytest.ExceptionInfo) -> str:
    assert "\n" not in str(error.value)
    return str(error.value)


@pytest.mark.parametrize("kind", KINDS)
def test_missing_files_of_a_processor_are_named(folders, tmp_path, kind):
    folder = shutil.copytree(folders[kind], tmp_path / kind)
    (folder / "preprocessor_config.json").unlink()
    words = ("chair",) if kind == "grounding_dino" else ()
    with pytest.raises(FormatError, match=r"has no preprocessor_config\.json") as caught:
        build(folder=folder, text=words)
    assert str(folder) in one_line(caught)
    if kind in ("oneformer", "grounding_dino"):
        shutil.copy(folders[kind] / "preprocessor_config.json", folder)
        for file in folder.glob("token*"):
            file.unlink()
        with pytest.raises(FormatError, match="contains no tokenizer"):
            build(folder=folder, text=words)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ('{"model_type": "bert"}', "contains a bert model"),
        ("{}", "names no model_type"),
        ("broken", "cannot be read"),
        (None, r"has no config\.json"),
    ],
)
def test_a_folder_of_something_else_is_refused(tmp_path, content, message):
    if content is not None:
        (tmp_path / "config.json").write_text(content)
    with pytest.raises(FormatError, match=message) as caught:
        build(folder=tmp_path)
    assert str(tmp_path) in one_line(caught)


def test_weights_of_another_model_are_refused(folders, tmp_path):
    folder = shutil.copytree(folders["sam2"], tmp_path / "mixed")
    shutil.copy(folders["mask2former"] / "config.json", folder)
    with pytest.raises(FormatError, match="lack") as caught:
        build(folder=folder)
    one_line(caught)


def test_options_that_do_not_fit_are_refused(folders):
    for options, message in (
        ({}, "needs --instances.model.folder DIR"),
        ({"folder": folders["grounding_dino"]}, "add --instances.model.text"),
        ({"folder": folders["grounding_dino"], "text": ("...",)}, "signs only"),
        ({"folder": folders["grounding_dino"], "text": ("chair",) * 40}, "reads 32 tokens"),
        ({"folder": folders["sam2"], "text": ("chair",)}, "text has no effect with a sam2"),
    ):
        with pytest.raises(SettingsError, match=message) as caught:
            build(**options)
        one_line(caught)
    unused = InstanceOptions("geometric", model=InstanceModelOptions(folder=folders["sam2"]))
    with pytest.raises(SettingsError, match=r"no effect with --instances\.kind geometric"):
        build_instances(unused)


def test_without_transformers_the_package_is_named(folders, monkeypatch):
    monkeypatch.setitem(sys.modules, "transformers", None)
    with pytest.raises(DependencyError, match="transformers cannot be loaded") as caught:
        build(folder=folders["sam2"])
    one_line(caught)


def test_an_old_transformers_is_named(folders, monkeypatch):
    old = SimpleNamespace(__version__="4.40.0")
    monkeypatch.setitem(sys.modules, "transformers", old)
    with pytest.raises(DependencyError, match=r"4\.40\.0 has no Sam2Model"):
        build(folder=folders["sam2"])
