"""Tiny CLIP and SigLIP models with random weights, saved as `transformers` saves them."""

from __future__ import annotations

import json
from pathlib import Path

import torch

SIDE, PATCH = 32, 8
WORDS = ("a", "photo", "of", "object", "red", "mug", "chair", "blue", "sofa")
_SPECIAL = ("<pad>", "<bos>", "<eos>", "<unk>")


def save_clip(folder: Path, seed: int = 0, dimensions: int = 24) -> Path:
    """A CLIP model with embeddings of some dimensions."""
    import transformers

    torch.manual_seed(seed)
    config = transformers.CLIPConfig(
        text_config=_text(12) | {"projection_dim": dimensions},
        vision_config=_vision() | {"projection_dim": dimensions},
        projection_dim=dimensions,
    )
    transformers.CLIPModel(config).save_pretrained(folder)
    return _completed(folder, "CLIPImageProcessor")


def save_siglip(folder: Path, seed: int = 0) -> Path:
    """A SigLIP model with embeddings of 16 dimensions."""
    import transformers

    torch.manual_seed(seed)
    config = transformers.SiglipConfig(
        text_config=_text(16) | {"projection_size": 16}, vision_config=_vision()
    )
    transformers.SiglipModel(config).save_pretrained(folder)
    return _completed(folder, "SiglipImageProcessor")


def _text(length: int) -> dict[str, object]:
    return {
        "vocab_size": len(_SPECIAL) + len(WORDS),
        "hidden_size": 16,
        "intermediate_size": 32,
        "num_hidden_layers": 2,
        "num_attention_heads": 2,
        "max_position_embeddings": length,
        "pad_token_id": 0,
        "bos_token_id": 1,
        "eos_token_id": 2,
    }


def _vision() -> dict[str, object]:
    return {
        "hidden_size": 16,
        "intermediate_size": 32,
        "num_hidden_layers": 2,
        "num_attention_heads": 2,
        "image_size": SIDE,
        "patch_size": PATCH,
    }


def _completed(folder: Path, processor: str) -> Path:
    """Add a tokenizer of whole words and an image processor."""
    import tokenizers
    import transformers

    names = {word: number for number, word in enumerate((*_SPECIAL, *WORDS))}
    tokenizer = tokenizers.Tokenizer(tokenizers.models.WordLevel(names, unk_token="<unk>"))
    tokenizer.pre_tokenizer = tokenizers.pre_tokenizers.Whitespace()
    tokenizer.post_processor = tokenizers.processors.TemplateProcessing(
        single="<bos> $A <eos>", special_tokens=[("<bos>", 1), ("<eos>", 2)]
    )
    transformers.PreTrainedTokenizerFast(
        tokenizer_object=tokenizer, pad_token="<pad>", eos_token="<eos>", unk_token="<unk>"
    ).save_pretrained(folder)
    values = {
        "image_processor_type": processor,
        "do_resize": True,
        "size": {"height": SIDE, "width": SIDE},
        "do_center_crop": False,
        "do_rescale": True,
        "do_normalize": True,
        "image_mean": [0.5, 0.5, 0.5],
        "image_std": [0.5, 0.5, 0.5],
    }
    (folder / "preprocessor_config.json").write_text(json.dumps(values))
    return folder
