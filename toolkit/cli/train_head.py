"""`semsplat train-head`: train a linear head for segmentation on a data set's labels."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from tqdm import tqdm

from toolkit.cli.arguments import parse_arguments
from toolkit.datasets.base import Dataset
from toolkit.datasets.options import DatasetKind
from toolkit.datasets.registry import open_dataset
from toolkit.errors import DatasetError, SettingsError
from toolkit.frame import Frame


@dataclass(frozen=True)
class LabelledData:
    """The frames to learn from."""

    kind: DatasetKind
    """Layout of the data set (docs/guides/datasets.md)."""
    path: Path
    """Its folder; it must have labels."""


@dataclass(frozen=True)
class TrainHeadOptions:
    """Train a linear head on the patch features of a vision transformer such as DINOv2.

    The head is for `--semantics.segmenter.kind model` with the same model folder.
    """

    dataset: LabelledData
    model: Path
    """Folder of the encoder, for transformers; nothing is downloaded."""
    out: Path
    """The head to write, a .safetensors file."""
    every: int = 1
    """Use every n-th frame."""
    hold_out: int = 5
    """Of those, keep every n-th out of training, to measure the head on it."""
    image_size: tuple[int, int] | None = None
    """Width and height in pixels, as a run would resize; native size without it."""
    longest_side: int = 518
    """Pixels of the longer side of what the encoder sees; images are scaled to it."""
    patches_per_frame: int = 400
    """Most patches of a frame that take part."""
    seed: int = 0
    """Of the choice of patches."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Where the encoder runs."""


def main(argv: Sequence[str]) -> int:
    """Train a head, measure it on held-out frames, and write it.

    Returns:
        0.

    Raises:
        ToolkitError: data, model or options are not as they should be.
    """
    options = parse_arguments(TrainHeadOptions, argv, "train-head")
    _check(options)
    # torch and transformers take seconds to load: wrong words are told before.
    from toolkit.semantics.segmenters.head_training import (
        HeadTrainingOptions,
        score_head,
        train_head,
    )
    from toolkit.semantics.segmenters.patch_features import PatchEncoder

    dataset = open_dataset(options.dataset.kind, options.dataset.path, options.image_size)
    if dataset.label_names is None:
        raise DatasetError(f"{options.dataset.path} has no labels to learn from")
    used = range(0, len(dataset), options.every)
    held_out = used[options.hold_out - 1 :: options.hold_out]
    if not held_out:
        raise DatasetError(
            f"{len(used)} frame(s) leave none to measure on; lower --every or --hold-out"
        )
    kept = [index for index in used if index not in set(held_out)]
    encoder = PatchEncoder(options.model, options.longest_side, options.device)
    generator = np.random.default_rng(options.seed)
    training = HeadTrainingOptions(patches_per_frame=options.patches_per_frame)
    frames = _frames(dataset, kept, "training")
    head = train_head(encoder, frames, dataset.label_names, generator, training)
    score = score_head(encoder, head, _frames(dataset, held_out, "measuring"), dataset.label_names)
    head.save(options.out)
    print(f"classes                 {len(head.class_names)}")
    print(f"training frames         {len(kept)}")
    print(f"held-out frames         {score.frames}")
    print(f"held-out accuracy       {score.accuracy:.3f}")
    print(f"held-out mIoU           {score.mean_iou:.3f}")
    print(f"wrote {options.out}")
    return 0


def _check(options: TrainHeadOptions) -> None:
    least = {"every": 1, "hold_out": 2, "longest_side": 14, "patches_per_frame": 1, "seed": 0}
    for name, bound in least.items():
        value = getattr(options, name)
        if value < bound:
            word = name.replace("_", "-")
            raise SettingsError(f"--{word} must be at least {bound}, got {value}")
    if options.out.suffix != ".safetensors":
        raise SettingsError(f"--out must end in .safetensors, got {options.out}")


def _frames(dataset: Dataset, indices: Sequence[int], purpose: str) -> Iterator[Frame]:
    shown = sys.stderr.isatty()
    for index in tqdm(indices, desc=purpose, unit="frame", file=sys.stderr, disable=not shown):
        yield dataset[index]
