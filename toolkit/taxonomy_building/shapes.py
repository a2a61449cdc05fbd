"""What is known of the shape of a class's objects (H-4), whatever the source.

H averages MeshGPT's codebook *indices*, but neighbouring indices are no similar shapes: all
sources here give vectors whose distances mean something.
"""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from toolkit.errors import FormatError
from toolkit.semantics.taxonomy_parsing import folded


class ShapeProvider(Protocol):
    """Describes the shape of classes by vectors."""

    def embeddings(self, classes: Sequence[str]) -> dict[str, NDArray[np.float64]]:
        """One finite vector [D] for each class whose shape is known, all of the same length.

        Raises:
            ToolkitError: the source cannot be read.
        """
        ...


class GivenShapes:
    """Vectors that are at hand.

    Args:
        vectors: by class name; case, hyphens and spaces do not matter.
    """

    def __init__(self, vectors: Mapping[str, Sequence[float] | NDArray]) -> None:
        self._vectors = {folded(n): np.asarray(v, np.float64) for n, v in vectors.items()}

    def embeddings(self, classes: Sequence[str]) -> dict[str, NDArray[np.float64]]:
        """The vectors of those classes that have one."""
        return {c: self._vectors[folded(c)] for c in classes if folded(c) in self._vectors}


def read_shape_table(path: str | Path) -> GivenShapes:
    """A table of vectors, one row a class.

    CSV: a name and numbers in every line; a first line whose cells are no numbers is a
    heading. JSON: {"name": [numbers], ...}.

    Raises:
        FormatError: the file is missing or no such table, or rows differ in length.
    """
    path = Path(path)
    try:
        text = path.read_text(encoding="utf-8-sig")
        rows = _json_rows(text) if path.suffix == ".json" else _csv_rows(text)
    except (OSError, UnicodeDecodeError, json.JSONDecodeError, csv.Error) as error:
        raise FormatError(f"{path}: cannot be read as a table of shapes ({error})") from error
    if not rows:
        raise FormatError(f"{path}: holds no shape; give a row 'class, number, ...' for each class")
    table: dict[str, list[float]] = {}
    for name, cells in rows:
        numbers = [_number(cell) for cell in cells]
        if not numbers or not all(map(math.isfinite, numbers)):
            raise FormatError(f"{path}: the row of '{name}' must hold finite numbers alone")
        if len(numbers) != len(rows[0][1]):
            raise FormatError(
                f"{path}: '{name}' has {len(numbers)} numbers, the first row {len(rows[0][1])}"
            )
        if folded(name) in table:
            raise FormatError(f"{path}: '{name}' has two rows; leave one out")
        table[folded(name)] = numbers
    return GivenShapes(table)


def _json_rows(text: str) -> list[tuple[str, list[Any]]]:
    values = json.loads(text)
    if not isinstance(values, dict):
        return []
    return [(name, v if isinstance(v, list) else []) for name, v in values.items()]


def _csv_rows(text: str) -> list[tuple[str, list[Any]]]:
    rows = [(row[0].strip(), list(row[1:])) for row in csv.reader(text.splitlines()) if row]
    if rows and rows[0][1] and all(math.isnan(_number(cell)) for cell in rows[0][1]):
        del rows[0]  # the heading
    return rows


def _number(cell: object) -> float:
    """A cell's number, or NaN."""
    try:
        return float(cell) if isinstance(cell, str | int | float) else math.nan
    except ValueError:
        return math.nan
