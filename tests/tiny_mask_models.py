"""Models that yield masks, with tiny random weights, saved as `transformers` saves them."""

from __future__ import annotations

import json
from pathlib import Path

import torch

CLASSES = {0: "chair", 1: "table", 2: "wall"}
WORDS = ("chair", "coffee", "table", "the", "task", "is", "panoptic", "lamp", "##s")
_SPECIAL = ("[PAD]", "[UNK]", "[CLS]", "[SEP]", ".")


def _swin(stages: list[str]) -> object:
    import transformers

    return transformers.SwinConfig(
        image_size=64,
        embed_dim=8,
        depths=[1, 1, 1, 1],
        num_heads=[1, 1, 1, 1],
        window_size=4,
        out_features=stages,
    )


_STAGES = ["stage1", "stage2", "stage3", "stage4"]
# What the configurations of Mask2Former and OneFormer have in common.
_SMALL = {
    "hidden_dim": 32,
    "encoder_feedforward_dim": 16,
    "dim_feedforward": 16,
    "encoder_layers": 1,
    "decoder_layers": 2,
    "num_attention_heads": 2,
    "num_queries": 6,
    "id2label": CLASSES,
    "label2id": {name: i for i, name in CLASSES.items()},
}


def save_mask2former(folder: Path) -> Path:
    """A Mask2Former model of three classes."""
    import transformers

    torch.manual_seed(0)
    config = transformers.Mask2FormerConfig(
        backbone_config=_swin(_STAGES),
        feature_size=32,
        mask_feature_size=32,
        **_SMALL,
    )
    transformers.Mask2FormerForUniversalSegmentation(config).save_pretrained(folder)
    return _with_images(folder)


def save_oneformer(folder: Path) -> Path:
    """A OneFormer model of three classes."""
    import transformers

    torch.manual_seed(0)
    config = transformers.OneFormerConfig(
        backbone_config=_swin(_STAGES),
        conv_dim=32,
        mask_dim=32,
        **_SMALL,
        task_seq_len=8,
        text_encoder_vocab_size=len(_SPECIAL) + len(WORDS),
    )
    transformers.OneFormerForUniversalSegmentation(config).save_pretrained(folder)
    return _with_tokenizer(_with_images(folder))


def save_grounding_dino(folder: Path) -> Path:
    """A Grounding DINO model with five queries."""
    import transformers

    torch.manual_seed(0)
    config = transformers.GroundingDinoConfig(
        backbone_config=_swin(_STAGES[1:]),
        text_config=transformers.BertConfig(
            vocab_size=len(_SPECIAL) + len(WORDS),
            hidden_size=32,
            num_hidden_layers=1,
            num_attention_heads=2,
            intermediate_size=32,
            max_position_embeddings=32,
        ),
        num_queries=5,
        encoder_layers=1,
        decoder_layers=2,
        encoder_ffn_dim=16,
        decoder_ffn_dim=16,
        encoder_attention_heads=2,
        decoder_attention_heads=2,
        d_model=32,
        max_text_len=32,
    )
    transformers.GroundingDinoForObjectDetection(config).save_pretrained(folder)
    size = {"shortest_edge": 96, "longest_edge": 128}
    return _with_tokenizer(_with_images(folder, size))


def save_sam2(folder: Path) -> Path:
    """A SAM 2 model for images of 64 pixels."""
    import transformers

    torch.manual_seed(0)
    backbone = transformers.Sam2HieraDetConfig(
        hidden_size=8,
        image_size=[64, 64],
        blocks_per_stage=[1, 1, 2, 1],
        embed_dim_per_stage=[8, 16, 32, 64],
        num_attention_heads_per_stage=[1, 1, 1, 1],
        window_size_per_stage=[4, 4, 4, 4],
        global_attention_blocks=[3],
        window_positional_embedding_background_size=[4, 4],
    )
    vision = transformers.Sam2VisionConfig(
        backbone_config=backbone,
        backbone_channel_list=[64, 32, 16, 8],
        backbone_feature_sizes=[[16, 16], [8, 8], [4, 4]],
        fpn_hidden_size=32,
    )
    config = transformers.Sam2Config(
        vision_config=vision,
        prompt_encoder_config={"hidden_size": 32, "image_size": 64, "patch_size": 16},
        mask_decoder_config={
            "hidden_size": 32,
            "mlp_dim": 16,
            "num_attention_heads": 2,
            "iou_head_hidden_dim": 16,
        },
    )
    transformers.Sam2Model(config).save_pretrained(folder)
    return _with_images(folder)


def _with_images(folder: Path, size: dict[str, int] | None = None) -> Path:
    values = {
        "size": size or {"height": 64, "width": 64},
        "image_mean": [0.5, 0.5, 0.5],
        "image_std": [0.5, 0.5, 0.5],
    }
    (folder / "preprocessor_config.json").write_text(json.dumps(values))
    return folder


def _with_tokenizer(folder: Path) -> Path:
    import tokenizers
    import transformers

    names = {word: number for number, word in enumerate((*_SPECIAL, *WORDS))}
    tokenizer = tokenizers.Tokenizer(tokenizers.models.WordPiece(names, unk_token="[UNK]"))
    tokenizer.pre_tokenizer = tokenizers.pre_tokenizers.BertPreTokenizer()
    tokenizer.post_processor = tokenizers.processors.TemplateProcessing(
        single="[CLS] $A [SEP]", special_tokens=[("[CLS]", 2), ("[SEP]", 3)]
    )
    transformers.PreTrainedTokenizerFast(
        tokenizer_object=tokenizer,
        pad_token="[PAD]",
        unk_token="[UNK]",
        cls_token="[CLS]",
        sep_token="[SEP]",
    ).save_pretrained(folder)
    return folder
