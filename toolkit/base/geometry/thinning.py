"""Some of many points or other rows, where these suffice."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeVar

from numpy.typing import NDArray

Rows = TypeVar("Rows", NDArray[Any], Sequence[Any])


def thinned(rows: Rows, count: int) -> Rows:
    """Return every n-th row from the first one: `count` to 2 `count`, or all if there are fewer."""
    return rows[:: max(1, len(rows) // count)]
