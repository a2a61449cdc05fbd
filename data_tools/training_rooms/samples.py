"""Batches of network inputs and labels from rooms that are made on the fly."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import torch
from numpy.random import Generator
from numpy.typing import NDArray
from torch import Tensor
from torch.utils.data import IterableDataset, get_worker_info

from data_tools.training_rooms.views import View, training_views
from toolkit.semantics.segmenters.geometric.surface_grid import surface_grid
from toolkit.semantics.segmenters.indoor.channels import indoor_channels
from toolkit.semantics.segmenters.indoor.classes import INDOOR_CLASSES
from toolkit.semantics.segmenters.indoor.network import MULTIPLE

CLASS_IDS: dict[str, int] = {name: k for k, name in enumerate(INDOOR_CLASSES, start=1)}

# Sizes of views and their probabilities: common cameras, wide images, portrait images.
_SIZES = ((160, 120), (160, 96), (120, 160))
_SIZE_WEIGHTS = (0.6, 0.25, 0.15)
# Probability that the floor is unknown; errors of its height and of the direction up.
_NO_FLOOR, _FLOOR_M, _UP_RAD, _BAD_UP_RAD = 0.12, 0.03, 0.025, 0.15


class TrainingBatches(IterableDataset):
    """Batches without end: channels [B, 8, h, w] float16 and class ids [B, h, w] uint8.

    A batch depends on the seed and its number alone, so that training can be resumed, whatever
    the number of workers. Every other batch is the one before in a mirror: to make rooms takes as
    long as to learn from them.

    Args:
        seed: of all rooms. first: number of the first batch. size: views in a batch.
    """

    def __init__(self, seed: int, first: int, size: int) -> None:
        self._seed, self._first, self._size = seed, first, size

    def __iter__(self) -> Iterator[tuple[Tensor, Tensor]]:
        torch.set_num_threads(1)
        worker = get_worker_info()
        start, step = (worker.id, worker.num_workers) if worker else (0, 1)
        number = self._first // 2 + start
        while True:
            channels, labels = batch(np.random.default_rng([self._seed, number]), self._size)
            # Before the batch is given away, with its memory.
            mirrored = channels.flip(-1), labels.flip(-1)
            if number != self._first // 2 or self._first % 2 == 0:
                yield channels, labels
            yield mirrored
            number += step


def batch(rng: Generator, count: int, per_room: int = 6) -> tuple[Tensor, Tensor]:
    """A batch of views of one size."""
    size = _SIZES[rng.choice(len(_SIZES), p=_SIZE_WEIGHTS)]
    views = training_views(rng, CLASS_IDS, size, per_room)
    samples = [sample(rng, next(views)) for _ in range(count)]
    channels = torch.from_numpy(np.stack([channels for channels, _ in samples]))
    return channels, torch.from_numpy(np.stack([labels for _, labels in samples]))


def sample(rng: Generator, view: View) -> tuple[NDArray[np.float16], NDArray[np.uint8]]:
    """Channels and class ids of one view, as an imperfect estimate of gravity gives them."""
    grid = surface_grid(view.depth_m, view.camera)
    tilt = _BAD_UP_RAD if rng.random() < 0.05 else _UP_RAD
    up = view.T_world_camera[2, :3] + rng.normal(0, tilt, 3)
    height_m = view.T_world_camera[2, 3]
    floor_m = None if rng.random() < _NO_FLOOR else -height_m + rng.normal(0, _FLOOR_M)
    channels = indoor_channels(grid, up / np.linalg.norm(up), floor_m)
    labels = np.where(grid.valid, view.labels, 0)
    return padded(channels).astype(np.float16), padded(labels[None])[0].astype(np.uint8)


def padded(image: NDArray) -> NDArray:
    """The image [C, h, w] with zeros below and to the right up to multiples of 16."""
    height, width = image.shape[1:]
    return np.pad(image, ((0, 0), (0, -height % MULTIPLE), (0, -width % MULTIPLE)))
