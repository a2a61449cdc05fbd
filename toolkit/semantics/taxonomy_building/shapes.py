"""What is known of the shape of a class's objects."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray


class ShapeProvider(Protocol):
    """Describes the shape of classes by vectors."""

    def embeddings(self, classes: Sequence[str]) -> dict[str, NDArray[np.float64]]:
        """One vector [D] for each class whose shape is known, all of the same length.

        Raises:
            ToolkitError: the source cannot be read.
        """
        ...
