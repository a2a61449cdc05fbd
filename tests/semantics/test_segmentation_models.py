"""Models from a folder, made on the spot with random weights: no network, no downloads."""

from __future__ import annotations

import json
import shutil
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from toolkit.base.errors import DatasetError, DependencyError, FormatError
from toolkit.base.frame import Frame
from toolkit.base.geometry.camera import Camera
from toolkit.semantics.features.pretrained import loading as pretrained
from toolkit.semantics.segmenters.head_training import (
    HeadTrainingOptions,
    _fit,
    _patch_labels,
    score_head,
    train_head,
)
from toolkit.semantics.segmenters.linear_head import HeadSegmenter, LinearHead
from toolkit.semantics.segmenters.patch_features import PatchEncoder
from toolkit.semantics.segmenters.transformers_models import (
    TransformersSegmenter,
    confident_labels,
)

transformers = pytest.importorskip("transformers")

WIDTH, HEIGHT = 64, 48
CAMERA = Camera(60.0, 60.0, 31.5, 23.5, WIDTH, HEIGHT)
COLOURS = np.array([[0.9, 0.1, 0.1], [0.1, 0.9, 0.1], [0.1, 0.1, 0.9]])
NAMES = {3: "red", 5: "green", 9: "blue"}


@pytest.fixture(autouse=True)
def offline(monkeypatch):
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")


def coloured_frame(index: int) -> Frame:
    """Blocks of three colours, labelled by colour, with a void border on the left."""
    generator = np.random.default_rng(index)
    blocks = generator.integers(0, 3, (6, 8)).repeat(8, axis=0).repeat(8, axis=1)
    rgb = COLOURS[blocks] + generator.normal(0, 0.02, (HEIGHT, WIDTH, 3))
    labels = np.array([3, 5, 9], np.int32)[blocks]
    labels[:, :4] = 0
    depth = np.ones((HEIGHT, WIDTH), np.float32)
    return Frame(index, index / 30.0, rgb.clip(0, 1).astype(np.float32), depth, CAMERA, labels)


@pytest.fixture(scope="module")
def segformer(tmp_path_factory) -> Path:
    """A tiny SegFormer with three classes, one of them its void."""
    folder = tmp_path_factory.mktemp("models") / "segformer"
    torch.manual_seed(0)
    config = transformers.SegformerConfig(
        depths=[1, 1, 1, 1],
        hidden_sizes=[8, 8, 16, 16],
        num_attention_heads=[1, 1, 2, 2],
        decoder_hidden_size=16,
        id2label={0: "wall", 1: "Void", 2: "chair"},
        label2id={"wall": 0, "Void": 1, "chair": 2},
    )
    transformers.SegformerForSemanticSegmentation(config).save_pretrained(folder)
    processor = {
        "image_processor_type": "SegformerImageProcessor",
        "do_resize": True,
        "size": {"height": 64, "width": 64},
        "do_normalize": True,
        "image_mean": [0.5, 0.5, 0.5],
        "image_std": [0.5, 0.5, 0.5],
    }
    (folder / "preprocessor_config.json").write_text(json.dumps(processor))
    return folder


@pytest.fixture
def broken(tmp_path):
    """A copy of a model's folder, to be broken."""

    def copy(folder: Path) -> Path:
        return Path(shutil.copytree(folder, tmp_path / folder.name))

    return copy


def test_a_model_labels_every_pixel_with_its_own_names(segformer):
    segmenter = TransformersSegmenter(segformer, device="cpu")
    assert segmenter.class_names == {1: "wall", 3: "chair"}
    labels = segmenter.segment(coloured_frame(0))
    assert labels.shape == (HEIGHT, WIDTH)
    assert labels.dtype == np.int32
    assert set(np.unique(labels)) <= {0, 1, 3}
    np.testing.assert_array_equal(segmenter.segment(coloured_frame(0)), labels)


def test_its_labels_are_those_of_the_library(segformer):
    frame = coloured_frame(1)
    model = transformers.AutoModelForSemanticSegmentation.from_pretrained(segformer)
    processor = transformers.AutoImageProcessor.from_pretrained(segformer, backend="pil")
    image = np.rint(frame.rgb * 255).astype(np.uint8)
    with torch.no_grad():
        output = model(**processor(image, return_tensors="pt"))
    (expected,) = processor.post_process_semantic_segmentation(output, [(HEIGHT, WIDTH)])
    expected = (expected + 1).numpy()
    expected[expected == 2] = 0
    found = TransformersSegmenter(segformer, device="cpu").segment(frame)
    np.testing.assert_array_equal(found, expected)


def test_what_the_model_is_unsure_of_is_void(segformer):
    frame = coloured_frame(0)
    assert not TransformersSegmenter(segformer, 0.999, "cpu").segment(frame).any()


def test_confidence_is_the_probability_of_the_best_class():
    logits = torch.log(torch.tensor([0.7, 0.3])).view(1, 2, 1, 1)
    assert confident_labels(logits, (2, 2), 0.69).tolist() == [[1, 1], [1, 1]]
    assert confident_labels(logits, (2, 2), 0.71).tolist() == [[0, 0], [0, 0]]


def test_cropping_by_a_processor_is_disabled(segformer, broken):
    folder = broken(segformer)
    file = folder / "preprocessor_config.json"
    cropping = {
        "image_processor_type": "MobileViTImageProcessor",
        "do_center_crop": True,
        "crop_size": {"height": 32, "width": 32},
        "size": {"shortest_edge": 48},
    }
    file.write_text(json.dumps(cropping))
    # A scene in one half: were the crop stretched over the frame, its border would move.
    segmenter = TransformersSegmenter(folder, device="cpu")
    sizes = []
    prepare = segmenter._processor
    segmenter._processor = lambda *a, **k: sizes.append(prepare(*a, **k)) or sizes[-1]
    segmenter.segment(coloured_frame(0))
    assert tuple(sizes[0]["pixel_values"].shape[-2:]) == (48, 64)


@pytest.mark.parametrize(
    ("make", "named"),
    [
        (lambda folder: (folder / "config.json").unlink(), "has no config.json"),
        (lambda folder: (folder / "config.json").write_text("{"), "contains no model"),
        (lambda folder: (folder / "model.safetensors").unlink(), "contains no model"),
        (
            lambda folder: (folder / "model.safetensors").write_bytes(
                (folder / "model.safetensors").read_bytes()[:5000]
            ),
            "contains no model",
        ),
        (lambda folder: (folder / "preprocessor_config.json").unlink(), "contains no image proc"),
    ],
)
def test_a_broken_folder_is_one_line(segformer, broken, make, named):
    folder = broken(segformer)
    make(folder)
    with pytest.raises(FormatError, match=named) as error:
        TransformersSegmenter(folder, device="cpu")
    assert str(folder) in str(error.value)
    assert "\n" not in str(error.value)


def test_weights_of_another_model_are_refused(segformer, tiny_dinov2, broken):
    with pytest.raises(FormatError, match="contains no model for AutoModelForSemanticSegmentation"):
        TransformersSegmenter(tiny_dinov2, device="cpu")
    # A head that was never trained would label at random, without a word.
    folder = broken(segformer)
    model = transformers.AutoModelForSemanticSegmentation.from_pretrained(segformer)
    weights = {k: v for k, v in model.state_dict().items() if "classifier" not in k}
    model.save_pretrained(folder, state_dict=weights)
    with pytest.raises(FormatError, match=r"the weights lack decode_head\.classifier"):
        TransformersSegmenter(folder, device="cpu")


def test_a_missing_library_names_its_remedy(segformer, monkeypatch):
    monkeypatch.setitem(sys.modules, "transformers", None)
    with pytest.raises(DependencyError, match=r"pip install 'semsplat\[semantics\]'"):
        TransformersSegmenter(segformer, device="cpu")


def test_a_device_that_is_not_there_is_named(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(DependencyError, match="choose device cpu"):
        pretrained.device_of("cuda")
    assert pretrained.device_of("auto").type == "cpu"


def test_features_cover_the_whole_image_patch_by_patch(tiny_dinov2):
    encoder = PatchEncoder(tiny_dinov2, 64, "cpu")
    assert encoder.features(coloured_frame(0)).shape == (6, 8, 16)
    large = PatchEncoder(tiny_dinov2, 128, "cpu")
    assert large.features(coloured_frame(0)).shape == (12, 16, 16)
    small = PatchEncoder(tiny_dinov2, 32, "cpu")
    assert small.features(coloured_frame(0)).shape == (3, 4, 16)


def test_a_change_of_one_patch_shows_most_in_its_own_features(tiny_dinov2):
    encoder = PatchEncoder(tiny_dinov2, 64, "cpu")
    rgb = np.full((HEIGHT, WIDTH, 3), 0.5, np.float32)
    changed = rgb.copy()
    changed[16:24, 40:48] = COLOURS[0]
    frame = coloured_frame(0)
    before, after = (encoder.features(replace(frame, rgb=image)) for image in (rgb, changed))
    difference = (after - before).norm(dim=-1)
    assert np.unravel_index(int(difference.argmax()), (6, 8)) == (2, 5)


def test_an_encoder_without_patches_is_refused(segformer):
    with pytest.raises(FormatError, match="segformer model has no fixed patch size"):
        PatchEncoder(segformer, device="cpu")


def test_a_patchs_target_is_the_mix_of_its_labels():
    labels = np.array([[1, 1, 0, 0], [1, 2, 0, 0]], np.int32)
    mix = _patch_labels(labels, np.array([1, 2]), (1, 2))
    np.testing.assert_allclose(mix, [[[0.75, 0.25], [0.0, 0.0]]])


def test_a_fit_does_not_mind_features_of_very_different_scale():
    generator = np.random.default_rng(0)
    classes = generator.integers(0, 3, 600)
    features = np.eye(3)[classes] + 0.1 * generator.normal(size=(600, 3))
    features = features * [1e-2, 1.0, 1e3] + [5.0, 0.0, -2e3]
    weights, bias = _fit(
        torch.tensor(features, dtype=torch.float32),
        torch.tensor(np.eye(3)[classes], dtype=torch.float32),
        HeadTrainingOptions(),
    )
    found = (torch.tensor(features, dtype=torch.float32) @ weights.T + bias).argmax(dim=1)
    assert (found.numpy() == classes).mean() > 0.99


@pytest.fixture(scope="module")
def trained(tiny_dinov2):
    """A head trained on six frames, and its encoder."""
    encoder = PatchEncoder(tiny_dinov2, 64, "cpu")
    frames = [coloured_frame(i) for i in range(6)]
    generator = np.random.default_rng(0)
    return encoder, train_head(encoder, frames, NAMES | {11: "never seen"}, generator)


def test_a_head_learns_what_features_distinguish(trained):
    encoder, head = trained
    assert head.class_names == ("red", "green", "blue")
    score = score_head(encoder, head, [coloured_frame(i) for i in (20, 21)], NAMES)
    assert score.frames == 2
    # Patches are blocks of one colour; only the enlarged borders between them blur.
    assert score.accuracy > 0.9
    assert score.mean_iou > 0.8


def test_training_is_reproducible(trained, tiny_dinov2):
    encoder, head = trained
    frames = [coloured_frame(i) for i in range(6)]
    again = train_head(encoder, frames, NAMES, np.random.default_rng(0))
    assert torch.equal(again.weights, head.weights)


def test_a_saved_head_labels_as_before(trained, tmp_path):
    encoder, head = trained
    head.save(tmp_path / "head.safetensors")
    loaded = LinearHead.load(tmp_path / "head.safetensors")
    assert (loaded.class_names, loaded.longest_side) == (head.class_names, 64)
    frame = coloured_frame(30)
    np.testing.assert_array_equal(
        HeadSegmenter(encoder, loaded).segment(frame), HeadSegmenter(encoder, head).segment(frame)
    )
    assert not HeadSegmenter(encoder, loaded, min_confidence=1.0).segment(frame).all()


def test_a_head_of_another_encoder_is_refused(trained, tiny_dinov2, broken):
    _, head = trained
    folder = broken(tiny_dinov2)
    model = transformers.AutoModel.from_pretrained(folder)
    with torch.no_grad():
        model.layernorm.bias[0] += 1.0
    model.save_pretrained(folder)
    with pytest.raises(FormatError, match="trained on another encoder"):
        HeadSegmenter(PatchEncoder(folder, 64, "cpu"), head)


def test_a_head_keeps_the_size_it_was_trained_at(trained, tiny_dinov2):
    _, head = trained
    assert head.longest_side == 64
    with pytest.raises(ValueError, match="must be 64 pixels, got 128"):
        HeadSegmenter(PatchEncoder(tiny_dinov2, 128, "cpu"), head)


def test_files_that_are_no_heads_are_named(tmp_path, segformer):
    with pytest.raises(FormatError, match="does not exist; train a head"):
        LinearHead.load(tmp_path / "none.safetensors")
    with pytest.raises(FormatError, match="the format is 'pt', not"):
        LinearHead.load(segformer / "model.safetensors")
    (tmp_path / "text.safetensors").write_text("no head")
    with pytest.raises(FormatError, match=r"text\.safetensors is not a semsplat head"):
        LinearHead.load(tmp_path / "text.safetensors")


def test_nothing_can_be_learned_without_labels(tiny_dinov2):
    encoder = PatchEncoder(tiny_dinov2, 64, "cpu")
    generator = np.random.default_rng(0)
    with pytest.raises(DatasetError, match="no frame has a labelled pixel"):
        train_head(encoder, [], NAMES, generator)
    with pytest.raises(DatasetError, match="several classes of the dataset have the name 'red'"):
        train_head(encoder, [coloured_frame(0)], {3: "red", 5: "red"}, generator)
    few = HeadTrainingOptions(patches_per_frame=5)
    with pytest.raises(DatasetError, match=r"frame 0 contains class id\(s\) 9 without a name"):
        train_head(encoder, [coloured_frame(0)], {3: "red", 5: "green"}, generator, few)
