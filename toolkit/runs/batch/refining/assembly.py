"""Fusion of the refined submaps into one map; a task, because all submaps pass through it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import torch
from numpy.typing import NDArray

from toolkit.base.exposure import Exposure
from toolkit.base.geometry import se3
from toolkit.io import storage
from toolkit.io.arrays import arrays_below
from toolkit.runs.batch.refining.stored_map import StoredMap
from toolkit.runs.batch.refining.tasks import Work
from toolkit.runs.folder import MapPart, RunFolder
from toolkit.runs.maps.instance_files import write_instances
from toolkit.runs.maps.map_files import splat_labels
from toolkit.runs.maps.saved_objects import load_objects
from toolkit.scene.instances.result import InstanceMap
from toolkit.slam.refinement.fusion import FusedMap, fuse_submaps, single_submap

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
        instances = _instances(source, refined, fused)
        confidence = source.settings.semantics.min_confidence

        def labelled() -> Iterator[MapPart]:
            for number, part in zip(fused.numbers, fused.parts(), strict=True):
                labels = None
                if source.taxonomy is not None:
                    # As stored: the file contains rounded features.
                    decoding = semantics.decode_gaussians(part.features.half().float())
                    labels = splat_labels(decoding, confidence)
                objects = None if instances is None else instances.ids[number]
                yield MapPart(source.unit.cloud_in_metres(part), labels, number, objects)

        folder.write_map(labelled())
        storage.upload(folder.map, storage.join(task.work.out, "map.ply"))
        if instances is not None:
            write_instances(instances, folder, source.taxonomy)
            for path in filter(Path.is_file, (folder.objects, folder.embeddings)):
                storage.upload(path, storage.join(task.work.out, path.name))
        if source.taxonomy is not None:
            for file in ("arrays.npz", "metadata.json"):
                place = storage.join(task.work.out, "semantics", file)
                storage.upload(folder.semantics / file, place)
    return Assembled(len(fused), fused.exposures)


def _instances(source: StoredMap, refined: StoredMap, fused: FusedMap) -> InstanceMap | None:
    """The objects of the map, which its submaps keep as they move; None without instances."""
    with TemporaryDirectory() as name:
        folder = RunFolder(Path(name))
        present = set(storage.names_in(source.place))
        for path in (folder.map, folder.objects, folder.embeddings):
            if path.name in present:
                path.write_bytes(storage.read_bytes(storage.join(source.place, path.name)))
        saved = load_objects(folder) if folder.objects.is_file() else None
    if saved is None:
        return None
    ids = {}
    for number, part in zip(fused.numbers, fused.parts(), strict=True):
        T_old, T_new = (
            source.unit.pose_in_metres(one.anchors[number]) for one in (source, refined)
        )
        means_m = source.unit.cloud_in_metres(part).means.double().numpy()
        ids[number] = saved.of(number, means_m, T_old @ se3.inverse(T_new))
    return saved.carried(ids, separate_parts=True)


def _fused(source: StoredMap) -> FusedMap:
    if len(source.anchors) == 1:
        return single_submap(next(iter(source.anchors)), source.submap)
    return fuse_submaps(sorted(source.anchors), source.submap)
