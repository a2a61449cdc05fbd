"""The classes of the indoor network, in the order of its outputs."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

# Groups of the bundled tree `indoor`, by kind: structure, furniture, objects.
_TREE: tuple[tuple[tuple[str, ...], ...], ...] = (
    (("floor",), ("wall",), ("ceiling",), ("door",), ("window", "blinds")),
    (("table", "desk"), ("chair",), ("sofa",), ("bed",), ("cabinet", "shelf"),
     ("appliance", "sanitary")),
    (("lamp", "screen", "picture"), ("plant", "cushion", "box", "thing")),
)  # fmt: skip

INDOOR_CLASSES: tuple[str, ...] = tuple(name for kind in _TREE for group in kind for name in group)
# Number of the kind and of the group of each class.
INDOOR_KINDS: NDArray[np.int64] = np.array(
    [number for number, kind in enumerate(_TREE) for group in kind for _ in group]
)
INDOOR_GROUPS: NDArray[np.int64] = np.array(
    [
        number
        for number, group in enumerate(group for kind in _TREE for group in kind)
        for _ in group
    ]
)
