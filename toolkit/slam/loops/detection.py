"""Loop detection: describes keyframes and searches for candidates (G, Algorithm 1)."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from toolkit.base.keyframe import Keyframe
from toolkit.semantics.features.sources import ViewDescriber
from toolkit.slam.loops.candidates import (
    CandidateFinder,
    DescribedKeyframe,
    LoopCandidate,
    SimilarKeyframe,
)
from toolkit.slam.loops.class_counts import ClassCounter, PixelClassCounter
from toolkit.slam.submaps.atlas import Atlas
from toolkit.slam.submaps.submap import Submap

# Class ids [H, W] to colours [3, H, W] in [0, 1].
ClassColouring = Callable[[NDArray[np.integer]], Tensor]


class LoopDetector:
    """Computes a descriptor for each keyframe and searches the older keyframes.

    Args:
        describer: computes view descriptors.
        finder: candidate search over the describer's descriptors.
        counter: counts classes in a keyframe; default: a map without labels.
        class_colours: converts class ids to colours for describers that use semantic images.
    """

    def __init__(
        self,
        describer: ViewDescriber,
        finder: CandidateFinder,
        counter: ClassCounter | None = None,
        class_colours: ClassColouring | None = None,
    ) -> None:
        self._describer, self._finder = describer, finder
        self._counter, self._class_colours = counter or PixelClassCounter(0), class_colours
        self._travelled_m = 0.0
        self._last: NDArray[np.float64] | None = None

    def observe(self, atlas: Atlas) -> list[LoopCandidate]:
        """Store the newest keyframe of the active submap; returns candidates if a search is due."""
        keyframe = atlas.keyframes[-1]
        descriptor = self._descriptor(keyframe)
        atlas.describe(descriptor)
        T_world_camera = atlas.T_world_submap(atlas.active) @ keyframe.T_map_camera
        return self._finder.add(
            self._described(keyframe, atlas.current, T_world_camera, descriptor)
        )

    def add_saved_submaps(self, submaps: Iterable[Submap]) -> None:
        """Store the keyframes of a saved map with their saved descriptors.

        The path length is increased by the minimum gap afterwards, so that keyframes of the
        new run are never rejected as neighbours of the saved ones.
        """
        last = None
        for submap in submaps:
            for keyframe, descriptor in zip(submap.keyframes, submap.descriptors, strict=True):
                # A keyframe on a boundary belongs to two submaps.
                if last is not None and keyframe.index <= last:
                    continue
                last = keyframe.index
                T_world_camera = submap.T_world_camera(keyframe)
                self._finder.remember(self._described(keyframe, submap, T_world_camera, descriptor))
        self._travelled_m += self._finder.options.min_gap_m
        self._last = None

    def _described(
        self,
        keyframe: Keyframe,
        submap: Submap,
        T_world_camera: NDArray[np.float64],
        descriptor: NDArray[np.float32],
    ) -> DescribedKeyframe:
        """Build the stored keyframe and update the length of the path."""
        position = T_world_camera[:3, 3]
        if self._last is not None:
            self._travelled_m += float(np.linalg.norm(position - self._last))
        self._last = position
        return DescribedKeyframe(
            keyframe.index,
            submap.number,
            self._travelled_m,
            descriptor,
            self._counter.counts(keyframe, submap.gaussians),
            self._counter.submap_counts(submap.gaussians),
        )

    @property
    def searched(self) -> bool:
        """Whether a loop search was run at the newest keyframe."""
        return self._finder.search_due

    def most_similar(self, keyframe: Keyframe, count: int) -> list[SimilarKeyframe]:
        """Return the keyframes most similar to a view, nearest first."""
        return self._finder.most_similar(self._descriptor(keyframe), count)

    def _descriptor(self, keyframe: Keyframe) -> NDArray[np.float32]:
        rgb = (keyframe.rgb.to(torch.float32) / 255.0)[None]
        semantic = None
        if self._describer.wants_semantics and self._class_colours is not None:
            ids = keyframe.class_ids
            blank = np.zeros(keyframe.depth_m.shape, np.int16)
            semantic = self._class_colours(blank if ids is None else ids.numpy())[None]
        with torch.no_grad():
            return self._describer.describe(rgb, semantic)[0].numpy()

    def state(self) -> dict[str, NDArray]:
        """Return the arrays that `restore` needs."""
        last = np.zeros(0) if self._last is None else self._last
        return {**self._finder.state(), "way": np.array([self._travelled_m]), "last": last}

    def restore(self, state: dict[str, NDArray]) -> None:
        """Restore an earlier `state`."""
        self._finder.restore(state)
        self._travelled_m = float(state["way"][0])
        self._last = np.array(state["last"]) if len(state["last"]) else None
