"""Replay memory: samples of every class observed so far, against forgetting in the decoder."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor


class ReplayMemory:
    """A uniform sample of the codes of each class (reservoir sampling).

    Args:
        channels: number of channels S of the code.
        classes: number of classes C.
        size: maximum number of samples per class; 0 disables the memory.
    """

    def __init__(self, channels: int, classes: int, size: int) -> None:
        self._values = np.zeros((classes, size, channels), np.float32)
        self._offered = np.zeros(classes, np.int64)

    def add(self, values: Tensor, class_ids: Tensor, generator: np.random.Generator) -> None:
        """Add the codes of P pixels to the sample.

        Args:
            values: [S, P] codes.
            class_ids: [P] class ids > 0.
            generator: selects the samples that are replaced.
        """
        size = self._values.shape[1]
        if size == 0:
            return
        codes, ids = values.detach().cpu().numpy().T, class_ids.cpu().numpy() - 1
        for class_ in np.unique(ids):
            selected = codes[ids == class_]
            # Reservoir sampling: the n-th sample is stored if a random slot of n is below `size`.
            order = self._offered[class_] + np.arange(len(selected))
            slot = np.where(order < size, order, generator.integers(0, order + 1))
            kept = slot < size
            self._values[class_, slot[kept]] = selected[kept]
            self._offered[class_] += len(selected)

    def samples(self) -> tuple[Tensor, Tensor]:
        """Return the stored codes [S, P] and their class ids [P]."""
        size = self._values.shape[1]
        filled = np.arange(size) < np.minimum(self._offered, size)[:, None]
        ids = np.nonzero(filled)[0] + 1
        return torch.from_numpy(self._values[filled].T.copy()), torch.from_numpy(ids)

    def state(self) -> dict[str, NDArray]:
        """Return the arrays that `restore` accepts."""
        return {"values": self._values.copy(), "offered": self._offered.copy()}

    def restore(self, arrays: dict[str, NDArray]) -> None:
        """Restore an earlier `state`."""
        self._values = np.array(arrays["values"], np.float32)
        self._offered = np.array(arrays["offered"], np.int64)
