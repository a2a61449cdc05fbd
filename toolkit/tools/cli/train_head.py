"""`semsplat train-head`: learn classes of your own from the labels of a few frames."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from tqdm import tqdm

from toolkit.base.errors import DatasetError
from toolkit.base.frame import Frame
from toolkit.datasets.base import Dataset
from toolkit.datasets.registry import open_dataset
from toolkit.semantics.segmenters.head_training import HeadTrainingOptions, score_head, train_head
from toolkit.semantics.segmenters.indoor.encoder import IndoorEncoder
from toolkit.semantics.segmenters.linear_head import Encoder
from toolkit.semantics.segmenters.patch_features import PatchEncoder
from toolkit.tools.cli.programs import TrainHeadOptions


def main(options: TrainHeadOptions) -> int:
    """Train a head, evaluate it on held-out frames, and write it.

    Returns:
        0.

    Raises:
        ToolkitError: the dataset or the model cannot be read, the dataset has no labels or too
            few frames, or the head cannot be written.
    """
    dataset = open_dataset(options.dataset.kind, options.dataset.path, options.image_size)
    if dataset.label_names is None:
        raise DatasetError(f"{options.dataset.path} has no labels for training")
    used = range(0, len(dataset), options.every)
    held_out = used[options.hold_out - 1 :: options.hold_out]
    if not held_out:
        raise DatasetError(
            f"no frame is left for evaluation ({len(used)} frame(s) are used); decrease --every or "
            "--hold-out"
        )
    training_frames = [index for index in used if index not in set(held_out)]
    encoder: Encoder = IndoorEncoder()
    if options.model is not None:
        encoder = PatchEncoder(options.model, options.longest_side, options.device)
    generator = np.random.default_rng(options.seed)
    training = HeadTrainingOptions(patches_per_frame=options.patches_per_frame)
    frames = _frames(dataset, training_frames, "training")
    head = train_head(encoder, frames, dataset.label_names, generator, training)
    evaluation_frames = _frames(dataset, held_out, "evaluation")
    score = score_head(encoder, head, evaluation_frames, dataset.label_names)
    head.save(options.out)
    print(f"classes                 {len(head.class_names)}")
    print(f"training frames         {len(training_frames)}")
    print(f"held-out frames         {score.frames}")
    print(f"held-out accuracy       {score.accuracy:.3f}")
    print(f"held-out mIoU           {score.mean_iou:.3f}")
    print(f"wrote {options.out}")
    return 0


def _frames(dataset: Dataset, indices: Sequence[int], purpose: str) -> Iterator[Frame]:
    for index in tqdm(indices, desc=purpose, unit="frame", disable=None):
        yield dataset[index]
