"""View describers: image sources, settings and missing models."""

from __future__ import annotations

import shutil
import sys

import pytest
import torch

from toolkit.base.errors import DependencyError, FormatError, SettingsError
from toolkit.semantics.features.builtin import BuiltinEncoder
from toolkit.semantics.features.factory import build_describer, build_encoder
from toolkit.semantics.features.options import FeatureOptions
from toolkit.semantics.features.sources import ViewDescriber


@pytest.fixture(autouse=True)
def offline(monkeypatch):
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")


@pytest.mark.parametrize("source", ["rgb", "semantic"])
def test_descriptor_of_a_single_source(views, source):
    encoder = BuiltinEncoder()
    rgb, semantic = views[:2], views[2:4]
    found = ViewDescriber(encoder, source).describe(rgb, semantic)
    assert torch.equal(found, encoder.describe(rgb if source == "rgb" else semantic))


def test_squared_distance_of_both_sources_is_their_mean(views):
    encoder = BuiltinEncoder()
    both = ViewDescriber(encoder, "both")
    one, other = both.describe(views[0:1], views[1:2]), both.describe(views[2:3], views[3:4])
    assert one.shape == (1, both.dimensions) == (1, 768)
    squares = [
        (encoder.describe(views[i : i + 1]) - encoder.describe(views[j : j + 1])).square().sum()
        for i, j in ((0, 2), (1, 3))
    ]
    torch.testing.assert_close((one - other).square().sum(), torch.stack(squares).mean())


def test_missing_semantic_image_raises(views):
    with pytest.raises(ValueError, match="semantic image"):
        ViewDescriber(BuiltinEncoder(), "both").describe(views)
    assert not ViewDescriber(BuiltinEncoder(), "rgb").wants_semantics


@pytest.mark.parametrize("kind", ["builtin", "colour-histogram"])
def test_settings_select_the_encoder(kind):
    describer = build_describer(FeatureOptions(kind=kind, source="semantic"))
    assert describer.name == f"{kind}/semantic"
    assert describer.dimensions == 384
    assert describer.threshold == build_encoder(FeatureOptions(kind=kind)).threshold


def test_dinov2_from_settings(tiny_dinov2, views):
    settings = FeatureOptions(kind="dinov2", folder=tiny_dinov2)
    encoder = build_encoder(settings)
    assert encoder.describe(views).shape == (6, 16)


def test_tokens_agree_with_transformers(tiny_dinov2, views):
    transformers = pytest.importorskip("transformers")
    from toolkit.semantics.features.dinov2 import Dinov2Encoder

    model = transformers.AutoModel.from_pretrained(tiny_dinov2)
    images = views[:, :, :56, :80]  # a multiple of the patch size, so images are not scaled
    mean, std = ((0.485, 0.456, 0.406), (0.229, 0.224, 0.225))
    prepared = (images - torch.tensor(mean).view(3, 1, 1)) / torch.tensor(std).view(3, 1, 1)
    with torch.no_grad():
        tokens = model(prepared).last_hidden_state
    found = Dinov2Encoder(tiny_dinov2, longest_side=80, device="cpu").describe(images)
    torch.testing.assert_close(found, torch.nn.functional.normalize(tokens[:, 0], dim=1))


def test_error_for_a_missing_folder_names_the_setting():
    with pytest.raises(SettingsError, match=r"--loops\.features\.folder"):
        build_encoder(FeatureOptions(kind="dinov2"))


def test_error_for_missing_weights_is_one_line(tiny_dinov2, tmp_path):
    empty = FeatureOptions(kind="dinov2", folder=tmp_path)
    with pytest.raises(FormatError, match=r"config\.json"):
        build_encoder(empty)
    copy = shutil.copytree(tiny_dinov2, tmp_path / "copy")
    (copy / "model.safetensors").unlink()
    with pytest.raises(FormatError, match="download it again") as caught:
        build_encoder(FeatureOptions(kind="dinov2", folder=copy))
    assert "\n" not in str(caught.value)


def test_error_for_missing_transformers_names_the_command(tiny_dinov2, monkeypatch):
    monkeypatch.setitem(sys.modules, "transformers", None)
    with pytest.raises(DependencyError, match="pip install"):
        build_encoder(FeatureOptions(kind="dinov2", folder=tiny_dinov2))


def test_without_a_class_token_the_patches_are_averaged(tmp_path, views):
    transformers = pytest.importorskip("transformers")
    from toolkit.semantics.features.dinov2 import Dinov2Encoder

    torch.manual_seed(0)
    config = transformers.SiglipVisionConfig(
        hidden_size=16,
        intermediate_size=16,
        num_hidden_layers=1,
        num_attention_heads=2,
        image_size=32,
        patch_size=8,
    )
    transformers.SiglipVisionModel(config).save_pretrained(tmp_path)
    encoder = Dinov2Encoder(tmp_path, longest_side=32, device="cpu")
    mean = encoder._model.tokens(views).patches.mean(dim=(1, 2))
    torch.testing.assert_close(encoder.describe(views), torch.nn.functional.normalize(mean, dim=1))
