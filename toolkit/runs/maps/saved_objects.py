"""Read the objects of a finished run, to pass them on to a later map."""

from __future__ import annotations

import logging
from typing import Any

import numpy as np

from toolkit.base.errors import FormatError
from toolkit.io.guarded.documents import read_json
from toolkit.io.object_embeddings import ObjectEmbeddings, read_objects
from toolkit.io.splat_labels import instances_in
from toolkit.io.splats import read_splats
from toolkit.runs.folder import RunFolder
from toolkit.runs.maps.instance_files import UNNAMED
from toolkit.scene.instances.result import MapObject
from toolkit.scene.instances.saved import SavedObjects
from toolkit.semantics.embedding_fusion import FusedEmbedding

_log = logging.getLogger(__name__)


def load_objects(folder: RunFolder) -> SavedObjects | None:
    """Read the objects of a map and those of its Gaussians; None for a map without instances.

    A map that another program has written without their column loses them, with a warning.

    Raises:
        FormatError: a file is damaged, or they do not belong together.
    """
    if not folder.objects.is_file():
        return None
    splats = read_splats(folder.map)
    ids, submap = instances_in(splats.extra), splats.extra.get("submap")
    if ids is None or submap is None:
        _log.warning(
            "%s has no columns instance and submap; the objects of %s are not kept.",
            folder.map,
            folder.objects,
        )
        return None
    embedded = read_objects(folder.embeddings) if folder.embeddings.is_file() else None
    embeddings = _by_instance(embedded)
    try:
        content = read_json(folder.objects)
        objects = [_object(row, embeddings) for row in content["objects"]]
    except (OSError, KeyError, TypeError, ValueError) as error:
        raise FormatError(f"{folder.objects} is damaged ({error!r}); run again") from error
    numbers = {one.number for one in objects}
    unknown = set(np.unique(ids).tolist()) - numbers - {0}
    if unknown or len(numbers) != len(objects) or min(numbers, default=1) < 1:
        raise FormatError(
            f"{folder.objects} does not belong to {folder.map}: their objects differ; restore both "
            "files of one run"
        )
    means_m = splats.means.astype(np.float64)
    model = embedded.model if embedded is not None and embeddings else ""
    model = "" if model == UNNAMED else model
    return SavedObjects(objects, means_m, ids, submap.astype(np.int32), model)


def _object(row: dict[str, Any], embeddings: dict[int, FusedEmbedding]) -> MapObject:
    number = int(row["id"])
    return MapObject(
        number,
        None if row["class"] is None else str(row["class"]),
        int(row["gaussians"]),
        float(row["score"]),
        int(row["views"]),
        int(row["first_keyframe"]),
        int(row["last_keyframe"]),
        embeddings.get(number),
    )


def _by_instance(objects: ObjectEmbeddings | None) -> dict[int, FusedEmbedding]:
    """Embeddings by the number of the object; none if they are not of instances."""
    if objects is None or objects.instances is None:
        return {}
    one = np.ones(1, bool)
    rows = zip(objects.instances, objects.embeddings, objects.weights, strict=True)
    return {int(n): FusedEmbedding(e, float(w), one, 1.0) for n, e, w in rows if n > 0}
