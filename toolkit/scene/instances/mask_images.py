"""Masks from a folder of images of ids, with classes, scores and embeddings beside them."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from toolkit.base.errors import DatasetError
from toolkit.base.keyframe import Keyframe
from toolkit.io.guarded.arrays import read_arrays
from toolkit.io.images import read_labels
from toolkit.io.object_embeddings import unit_rows
from toolkit.scene.instances.masks import InstanceMasks
from toolkit.semantics.segmenters.image_folder import resized_labels

_log = logging.getLogger(__name__)

# Embeddings of smaller length are zeros.
_SMALLEST = 1e-6
# Maximum length of the name of a model (`object_embeddings`).
_MAX_NAME = 200
# The columns of the masks of an image; embeddings have some kilobytes each.
_MAX_BYTES = 2**28


class MaskImageFolder:
    """Masks from files `NAME.png` of ids, 0 for no mask, and optional files `NAME.npz` beside them.

    The NPZ contains `ids` [K] and, for these ids, any of `classes` [K] (names, "" for unknown),
    `scores` [K] in [0, 1] and `embeddings` [K, D], and `model`, the name of the embeddings' model.
    Ids may restart in every frame. Frames without an image have no masks.

    Args:
        folder: folder of the files.
        files: images by frame index.
    """

    def __init__(self, folder: Path, files: Mapping[int, Path]) -> None:
        self._folder, self._files = folder, files
        self._warned = False
        self._length: tuple[int, Path] | None = None

    def class_names(self) -> set[str]:
        """Return the names of the classes in all files.

        Raises:
            DatasetError: a file cannot be read, or its content does not fit.
        """
        files = (file.with_suffix(".npz") for file in self._files.values())
        columns = (_read(file)["classes"] for file in files if file.is_file())
        return {str(name) for names in columns for name in names if name}

    def masks(self, keyframe: Keyframe) -> InstanceMasks | None:
        """Return the masks of a keyframe's file, None without one.

        Raises:
            DatasetError: a file cannot be read, or its content does not fit.
        """
        file = self._files.get(keyframe.index)
        if file is None:
            if not self._warned:
                _log.warning(
                    "%s has no masks for frame %d; frames without masks do not change objects.",
                    self._folder,
                    keyframe.index,
                )
                self._warned = True
            return None
        ids = resized_labels(read_labels(file), keyframe.camera.size, file)
        details = file.with_suffix(".npz")
        if not details.is_file():
            return InstanceMasks.of_ids(ids)
        return self._detailed(ids, details)

    def _detailed(self, ids: NDArray[np.int32], file: Path) -> InstanceMasks:
        """Masks with the columns of an NPZ, for the ids that the image contains."""
        columns = _read(file)
        listed = columns["ids"]
        found = np.unique(ids[ids != 0])
        order = np.argsort(listed, kind="stable")
        place = np.minimum(np.searchsorted(listed[order], found), max(len(listed) - 1, 0))
        known = np.zeros(len(found), bool)
        if len(listed):
            known = listed[order][place] == found
        row = order[place] if len(listed) else np.zeros(len(found), np.intp)
        classes = [
            str(columns["classes"][r]) or None if k else None
            for r, k in zip(row, known, strict=True)
        ]
        scores = np.ones(len(found), np.float32)
        embeddings = np.zeros((len(found), columns["embeddings"].shape[1]), np.float32)
        if known.any():
            scores[known] = columns["scores"][row[known]]
            embeddings[known] = self._unit(columns["embeddings"][row[known]], file)
        rows = np.where(ids == 0, 0, np.searchsorted(found, ids) + 1)
        model = str(columns["model"])
        return InstanceMasks(rows.astype(np.int32), classes, scores, embeddings, model)

    def _unit(self, embeddings: NDArray[np.float32], file: Path) -> NDArray[np.float32]:
        """Embeddings of unit length, 0 where they are 0.

        Raises:
            DatasetError: their length differs from that of earlier files.
        """
        length = embeddings.shape[1]
        if length and self._length is None:
            self._length = (length, file)
        if length and self._length is not None and length != self._length[0]:
            raise DatasetError(
                f"{file} has embeddings of length {length}, but {self._length[1].name} has "
                f"{self._length[0]}; compute all embeddings with one model"
            )
        known = np.linalg.norm(embeddings.astype(np.float64), axis=1) >= _SMALLEST
        return np.where(known[:, None], unit_rows(embeddings), np.float32(0.0))


def _read(file: Path) -> dict[str, NDArray]:
    """The columns of an NPZ, all with as many rows as `ids`.

    Raises:
        DatasetError: the file is damaged, or a column has another shape or is not finite.
    """
    try:
        arrays = read_arrays(file, max_bytes=_MAX_BYTES)
    except (OSError, ValueError) as error:
        raise DatasetError(
            f"{file} cannot be read ({error}); write it again, or delete it"
        ) from error
    ids = arrays.get("ids")
    if ids is None or ids.ndim != 1 or not np.issubdtype(ids.dtype, np.integer):
        raise DatasetError(f"{file} has no column ids [K] of integers; write it again")
    if len(np.unique(ids)) != len(ids):
        raise DatasetError(f"{file} lists an id twice; every mask needs its own id")
    count = len(ids)
    columns = {
        "ids": ids.astype(np.int64),
        "classes": arrays.get("classes", np.full(count, "")),
        "scores": arrays.get("scores", np.ones(count, np.float32)),
        "embeddings": arrays.get("embeddings", np.zeros((count, 0), np.float32)),
    }
    for name, dimensions in (("classes", 1), ("scores", 1), ("embeddings", 2)):
        column = columns[name]
        if column.ndim != dimensions or len(column) != count:
            raise DatasetError(
                f"{file}: {name} has shape {list(column.shape)} for {count} ids; write one row for "
                "each id"
            )
        if name == "classes":
            if count and column.dtype.kind != "U":
                raise DatasetError(
                    f"{file}: classes must be texts, got {column.dtype}; convert them"
                )
            continue
        if column.dtype.kind not in "fiu":
            raise DatasetError(f"{file}: {name} must be numbers, got {column.dtype}; convert them")
        with np.errstate(over="ignore"):
            columns[name] = column = column.astype(np.float32)
        if not np.isfinite(column).all():
            raise DatasetError(f"{file}: {name} has values that are not finite; write it again")
    if count and not ((columns["scores"] >= 0) & (columns["scores"] <= 1)).all():
        raise DatasetError(f"{file}: scores must lie in 0 to 1; scale them")
    columns["model"] = model = arrays.get("model", np.array(""))
    if model.dtype.kind != "U" or model.ndim or len(str(model)) > _MAX_NAME:
        raise DatasetError(
            f"{file}: model must be a name of at most {_MAX_NAME} characters; write it again"
        )
    return columns
