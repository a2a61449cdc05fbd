"""The Gaussians of a finished map as they are written to files, with labels and submap numbers."""

from __future__ import annotations

from collections.abc import Iterator

from toolkit.gaussians.cloud import GaussianCloud
from toolkit.gaussians.scene import GaussianScene, InMemoryScene
from toolkit.io.splat_labels import SplatLabels
from toolkit.refinement.fusion import FusedMap
from toolkit.runs.settings import RunSettings
from toolkit.semantics.decoding import Decoding
from toolkit.slam.result import SlamResult


def labelled_parts(
    scene: GaussianScene,
    fused: FusedMap | InMemoryScene,
    result: SlamResult,
    settings: RunSettings,
) -> Iterator[tuple[GaussianCloud, SplatLabels | None, int | None]]:
    """Yield the Gaussians of a map by submap, with labels and number, as far as they have them.

    Args:
        scene: the map as stored, with rounded features.
        fused: the map itself.
    """
    numbers = fused.numbers if isinstance(fused, FusedMap) else [None]
    for number, part in zip(numbers, scene.parts(), strict=True):
        labels = None
        if result.taxonomy is not None:
            decoding = result.semantics.decode_gaussians(part.features)
            labels = splat_labels(decoding, settings.semantics.min_confidence)
        yield part, labels, number


def splat_labels(decoding: Decoding, min_confidence: float) -> SplatLabels:
    """Return the label columns of a map's file; levels below the confidence are void."""
    levels = decoding.backed_off(min_confidence)
    return SplatLabels(decoding.class_ids, levels, decoding.confidence)
