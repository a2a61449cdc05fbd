"""The Gaussians of a finished map as they are written to files, with labels and submap numbers."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from toolkit.base.errors import FormatError
from toolkit.io.splat_labels import SplatLabels
from toolkit.runs.folder import MapPart
from toolkit.runs.settings import RunSettings
from toolkit.scene.instances.listener import instances_of
from toolkit.scene.instances.result import InstanceMap
from toolkit.semantics.decoding import Decoding
from toolkit.semantics.taxonomy import Taxonomy
from toolkit.slam.refinement.fusion import FusedMap
from toolkit.slam.result import SlamResult
from toolkit.splatting.gaussians.scene import GaussianScene, InMemoryScene


def labelled_parts(
    scene: GaussianScene,
    fused: FusedMap | InMemoryScene,
    result: SlamResult,
    settings: RunSettings,
) -> Iterator[MapPart]:
    """Yield the Gaussians of a map by submap, with what is known of them.

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
        found, instances = instances_of(result), None
        if found is not None and number is not None:
            instances = found.ids.get(number)
        yield MapPart(part, labels, number, instances)


def splat_labels(decoding: Decoding, min_confidence: float) -> SplatLabels:
    """Return the label columns of a map's file; levels below the confidence are void."""
    levels = decoding.backed_off(min_confidence)
    return SplatLabels(decoding.class_ids, levels, decoding.confidence)


def object_values(instances: InstanceMap, taxonomy: Taxonomy | None) -> dict[str, Any]:
    """Return the JSON values of the objects of a map, with the path of their class in the tree."""
    return {
        "objects": [
            one.values() | {"path": _class_path(one.class_name, taxonomy)}
            for one in instances.objects
        ]
    }


def _class_path(name: str | None, taxonomy: Taxonomy | None) -> list[str]:
    if name is None:
        return []
    try:
        return [name] if taxonomy is None else list(taxonomy.find(name).path)
    except FormatError:
        return [name]  # a class of the masks that the taxonomy of the labels lacks
