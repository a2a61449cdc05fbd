"""Samples of every class that a run has seen, for a network that must not forget any."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor


class ReplayMemory:
    """Keeps a uniform sample of the codes of each class (reservoir sampling).

    Args:
        channels: S of the code. classes: C.
        size: samples of each class; 0 keeps none.
    """

    def __init__(self, channels: int, classes: int, size: int) -> None:
        self._values = np.zeros((classes, size, channels), np.float32)
        self._offered = np.zeros(classes, np.int64)

    def add(self, values: Tensor, class_ids: Tensor, generator: np.random.Generator) -> None:
        """Offer the codes of some pixels.

        Args:
            values: [S, P]. class_ids: [P] > 0.
        """
        size = self._values.shape[1]
        if size == 0:
            return
        codes, ids = values.detach().cpu().numpy().T, class_ids.cpu().numpy() - 1
        for class_ in np.unique(ids):
            mine = codes[ids == class_]
            # The n-th sample offered takes a random one of n places; the first `size` are kept.
            order = self._offered[class_] + np.arange(len(mine))
            place = np.where(order < size, order, generator.integers(0, order + 1))
            kept = place < size
            self._values[class_, place[kept]] = mine[kept]
            self._offered[class_] += len(mine)

    def samples(self) -> tuple[Tensor, Tensor]:
        """Return the codes kept, [S, P], and their class ids [P]."""
        size = self._values.shape[1]
        filled = np.arange(size) < np.minimum(self._offered, size)[:, None]
        ids = np.nonzero(filled)[0] + 1
        return torch.from_numpy(self._values[filled].T.copy()), torch.from_numpy(ids)

    def state(self) -> dict[str, NDArray]:
        """Arrays that `restore` takes."""
        return {"values": self._values.copy(), "offered": self._offered.copy()}

    def restore(self, arrays: dict[str, NDArray]) -> None:
        """Take over an earlier `state`."""
        self._values = np.array(arrays["values"], np.float32)
        self._offered = np.array(arrays["offered"], np.int64)
