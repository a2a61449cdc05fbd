"""Shape embeddings of classes (H-4).

Hier-SLAM averages MeshGPT's codebook *indices*, which have no metric: neighbouring indices are not
similar shapes. The providers in this package return vectors in a metric space.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from toolkit.base.errors import FormatError
from toolkit.io.guarded.documents import parse_json
from toolkit.io.user_files import read_text
from toolkit.semantics.taxonomy_parsing import folded


class ShapeProvider(Protocol):
    """Source of shape embeddings of classes."""

    def embeddings(self, classes: Sequence[str]) -> dict[str, NDArray[np.float64]]:
        """Return a finite vector [D] for each class of known shape, all of the same length.

        Raises:
            ToolkitError: the source cannot be read.
        """
        ...


class GivenShapes:
    """Given vectors.

    Args:
        vectors: vectors by class name; names are compared without case, hyphens and spaces.
    """

    def __init__(self, vectors: Mapping[str, Sequence[float] | NDArray]) -> None:
        self._vectors = {folded(n): np.asarray(v, np.float64) for n, v in vectors.items()}

    def embeddings(self, classes: Sequence[str]) -> dict[str, NDArray[np.float64]]:
        """Return the vectors of the classes that have one."""
        return {c: self._vectors[folded(c)] for c in classes if folded(c) in self._vectors}


def read_shape_table(path: str | Path) -> GivenShapes:
    """Read a table of vectors with one row per class.

    CSV: a name and numbers in every line; a first line without numbers is a header.
    JSON: {"name": [numbers], ...}.

    Raises:
        FormatError: the file is missing or not a valid table, or rows differ in length.
    """
    path = Path(path)
    try:
        text = read_text(path)
        rows = _json_rows(text) if path.suffix == ".json" else _csv_rows(text)
    except (OSError, ValueError, csv.Error) as error:
        raise FormatError(f"{path}: cannot be read as a table of shapes ({error})") from error
    if not rows:
        raise FormatError(
            f"{path}: contains no shape; write a row 'class, number, ...' for each class"
        )
    table: dict[str, list[float]] = {}
    for name, cells in rows:
        numbers = [_number(cell) for cell in cells]
        if not numbers or not all(map(math.isfinite, numbers)):
            raise FormatError(f"{path}: the row of '{name}' must contain only finite numbers")
        if len(numbers) != len(rows[0][1]):
            raise FormatError(
                f"{path}: '{name}' has {len(numbers)} numbers, the first row {len(rows[0][1])}"
            )
        if folded(name) in table:
            raise FormatError(f"{path}: '{name}' has two rows; remove one")
        table[folded(name)] = numbers
    return GivenShapes(table)


def _json_rows(text: str) -> list[tuple[str, list[Any]]]:
    values = parse_json(text)
    if not isinstance(values, dict):
        return []
    return [(name, v if isinstance(v, list) else []) for name, v in values.items()]


def _csv_rows(text: str) -> list[tuple[str, list[Any]]]:
    rows = [(row[0].strip(), list(row[1:])) for row in csv.reader(text.splitlines()) if row]
    if rows and rows[0][1] and all(math.isnan(_number(cell)) for cell in rows[0][1]):
        del rows[0]  # the header
    return rows


def _number(cell: object) -> float:
    """Return the number in a cell, or NaN."""
    try:
        return float(cell) if isinstance(cell, str | int | float) else math.nan
    except ValueError:
        return math.nan
