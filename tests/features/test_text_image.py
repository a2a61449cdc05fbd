"""Encoders of texts and images from a folder: made on the spot with random weights."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from tiny_models import SIDE, save_clip, save_siglip

from toolkit.base.errors import FormatError
from toolkit.semantics.features.pretrained.text_image import TextImageEncoder

transformers = pytest.importorskip("transformers")


@pytest.fixture(autouse=True)
def offline(monkeypatch):
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")


@pytest.fixture(scope="module")
def models(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("models")
    save_clip(folder / "clip")
    save_siglip(folder / "siglip")
    return folder


def images(count: int) -> list[np.ndarray]:
    generator = np.random.default_rng(0)
    return [generator.integers(0, 255, (20 + 4 * n, 30, 3), dtype=np.uint8) for n in range(count)]


@pytest.mark.parametrize(("kind", "dimensions"), [("clip", 24), ("siglip", 16)])
def test_texts_and_images_have_unit_embeddings_in_one_space(models, kind, dimensions):
    encoder = TextImageEncoder(models / kind, "cpu")
    assert encoder.dimensions == dimensions
    texts = encoder.embed_texts(["red mug", "blue chair", "red mug"])
    pictures = encoder.embed_images(images(3))
    for found in (texts, pictures):
        assert found.shape == (3, dimensions)
        assert found.dtype == np.float32
        np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1.0, atol=1e-5)
    np.testing.assert_array_equal(texts[0], texts[2])
    assert np.abs(texts[0] - texts[1]).max() > 1e-3
    assert encoder.embed_images([]).shape == (0, dimensions)


@pytest.mark.parametrize("kind", ["clip", "siglip"])
def test_the_embeddings_are_those_of_the_model(models, kind):
    """The reference calls the model by hand, with texts filled up as each family expects them."""
    encoder = TextImageEncoder(models / kind, "cpu")
    model = transformers.AutoModel.from_pretrained(models / kind).eval()
    tokens = [1, 8, 9, 2] + ([0] * 12 if kind == "siglip" else [])
    features = model.get_text_features(torch.tensor([tokens])).pooler_output
    expected = torch.nn.functional.normalize(features, dim=1).detach().numpy()
    np.testing.assert_allclose(encoder.embed_texts(["red mug"]), expected, atol=1e-5)
    image = np.full((SIDE, SIDE, 3), (255, 0, 128), np.uint8)
    pixels = torch.tensor(image / 127.5 - 1.0, dtype=torch.float32).permute(2, 0, 1)[None]
    features = model.get_image_features(pixels).pooler_output
    expected = torch.nn.functional.normalize(features, dim=1).detach().numpy()
    np.testing.assert_allclose(encoder.embed_images([image]), expected, atol=1e-4)


def test_the_name_belongs_to_the_weights_and_not_to_the_folder(models, tmp_path):
    name = TextImageEncoder(models / "clip", "cpu").name
    assert name.startswith("clip ")
    shutil.copytree(models / "clip", tmp_path / "copy")
    assert TextImageEncoder(tmp_path / "copy", "cpu").name == name
    assert TextImageEncoder(save_clip(tmp_path / "other", seed=1), "cpu").name != name


def test_long_texts_are_cut(models):
    encoder = TextImageEncoder(models / "clip", "cpu")
    np.testing.assert_array_equal(*encoder.embed_texts(["red " * 50, "red " * 40]))


def test_folders_without_such_a_model_are_refused(models, tmp_path):
    with pytest.raises(FormatError, match=r"has no config\.json"):
        TextImageEncoder(tmp_path, "cpu")
    bert = tmp_path / "bert"
    config = transformers.BertConfig(
        vocab_size=9, hidden_size=8, num_hidden_layers=1, num_attention_heads=1
    )
    transformers.BertModel(config).save_pretrained(bert)
    with pytest.raises(FormatError, match="a bert model does not embed texts and images"):
        TextImageEncoder(bert, "cpu")
    bare = shutil.copytree(models / "clip", tmp_path / "bare")
    for file in bare.glob("tokenizer*"):
        file.unlink()
    with pytest.raises(FormatError, match="contains no tokenizer"):
        TextImageEncoder(bare, "cpu")
    blind = shutil.copytree(models / "clip", tmp_path / "blind")
    (blind / "preprocessor_config.json").write_text(json.dumps({}))
    with pytest.raises(FormatError, match="makes images of 224x224 pixels, the model needs 32x32"):
        TextImageEncoder(blind, "cpu").embed_images(images(1))
