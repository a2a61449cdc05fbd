"""The class ids that a source of labels may use."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from toolkit.errors import DatasetError

_MOST_NAMED = 5


class Vocabulary:
    """Class names by id, and the check that label images keep to them.

    Args:
        names: class names by id, without void, which is 0.
        source: where the names are from, for errors.

    Attributes:
        names: the same.

    Raises:
        DatasetError: there are no names, or an id below 1.
    """

    def __init__(self, names: Mapping[int, str], source: str) -> None:
        if not names:
            raise DatasetError(f"{source} names no class; it must hold at least one")
        if min(names) < 1:
            raise DatasetError(f"{source} has class id {min(names)}; ids count from 1, 0 is void")
        self.names = dict(names)
        self._source = source
        self._known = np.zeros(max(names) + 1, dtype=bool)
        self._known[[0, *names]] = True

    def check(self, labels: NDArray[np.integer], what: str) -> None:
        """See that a label image [H, W] holds only known ids.

        Args:
            what: the image, for the error.

        Raises:
            DatasetError: an id has no name.
        """
        if labels.size == 0:
            return
        smallest, largest = int(labels.min()), int(labels.max())
        if smallest >= 0 and largest < len(self._known) and self._known[labels].all():
            return
        found = [int(n) for n in np.unique(labels) if n != 0 and int(n) not in self.names]
        listed = ", ".join(map(str, found[:_MOST_NAMED]))
        more = f" and {len(found) - _MOST_NAMED} more" if len(found) > _MOST_NAMED else ""
        raise DatasetError(
            f"{what} holds class id(s) {listed}{more} without a name; name them in "
            f"{self._source}, or make them 0 (void)"
        )
