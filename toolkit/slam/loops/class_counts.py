"""Per-class counts of what a keyframe observes, the input of landmark vectors (G-7)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from toolkit.base.geometry import se3
from toolkit.base.keyframe import Keyframe
from toolkit.semantics.histograms import class_counts
from toolkit.slam.mapping.boundary import visible_gaussians
from toolkit.slam.mapping.semantic_mapping import SemanticMapping
from toolkit.splatting.gaussians.cloud import GaussianCloud
from toolkit.splatting.rendering import render_surface
from toolkit.splatting.rendering.backend import Backend


class ClassCounter(Protocol):
    """Counts what a keyframe observes of each class."""

    def submap_counts(self, gaussians: GaussianCloud) -> NDArray[np.int64] | None:
        """Return the Gaussians [C] per class of a submap; None if they are not counted."""
        ...

    def counts(self, keyframe: Keyframe, gaussians: GaussianCloud) -> NDArray[np.int64]:
        """Return the counts [C] of the classes, void excluded.

        Args:
            keyframe: observing keyframe.
            gaussians: Gaussians of the keyframe's submap, in the submap's frame.
        """
        ...


@dataclass(frozen=True)
class PixelClassCounter:
    """Counts the labelled pixels of the keyframe's own image; nothing is rendered.

    Attributes:
        classes: number C of classes in the taxonomy; 0 without labels.
    """

    classes: int

    def submap_counts(self, gaussians: GaussianCloud) -> NDArray[np.int64] | None:
        """See ClassCounter."""
        return None

    def counts(self, keyframe: Keyframe, gaussians: GaussianCloud) -> NDArray[np.int64]:
        """See ClassCounter."""
        if keyframe.class_ids is None:
            return np.zeros(self.classes, np.int64)
        return class_counts(keyframe.class_ids.numpy(), self.classes)[1:]


@dataclass(frozen=True)
class GaussianClassCounter:
    """Counts the Gaussians on the visible surface by their decoded class (G).

    Occluded Gaussians and Gaussians that never received a label are not counted.

    Attributes:
        semantics: decoder of the map's features.
        classes: number C of classes in the taxonomy.
        backend: backend that renders the surface.
        whole: whether the Gaussians of whole submaps are counted too, as equation 7 needs.
    """

    semantics: SemanticMapping
    classes: int
    backend: Backend
    whole: bool = False

    def submap_counts(self, gaussians: GaussianCloud) -> NDArray[np.int64] | None:
        """See ClassCounter."""
        return self._by_class(gaussians.features.to("cpu")) if self.whole else None

    def counts(self, keyframe: Keyframe, gaussians: GaussianCloud) -> NDArray[np.int64]:
        """See ClassCounter."""
        cloud, T_camera_map = gaussians.to("cpu"), se3.inverse(keyframe.T_map_camera)
        view = render_surface(self.backend, cloud, keyframe.camera, T_camera_map)
        visible = visible_gaussians(view, cloud, keyframe.camera, T_camera_map)
        return self._by_class(cloud.features.index_select(0, visible))

    def _by_class(self, features: Tensor) -> NDArray[np.int64]:
        """Count Gaussians with features [N, S] by their decoded class."""
        decoding = self.semantics.decode_gaussians(features)
        return class_counts(decoding.class_ids, self.classes)[1:]
