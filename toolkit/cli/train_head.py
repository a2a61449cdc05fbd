"""`semsplat train-head`: train a linear head for segmentation on a data set's labels."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence

import numpy as np
from tqdm import tqdm

from toolkit.cli.arguments import parse_arguments
from toolkit.cli.programs import TrainHeadOptions
from toolkit.datasets.base import Dataset
from toolkit.datasets.registry import open_dataset
from toolkit.errors import DatasetError, SettingsError
from toolkit.frame import Frame


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
    if options.out.suffix != ".safetensors":
        raise SettingsError(f"--out must end in .safetensors, got {options.out}")


def _frames(dataset: Dataset, indices: Sequence[int], purpose: str) -> Iterator[Frame]:
    shown = sys.stderr.isatty()
    for index in tqdm(indices, desc=purpose, unit="frame", file=sys.stderr, disable=not shown):
        yield dataset[index]
