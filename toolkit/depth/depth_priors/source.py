"""Priors of the frames of a sequence on demand, predicted in sets where the model prefers that."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from toolkit.base.frame import Frame
from toolkit.depth.depth_priors.provider import (
    DepthPrior,
    DepthProvider,
    PriorImage,
    ScaleScope,
    frame_sets,
)


@dataclass(frozen=True)
class FramePrior:
    """The prior of one frame.

    Attributes:
        image: at the pixels of the frame.
        group: frames of the same group have the same scale and shift.
        prior: as the model returned it.
    """

    image: PriorImage
    group: int
    prior: DepthPrior


class PriorSource:
    """Predicts priors; those of a few sets are cached.

    Args:
        provider: predicts them.
        frame: returns the frame of an index.
        indices: of the frames that sets consist of, ascending.
        size, stride: of a set, as in `frame_sets`.
    """

    def __init__(
        self,
        provider: DepthProvider,
        frame: Callable[[int], Frame],
        indices: Sequence[int],
        size: int,
        stride: int,
    ) -> None:
        self._provider, self._frame = provider, frame
        sets = frame_sets(len(indices), size, stride)
        self._sets = [tuple(indices[i] for i in numbers) for numbers in sets]
        self._set_of = {index: n for n, members in enumerate(self._sets) for index in members}
        self._cache: OrderedDict[int, DepthPrior] = OrderedDict()
        # As many sets interleave as the stride.
        self._cached = size * (stride + 1)

    def prior(self, index: int) -> FramePrior:
        """The prior of a frame.

        Raises:
            ToolkitError: a file is missing or unreadable, or the model fails.
        """
        number = self._set_of[index]
        if index not in self._cache:
            members = self._sets[number] if self._provider.joint else (index,)
            predicted = self._provider.predict([self._frame(member) for member in members])
            self._cache.update(zip(predicted.indices, predicted.priors, strict=True))
            while len(self._cache) > max(self._cached, len(members)):
                self._cache.popitem(last=False)
        prior = self._cache[index]
        group = {ScaleScope.FRAME: index, ScaleScope.SET: number, ScaleScope.SEQUENCE: 0}
        image = prior.in_frame(self._frame(index).camera.size)
        return FramePrior(image, group[prior.scope], prior)
