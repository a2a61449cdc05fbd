"""Depth estimation models with random weights, saved in folders."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import torch

SIZE = 28
_BACKBONE = {
    "hidden_size": 8,
    "num_hidden_layers": 4,
    "num_attention_heads": 2,
    "patch_size": 14,
    "image_size": SIZE,
    "mlp_ratio": 1,
    "out_indices": [1, 2, 3, 4],
    "apply_layernorm": True,
    "reshape_hidden_states": False,
}
_NECK = {"neck_hidden_sizes": [4, 4, 8, 8], "fusion_hidden_size": 8}
_PROCESSOR = {
    "do_resize": True,
    "size": {"height": SIZE, "width": SIZE},
    "keep_aspect_ratio": False,
    "ensure_multiple_of": 14,
    "do_rescale": True,
    "do_normalize": True,
    "image_mean": [0.5, 0.5, 0.5],
    "image_std": [0.5, 0.5, 0.5],
}


def save(folder: Path, architecture: str, **settings: Any) -> Path:
    """Save a model of an architecture with its image processor; settings change its config."""
    t = pytest.importorskip("transformers")
    torch.manual_seed(0)
    model, processor = _MODELS[architecture](t, settings)
    model.save_pretrained(folder)
    (folder / "preprocessor_config.json").write_text(json.dumps(_PROCESSOR | processor))
    return folder


def _depth_anything(t: Any, settings: dict) -> tuple[Any, dict]:
    config = t.DepthAnythingConfig(
        backbone_config=t.Dinov2Config(**_BACKBONE),
        reassemble_hidden_size=8,
        head_hidden_size=4,
        **_NECK,
        **settings,
    )
    return t.DepthAnythingForDepthEstimation(config), {"image_processor_type": "DPTImageProcessor"}


def _prompt_depth_anything(t: Any, settings: dict) -> tuple[Any, dict]:
    config = t.PromptDepthAnythingConfig(
        backbone_config=t.Dinov2Config(**_BACKBONE),
        reassemble_hidden_size=8,
        head_hidden_size=4,
        **_NECK,
        **settings,
    )
    model = t.PromptDepthAnythingForDepthEstimation(config)
    return model, {"image_processor_type": "PromptDepthAnythingImageProcessor"}


def _dpt(t: Any, settings: dict) -> tuple[Any, dict]:
    config = t.DPTConfig(
        hidden_size=8,
        num_hidden_layers=4,
        num_attention_heads=2,
        intermediate_size=8,
        image_size=32,
        patch_size=16,
        backbone_out_indices=[0, 1, 2, 3],
        is_hybrid=False,
        **_NECK,
        **settings,
    )
    processor = {"image_processor_type": "DPTImageProcessor", "size": {"height": 32, "width": 32}}
    return t.DPTForDepthEstimation(config), processor | {"ensure_multiple_of": 16}


def _zoedepth(t: Any, settings: dict) -> tuple[Any, dict]:
    backbone = t.BeitConfig(
        hidden_size=8,
        num_hidden_layers=4,
        num_attention_heads=2,
        intermediate_size=8,
        image_size=32,
        patch_size=16,
        out_indices=[1, 2, 3, 4],
        reshape_hidden_states=False,
        use_relative_position_bias=True,
    )
    config = t.ZoeDepthConfig(
        backbone_config=backbone,
        bottleneck_features=8,
        num_relative_features=4,
        num_attractors=[2, 2, 2, 2],
        bin_embedding_dim=8,
        bin_configurations=[{"n_bins": 8, "min_depth": 0.001, "max_depth": 10.0}],
        **_NECK,
        **settings,
    )
    processor = {
        "image_processor_type": "ZoeDepthImageProcessor",
        "size": {"height": 32, "width": 32},
        "ensure_multiple_of": 16,
        "do_pad": True,
    }
    return t.ZoeDepthForDepthEstimation(config), processor


def _glpn(t: Any, settings: dict) -> tuple[Any, dict]:
    config = t.GLPNConfig(
        hidden_sizes=[8, 8, 8, 8],
        depths=[1, 1, 1, 1],
        num_attention_heads=[1, 1, 1, 1],
        mlp_ratios=[1, 1, 1, 1],
        decoder_hidden_size=4,
        **settings,
    )
    processor = {"image_processor_type": "GLPNImageProcessor", "size_divisor": 32}
    return t.GLPNForDepthEstimation(config), processor


def _depth_pro(t: Any, settings: dict) -> tuple[Any, dict]:
    encoder = {
        "model_type": "dinov2",
        "hidden_size": 8,
        "num_hidden_layers": 2,
        "num_attention_heads": 2,
        "patch_size": 8,
        "image_size": 32,
        "mlp_ratio": 1,
    }
    config = t.DepthProConfig(
        patch_size=32,
        fusion_hidden_size=8,
        intermediate_hook_ids=[1, 0],
        intermediate_feature_dims=[8, 8],
        scaled_images_ratios=[0.5, 1.0],
        scaled_images_overlap_ratios=[0.0, 0.5],
        scaled_images_feature_dims=[8, 8],
        merge_padding_value=1,
        use_fov_model=False,
        image_model_config=encoder,
        patch_model_config=encoder,
        fov_model_config=encoder,
        **settings,
    )
    processor = {"image_processor_type": "DepthProImageProcessor"}
    return t.DepthProForDepthEstimation(config), processor | {"size": {"height": 64, "width": 64}}


_MODELS = {
    "depth_anything": _depth_anything,
    "prompt_depth_anything": _prompt_depth_anything,
    "dpt": _dpt,
    "zoedepth": _zoedepth,
    "glpn": _glpn,
    "depth_pro": _depth_pro,
}
ARCHITECTURES = tuple(_MODELS)
