"""Watches keyframes go by and says which may show a place seen before (G, Algorithm 1)."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from toolkit.features.sources import ViewDescriber
from toolkit.keyframe import Keyframe
from toolkit.loops.candidates import (
    CandidateFinder,
    DescribedKeyframe,
    LoopCandidate,
    Sighting,
)
from toolkit.loops.class_counts import ClassCounter, LabelledPixels
from toolkit.submaps.atlas import Atlas
from toolkit.submaps.submap import Submap

# Class ids [H, W] to colours [3, H, W] in [0, 1].
Painter = Callable[[NDArray[np.integer]], Tensor]


class LoopDetector:
    """Describes each keyframe and searches among the older ones.

    Args:
        describer: of views.
        finder: of candidates, for its descriptors.
        counter: of classes in a keyframe; default: a map without labels.
        painter: of semantic pictures, where the describer wants them.
    """

    def __init__(
        self,
        describer: ViewDescriber,
        finder: CandidateFinder,
        counter: ClassCounter | None = None,
        painter: Painter | None = None,
    ) -> None:
        self._describer, self._finder = describer, finder
        self._counter, self._painter = counter or LabelledPixels(0), painter
        self._travelled_m = 0.0
        self._last: NDArray[np.float64] | None = None

    def observe(self, atlas: Atlas) -> list[LoopCandidate]:
        """Remember the active submap's newest keyframe; what was considered for it, if due."""
        keyframe = atlas.mapper.keyframes[-1]
        descriptor = self._described(keyframe)
        atlas.describe(descriptor)
        T_world_camera = atlas.T_world_submap(atlas.active) @ keyframe.T_map_camera
        counts = self._counter.counts(keyframe, atlas.mapper.gaussians)
        return self._finder.add(
            self._passed(keyframe, atlas.active, T_world_camera, descriptor, counts)
        )

    def take_over(self, submaps: Iterable[Submap]) -> None:
        """Remember the keyframes of an earlier run, with the descriptors that it gave them.

        The path goes on beyond the gap that keeps neighbours apart: no frame of this run is a
        neighbour of one of that.
        """
        last = None
        for submap in submaps:
            for keyframe, descriptor in zip(submap.keyframes, submap.descriptors, strict=True):
                # One on a boundary is in two submaps.
                if last is not None and keyframe.index <= last:
                    continue
                last = keyframe.index
                T_world_camera = submap.T_world_camera(keyframe)
                counts = self._counter.counts(keyframe, submap.gaussians)
                self._finder.remember(
                    self._passed(keyframe, submap.number, T_world_camera, descriptor, counts)
                )
        self._travelled_m += self._finder.options.min_gap_m
        self._last = None

    def _passed(
        self,
        keyframe: Keyframe,
        submap: int,
        T_world_camera: NDArray[np.float64],
        descriptor: NDArray[np.float32],
        counts: NDArray[np.int64],
    ) -> DescribedKeyframe:
        """A keyframe with the length of the path up to it."""
        place = T_world_camera[:3, 3]
        if self._last is not None:
            self._travelled_m += float(np.linalg.norm(place - self._last))
        self._last = place
        return DescribedKeyframe(keyframe.index, submap, self._travelled_m, descriptor, counts)

    @property
    def searched(self) -> bool:
        """Whether loops were searched for at the newest keyframe."""
        return self._finder.search_was_due

    def alike(self, keyframe: Keyframe, count: int) -> list[Sighting]:
        """The keyframes that look most like a view, nearest first."""
        return self._finder.alike(self._described(keyframe), count)

    def _described(self, keyframe: Keyframe) -> NDArray[np.float32]:
        rgb = (keyframe.rgb.to(torch.float32) / 255.0)[None]
        semantic = None
        if self._describer.wants_semantics and self._painter is not None:
            ids = keyframe.class_ids
            blank = np.zeros(keyframe.depth_m.shape, np.int16)
            semantic = self._painter(blank if ids is None else ids.numpy())[None]
        with torch.no_grad():
            return self._describer.describe(rgb, semantic)[0].numpy()

    def state(self) -> dict[str, NDArray]:
        """Arrays that `restore` takes."""
        last = np.zeros(0) if self._last is None else self._last
        return {**self._finder.state(), "way": np.array([self._travelled_m]), "last": last}

    def restore(self, state: dict[str, NDArray]) -> None:
        """Take over an earlier `state`."""
        self._finder.restore(state)
        self._travelled_m = float(state["way"][0])
        self._last = np.array(state["last"]) if len(state["last"]) else None
