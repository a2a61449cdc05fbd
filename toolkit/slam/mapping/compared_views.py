"""The views that the final refinement compares: keyframes, and frames between them."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence

import numpy as np

from toolkit.base.keyframe import Keyframe
from toolkit.slam.submaps.intermediate_views import IntermediateView

_log = logging.getLogger(__name__)

# Maximum loss of a view, as a factor of the loss of the keyframe before it (0.4 to 1.2 in a kitchen
# and in a noisy room): beyond, something moved, or its pose or exposure is wrong.
_MAX_LOSS = 2.0


class ComparedViews:
    """Keyframes and views between them in random order, each equally often.

    Views beside keyframes that show moving objects are left out, and those that turn out to
    contradict the map are not compared again.

    Args:
        generator: chooses the order.
    """

    def __init__(
        self,
        keyframes: Sequence[Keyframe],
        views: Sequence[IntermediateView],
        generator: np.random.Generator,
    ) -> None:
        self._keyframes = {keyframe.index: keyframe for keyframe in keyframes}
        still = {
            keyframe.index
            for place, keyframe in enumerate(keyframes)
            if all(near.observed_m is None for near in keyframes[place : place + 2])
        }
        self._views = {view.index: view for view in views if view.keyframe in still}
        self._generator = generator
        self._losses: dict[int, float] = {}
        self._order = self._endless()

    def next(self) -> Keyframe:
        """The next keyframe, or the next view in the form of one."""
        index = next(self._order)
        if index in self._keyframes:
            return self._keyframes[index]
        view = self._views[index]
        return view.opened(self._keyframes[view.keyframe])

    def compared(self, keyframe: Keyframe, loss: float) -> None:
        """Take note of the loss of what `next` has returned."""
        view = self._views.get(keyframe.index)
        if view is None:
            self._losses[keyframe.index] = loss
        elif loss > _MAX_LOSS * self._losses.get(view.keyframe, np.inf):
            _log.debug("Frame %d contradicts the map and is not compared again.", view.index)
            del self._views[view.index]

    def _endless(self) -> Iterator[int]:
        while True:
            indices = [*self._keyframes, *self._views]
            for place in self._generator.permutation(len(indices)):
                index = indices[place]
                if index in self._keyframes or index in self._views:
                    yield index
