"""Valid class ids of a source of labels."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from toolkit.base.errors import DatasetError

_MAX_LISTED = 5


class ClassVocabulary:
    """Class names by id, and the check of label images against them.

    Args:
        names: class names by id, without void, which is 0.
        source: name of their source in errors.

    Attributes:
        names: class names by id.

    Raises:
        DatasetError: there are no names, or an id is below 1.
    """

    def __init__(self, names: Mapping[int, str], source: str) -> None:
        if not names:
            raise DatasetError(f"{source} contains no class; at least one is required")
        if min(names) < 1:
            raise DatasetError(f"{source} has class id {min(names)}; ids start at 1, 0 is void")
        self.names = dict(names)
        self._source = source
        self._known = np.zeros(max(names) + 1, dtype=bool)
        self._known[[0, *names]] = True

    def check(self, labels: NDArray[np.integer], what: str) -> None:
        """Check that a label image [H, W] contains only known ids.

        Args:
            labels: [H, W] class ids.
            what: name of the image in errors.

        Raises:
            DatasetError: an id has no name.
        """
        if labels.size == 0:
            return
        smallest, largest = int(labels.min()), int(labels.max())
        if smallest >= 0 and largest < len(self._known) and self._known[labels].all():
            return
        found = [int(n) for n in np.unique(labels) if n != 0 and int(n) not in self.names]
        listed = ", ".join(map(str, found[:_MAX_LISTED]))
        more = f" and {len(found) - _MAX_LISTED} more" if len(found) > _MAX_LISTED else ""
        raise DatasetError(
            f"{what} contains class id(s) {listed}{more} without a name; name them in "
            f"{self._source}, or replace them by 0 (void)"
        )
