"""The objects of a finished map in its run folder: `objects.json`, and `objects.npz`."""

from __future__ import annotations

import numpy as np

from toolkit.io.object_embeddings import ObjectEmbeddings, write_objects
from toolkit.io.splat_labels import SplatLabels, instances_in
from toolkit.io.splats import Splats, read_splats
from toolkit.runs.folder import RunFolder
from toolkit.runs.maps.map_files import object_values
from toolkit.runs.maps.object_embedding import collected
from toolkit.runs.maps.splat_clouds import cloud_of
from toolkit.scene.graph.boxes import oriented_box
from toolkit.scene.instances.result import InstanceMap
from toolkit.scene.query import LabelledMap
from toolkit.semantics.embedding_fusion import FusedEmbedding
from toolkit.semantics.options import ObjectOptions
from toolkit.semantics.taxonomy import VOID, Taxonomy

# Name of the model in `objects.npz` if the masks do not name it.
UNNAMED = "masks"


def write_instances(instances: InstanceMap, folder: RunFolder, taxonomy: Taxonomy | None) -> None:
    """Write the objects of a map whose `map.ply` is written, and the embeddings of their masks.

    Raises:
        RunFolderError: a file cannot be written.
    """
    folder.write_json(folder.objects, object_values(instances, taxonomy))
    embedded = mask_embeddings(instances, folder, taxonomy)
    if embedded is not None:
        write_objects(folder.embeddings, embedded)


def mask_embeddings(
    instances: InstanceMap, folder: RunFolder, taxonomy: Taxonomy | None
) -> ObjectEmbeddings | None:
    """Return the embeddings of the objects of a written map, None if their masks have none.

    Objects are numbered as `semsplat query --summary` lists them; in a map without labels, which
    cannot be listed, as in `objects.json`.

    Args:
        instances: objects of the map.
        folder: run folder with `map.ply`.
        taxonomy: classes of the map, None for a map without labels.
    """
    fused = {one.number: one.embedding for one in instances.objects if one.embedding is not None}
    if not fused:
        return None
    splats, model = read_splats(folder.map), instances.model or UNNAMED
    labels = splats.labels
    if labels is None or taxonomy is None:
        return _unlabelled(splats, fused, model)
    return _listed(splats, labels, taxonomy, fused, model)


def _listed(
    splats: Splats,
    labels: SplatLabels,
    taxonomy: Taxonomy,
    fused: dict[int, FusedEmbedding],
    model: str,
) -> ObjectEmbeddings | None:
    """Embeddings of the objects that queries list; those with too few Gaussians are left out."""
    cloud = cloud_of(splats)
    map_ = LabelledMap(splats.means.astype(np.float64), labels, taxonomy, cloud.axes_m())
    objects = map_.objects(None, map_.ground(), ObjectOptions())
    found = {n: fused[one.instance] for n, one in enumerate(objects) if one.instance in fused}
    return collected(objects, found, model) if found else None


def _unlabelled(
    splats: Splats, fused: dict[int, FusedEmbedding], model: str
) -> ObjectEmbeddings | None:
    means_m, ids = splats.means.astype(np.float64), instances_in(splats.extra)
    numbers = [] if ids is None else [n for n in sorted(fused) if (ids == n).any()]
    if not numbers:
        return None
    centres_m = [oriented_box(means_m[ids == n], None).centre_m for n in numbers]
    column = np.array(numbers, np.int32)
    return ObjectEmbeddings(
        column,
        np.full(len(numbers), VOID, np.int32),
        np.stack([fused[n].embedding for n in numbers]),
        np.array([fused[n].weight for n in numbers], np.float32),
        model,
        np.array(centres_m, np.float32),
        column,
    )
