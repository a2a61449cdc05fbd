"""Embeddings of the objects of a map, in the file `objects.npz` of a run folder.

Arrays of the file (NumPy, without pickle):

| name | type | content |
|---|---|---|
| `ids` | int32 [K] | number of each object, unique |
| `class_ids` | int32 [K] | class of each object in the taxonomy of the run, 0 if unknown |
| `weights` | float32 [K] | weight of the views that an embedding was fused from, 0 or more |
| `model` | text | name of the model; texts must be embedded by the same one |
| `embeddings` | float16 [K, D] | unit length; or, if compressed: |
| `codes`, `codebooks` | uint8 [K, M], float16 [M, C, D / M] | row of each part's codebook |
| `centres_m` | float32 [K, 3] | optional: position of each object in the map, in metres |
| `instances` | int32 [K] | optional: number of each object in `objects.json`, 0 for none |
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from toolkit.base.errors import FormatError
from toolkit.io.atomic import replacing
from toolkit.io.guarded.arrays import read_arrays

OBJECTS = "objects.npz"

# Rounding to 16 bits changes the length of a vector by less.
_UNIT_TOLERANCE = 1e-2
_MAX_NAME = 200
_REMEDY = "write it again with the program that made it"

Codes = NDArray[np.uint8]


@dataclass(frozen=True)
class CompressedEmbeddings:
    """Embeddings as rows of codebooks (product quantisation).

    Attributes:
        codes: [K, M] uint8, row in the codebook of each of M parts.
        codebooks: [M, C, D / M] float16.
    """

    codes: Codes
    codebooks: NDArray[np.float16]

    def decoded(self) -> NDArray[np.float32]:
        """Return the embeddings [K, D], of unit length."""
        parts = [book[row] for book, row in zip(self.codebooks, self.codes.T, strict=True)]
        return unit_rows(np.concatenate(parts, axis=1).astype(np.float32))


@dataclass(frozen=True)
class ObjectEmbeddings:
    """Objects with embeddings.

    Attributes:
        ids: [K] int32, unique.
        class_ids: [K] int32, 0 for objects of unknown class.
        embeddings: [K, D] float32, unit length.
        weights: [K] float32, 0 or more.
        model: name of the model that made the embeddings.
        centres_m: [K, 3] float32, positions in the map, in metres, or None.
        instances: [K] int32, numbers in `objects.json`, 0 for objects found by connection; None
            for a map without instances.

    Raises:
        FormatError: shapes differ, a value is not finite or out of range, an id appears twice, a
            vector has another length, or the name is empty or too long.
    """

    ids: NDArray[np.int32]
    class_ids: NDArray[np.int32]
    embeddings: NDArray[np.float32]
    weights: NDArray[np.float32]
    model: str
    centres_m: NDArray[np.float32] | None = None
    instances: NDArray[np.int32] | None = None

    def __post_init__(self) -> None:
        count = len(self.ids)
        shapes: dict[str, tuple[int, ...]] = {"centres_m": (count, 3)}
        shapes |= dict.fromkeys(("class_ids", "weights", "instances"), (count,))
        for name, shape in shapes.items():
            array = getattr(self, name)
            if array is not None and array.shape != shape:
                raise FormatError(f"'{name}' must have shape {list(shape)}, got {_shape(array)}")
        if self.embeddings.ndim != 2 or self.embeddings.shape[0] != count or self.dimensions < 1:
            raise FormatError(
                f"'embeddings' must have shape [{count}, D], got {_shape(self.embeddings)}"
            )
        if not 0 < len(self.model) <= _MAX_NAME:
            raise FormatError(f"'model' must have 1 to {_MAX_NAME} characters")
        self._check_values()

    def _check_values(self) -> None:
        unique, counts = np.unique(self.ids, return_counts=True)
        if (counts > 1).any():
            raise FormatError(f"object {unique[counts > 1][0]} appears twice in 'ids'")
        if (self.class_ids < 0).any():
            raise FormatError(f"'class_ids' contains {self.class_ids.min()}")
        for name in ("embeddings", "weights", "centres_m"):
            array = getattr(self, name)
            if array is not None and not np.isfinite(array).all():
                row = int(np.argmax(~np.isfinite(array).reshape(len(array), -1).all(axis=1)))
                raise FormatError(f"'{name}' of object {self.ids[row]} is not finite")
        if (self.weights < 0).any():
            raise FormatError(f"'weights' contains {self.weights.min():g}")
        norms = np.linalg.norm(self.embeddings, axis=1)
        wrong = np.flatnonzero(np.abs(norms - 1) > _UNIT_TOLERANCE)
        if len(wrong):
            raise FormatError(
                f"the embedding of object {self.ids[wrong[0]]} has length {norms[wrong[0]]:.3g}; "
                "embeddings must have length 1"
            )

    def __len__(self) -> int:
        """Number of objects."""
        return len(self.ids)

    @property
    def dimensions(self) -> int:
        """Length D of an embedding."""
        return int(self.embeddings.shape[1])


def write_objects(
    path: str | os.PathLike[str],
    objects: ObjectEmbeddings,
    compressed: CompressedEmbeddings | None = None,
) -> None:
    """Write objects with embeddings of 16 bits per value; equal content gives equal bytes.

    Args:
        path: the file, `objects.npz` in a run folder.
        objects: the objects.
        compressed: their embeddings in compressed form, which are written instead.

    Raises:
        RunFolderError: the file cannot be written.
        ValueError: the compressed embeddings are of other objects.
    """
    arrays: dict[str, NDArray] = {
        "ids": objects.ids.astype(np.int32),
        "class_ids": objects.class_ids.astype(np.int32),
        "weights": objects.weights.astype(np.float32),
        "model": np.array(objects.model),
    }
    if compressed is None:
        arrays["embeddings"] = objects.embeddings.astype(np.float16)
    elif compressed.decoded().shape != objects.embeddings.shape:
        raise ValueError("the compressed embeddings are of other objects")
    else:
        arrays |= {"codes": compressed.codes, "codebooks": compressed.codebooks}
    if objects.centres_m is not None:
        arrays["centres_m"] = objects.centres_m.astype(np.float32)
    if objects.instances is not None:
        arrays["instances"] = objects.instances.astype(np.int32)
    with replacing(path) as temporary, temporary.open("wb") as file:
        np.savez_compressed(file, allow_pickle=False, **arrays)


def read_objects(path: str | os.PathLike[str]) -> ObjectEmbeddings:
    """Read and check objects with embeddings.

    Raises:
        FormatError: the file is missing, damaged, or its content is inconsistent.
    """
    path = Path(path)
    if not path.is_file():
        raise FormatError(
            f"{path} does not exist: the run has no embeddings of objects; make them with: "
            "semsplat embed-objects RUN --encoder DIR"
        )
    try:
        arrays = read_arrays(path)
    except (OSError, ValueError) as error:
        raise FormatError(f"{path} is not a readable .npz file; {_REMEDY}") from error
    try:
        return _objects(arrays)
    except FormatError as error:
        raise FormatError(f"{path}: {error}; {_REMEDY}") from None


def unit_rows(vectors: NDArray[np.floating]) -> NDArray[np.float32]:
    """Return vectors [K, D] scaled to length 1; those of length 0 remain."""
    norms = np.linalg.norm(vectors.astype(np.float64), axis=1, keepdims=True)
    return (vectors / np.where(norms > 0, norms, 1.0)).astype(np.float32)


def _objects(arrays: dict[str, NDArray]) -> ObjectEmbeddings:
    ids, class_ids = (_array(arrays, name, "iu", 1) for name in ("ids", "class_ids"))
    model = _array(arrays, "model", "U", 0)
    if "codes" in arrays:
        embeddings = _compressed(arrays).decoded()
    else:
        embeddings = _array(arrays, "embeddings", "f", 2).astype(np.float32)
    centres_m = _array(arrays, "centres_m", "f", 2) if "centres_m" in arrays else None
    instances = _array(arrays, "instances", "iu", 1) if "instances" in arrays else None
    return ObjectEmbeddings(
        ids.astype(np.int32),
        class_ids.astype(np.int32),
        embeddings,
        _array(arrays, "weights", "f", 1).astype(np.float32),
        str(model),
        None if centres_m is None else centres_m.astype(np.float32),
        None if instances is None else instances.astype(np.int32),
    )


def _compressed(arrays: dict[str, NDArray]) -> CompressedEmbeddings:
    codes, books = _array(arrays, "codes", "u", 2), _array(arrays, "codebooks", "f", 3)
    if len(books) != codes.shape[1] or codes.max(initial=0) >= books.shape[1]:
        raise FormatError(f"'codes' {_shape(codes)} do not fit to 'codebooks' {_shape(books)}")
    return CompressedEmbeddings(codes.astype(np.uint8), books.astype(np.float16))


def _array(arrays: dict[str, NDArray], name: str, kinds: str, dimensions: int) -> NDArray:
    if name not in arrays:
        raise FormatError(f"the array '{name}' is missing")
    array = arrays[name]
    if array.dtype.kind not in kinds or array.ndim != dimensions:
        raise FormatError(
            f"'{name}' must have {dimensions} dimensions and a type of kind {kinds}, got "
            f"{array.dtype} {_shape(array)}"
        )
    return array


def _shape(array: NDArray) -> str:
    return str(list(array.shape))
