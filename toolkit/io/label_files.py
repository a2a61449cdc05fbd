"""Labels, objects and class trees beside splat files without room: `map.sog.labels.npz`.

The file is an archive of NumPy arrays. Row i belongs to splat i of the splat file. A map has labels
(the first three), objects (`instances`), or both. A `.ply` contains these columns, and has only its
class tree beside it:

- `label` [N] int32, class ids, 0 for void; `class_names` [C] are the names by id
- `levels` [N, L] int32, nodes of the class tree at each level; -1 is void or uncertain
- `confidence` [N] float32 in [0, 1]
- `instances` [N] int32, the object of each splat, 0 for none; only in maps with instances
- `taxonomy`, the class tree as JSON text
- `splats_sha256`, the digest of the splat file
"""

from __future__ import annotations

import hashlib
import io
import json
import logging
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toolkit.io.atomic import write_bytes
from toolkit.io.guarded.arrays import read_arrays
from toolkit.io.guarded.documents import parse_json
from toolkit.io.splat_columns import Order
from toolkit.io.splat_labels import INSTANCE, SplatLabels, instances_in

_log = logging.getLogger(__name__)

_VOID = "void"
# Bytes of the class tree, and of the labels of a splat in a tree of many levels.
_ANY_BYTES, _MAX_ROW = 2**26, 256
_LABELS = ("label", "levels", "confidence")


@dataclass(frozen=True)
class LabelFile:
    """Labels and objects read from beside a splat file.

    Attributes:
        columns: of all splats [N], as `SplatLabels.columns` and `INSTANCE` name them; none beside
            a file that contains them.
        taxonomy: JSON values of the class tree; None if the file has none.
    """

    columns: dict[str, NDArray]
    taxonomy: dict[str, Any] | None


def label_file_of(splat_file: Path) -> Path:
    """The name of the file with the labels of a splat file."""
    return splat_file.with_name(f"{splat_file.name}.labels.npz")


def write_label_file(
    splat_file: Path,
    columns: Mapping[str, NDArray],
    taxonomy: Mapping[str, Any] | None,
    order: Order,
) -> None:
    """Write labels, objects and class tree of a splat file, or remove those of an earlier one.

    Args:
        splat_file: the splat file, which exists already.
        columns: additional columns [N] of the splats before they were written, by name.
        taxonomy: JSON values of the class tree (`Taxonomy.to_json`).
        order: rows of the splat file, as indices of the labels; None if they have the same order.

    Raises:
        RunFolderError: the file cannot be written.
    """
    path = label_file_of(splat_file)
    if order is not None:
        columns = {name: column[order] for name, column in columns.items()}
    labels, instances = SplatLabels.from_columns(columns), instances_in(columns)
    if labels is None and instances is None and taxonomy is None:
        path.unlink(missing_ok=True)
        return
    arrays: dict[str, Any] = {"splats_sha256": np.array(_digest(splat_file))}
    if labels is not None:
        arrays |= {name: getattr(labels, name) for name in _LABELS}
    if instances is not None:
        arrays["instances"] = instances
    if taxonomy is not None:
        arrays["class_names"] = np.array([_VOID, *taxonomy["classes"]])
        arrays["taxonomy"] = np.array(json.dumps(taxonomy, ensure_ascii=False))
    content = io.BytesIO()
    np.savez_compressed(content, allow_pickle=False, **arrays)
    write_bytes(path, content.getvalue())


def read_label_file(splat_file: Path, count: int) -> LabelFile | None:
    """Read the labels beside a splat file; None, with a warning, if they are not those of the file.

    Args:
        splat_file: the splat file.
        count: number of its splats.
    """
    path = label_file_of(splat_file)
    if not path.is_file():
        return None
    try:
        arrays = read_arrays(path, max_bytes=_ANY_BYTES + _MAX_ROW * count)
        columns = _columns(arrays)
        taxonomy = parse_json(str(arrays["taxonomy"])) if "taxonomy" in arrays else None
        digest = str(arrays["splats_sha256"])
    except (OSError, ValueError, KeyError, IndexError, TypeError) as error:
        _log.warning("%s cannot be read and is ignored (%s); export the map again.", path, error)
        return None
    rows = len(next(iter(columns.values()))) if columns else count
    if rows != count:
        reason = f"it has labels of {rows} splats, but {splat_file.name} contains {count}"
    elif digest != _digest(splat_file):
        reason = f"{splat_file.name} was changed after it was exported"
    else:
        return LabelFile(columns, taxonomy)
    _log.warning("%s is ignored: %s; export the map again.", path, reason)
    return None


def _columns(arrays: Mapping[str, NDArray]) -> dict[str, NDArray]:
    """The columns in a file; none if it contains only a class tree."""
    if "taxonomy" in arrays and not any(name in arrays for name in (*_LABELS, "instances")):
        return {}
    instances = arrays["instances"].astype(np.int32) if "instances" in arrays else None
    if instances is not None and not any(name in arrays for name in _LABELS):
        if instances.ndim != 1:
            raise ValueError(f"instances must have shape [N], got {list(instances.shape)}")
        return {INSTANCE: instances}
    return SplatLabels(
        arrays["label"].astype(np.int32),
        arrays["levels"].astype(np.int32),
        arrays["confidence"].astype(np.float32),
        instances,
    ).columns()


def _digest(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
