"""Fusion of the refined submaps into one map; a task, because all submaps pass through it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import torch
from numpy.typing import NDArray

from toolkit.batch.refining.stored_map import StoredMap
from toolkit.batch.refining.tasks import Work
from toolkit.exposure import Exposure
from toolkit.io import storage
from toolkit.io.arrays import arrays_below
from toolkit.refinement.fusion import FusedMap, fuse_submaps, single_submap
from toolkit.runs.folder import MapPart, RunFolder
from toolkit.runs.map_files import splat_labels

Array = NDArray[np.float64]


@dataclass(frozen=True)
class AssemblyTask:
    """Fusion of all refined submaps at their corrected poses."""

    work: Work
    anchors: Mapping[int, Array]


@dataclass(frozen=True)
class Assembled:
    """The refined map.

    Attributes:
        gaussians: number of Gaussians.
        exposures: exposure of each submap relative to the map, by number.
    """

    gaussians: int
    exposures: Mapping[int, Exposure]


def store_decoder(source: StoredMap, out: str) -> StoredMap:
    """Store the decoder of the features without the features, which are large.

    Returns:
        The map with the place of its decoder.
    """
    if source.taxonomy is None:
        return source
    tree = storage.read_tree(storage.join(source.place, "semantics"))
    reader = {
        f"reader/{name}": array for name, array in arrays_below(tree.arrays, "reader/").items()
    }
    place = storage.join(out, "scratch", "decoder")
    storage.write_tree(place, reader, {})
    return replace(source, decoder=place)


def assemble(task: AssemblyTask) -> Assembled:
    """Fuse the refined submaps, and store map.ply and the features."""
    torch.set_num_threads(task.work.threads)
    source = task.work.source
    refined = replace(
        source,
        place=task.work.out,
        anchors=task.anchors,
        versions=dict.fromkeys(source.versions, 0),
    )
    fused = _fused(refined)
    with TemporaryDirectory() as name:
        folder = RunFolder(Path(name))
        semantics = source.semantics()
        if source.taxonomy is not None:
            features = np.concatenate([part.features.half().numpy() for part in fused.parts()])
            folder.write_semantics(features, semantics.state(), source.taxonomy)
        confidence = source.settings.semantics.min_confidence

        def labelled() -> Iterator[MapPart]:
            for number, part in zip(fused.numbers, fused.parts(), strict=True):
                labels = None
                if source.taxonomy is not None:
                    # As stored: the file contains rounded features.
                    decoding = semantics.decode_gaussians(part.features.half().float())
                    labels = splat_labels(decoding, confidence)
                yield MapPart(source.unit.cloud_in_metres(part), labels, number)

        folder.write_map(labelled())
        storage.upload(folder.map, storage.join(task.work.out, "map.ply"))
        if source.taxonomy is not None:
            for file in ("arrays.npz", "metadata.json"):
                place = storage.join(task.work.out, "semantics", file)
                storage.upload(folder.semantics / file, place)
    return Assembled(len(fused), fused.exposures)


def _fused(source: StoredMap) -> FusedMap:
    if len(source.anchors) == 1:
        return single_submap(next(iter(source.anchors)), source.submap)
    return fuse_submaps(sorted(source.anchors), source.submap)
