"""How much of each class a keyframe observes: what landmark vectors are made of (G-7)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from toolkit.gaussians.cloud import GaussianCloud
from toolkit.geometry import se3
from toolkit.keyframe import Keyframe
from toolkit.mapping.semantic_mapping import SemanticMapping
from toolkit.rendering import draw_surface
from toolkit.rendering.backend import Backend
from toolkit.semantics.histograms import class_counts
from toolkit.submaps.atlas import shown_by


class ClassCounter(Protocol):
    """Counts what a keyframe observes of each class."""

    def counts(self, keyframe: Keyframe, gaussians: GaussianCloud) -> NDArray[np.int64]:
        """Return the counts [C] of the classes, without void.

        Args:
            gaussians: of the keyframe's submap, in the submap's frame.
        """
        ...


@dataclass(frozen=True)
class LabelledPixels:
    """Counts the labelled pixels of the keyframe's own image; nothing is rendered.

    Attributes:
        classes: C of the taxonomy; 0 without labels.
    """

    classes: int

    def counts(self, keyframe: Keyframe, gaussians: GaussianCloud) -> NDArray[np.int64]:
        """See ClassCounter."""
        if keyframe.class_ids is None:
            return np.zeros(self.classes, np.int64)
        return class_counts(keyframe.class_ids.numpy(), self.classes)[1:]


@dataclass(frozen=True)
class ObservedGaussians:
    """Counts the Gaussians on the surface that the keyframe sees, by the class they decode to (G).

    Gaussians that are hidden behind that surface, or never had a label, do not count.

    Attributes:
        semantics: decodes the features of the map.
        classes: C of the taxonomy.
        backend: renderer of the surface.
    """

    semantics: SemanticMapping
    classes: int
    backend: Backend

    def counts(self, keyframe: Keyframe, gaussians: GaussianCloud) -> NDArray[np.int64]:
        """See ClassCounter."""
        cloud, T_camera_map = gaussians.to("cpu"), se3.inverse(keyframe.T_map_camera)
        view = draw_surface(self.backend, cloud, keyframe.camera, T_camera_map)
        visible = shown_by(view, cloud, keyframe.camera, T_camera_map)
        decoding = self.semantics.decode_gaussians(cloud.features.index_select(0, visible))
        return class_counts(decoding.class_ids, self.classes)[1:]
