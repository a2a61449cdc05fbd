"""The classes of the indoor network, in the order of its outputs, and their tree."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

# The bundled tree `indoor`: kinds, groups, classes.
INDOOR_TREE: dict[str, dict[str, tuple[str, ...]]] = {
    "structure": {
        "floor": (),
        "wall": (),
        "ceiling": (),
        "door": (),
        "windows": ("window", "blinds"),
    },
    "furniture": {
        "tables": ("table", "desk"),
        "chair": (),
        "sofa": (),
        "bed": (),
        "storage": ("cabinet", "shelf"),
        "fixtures": ("appliance", "sanitary"),
        "other furniture": (),
    },
    "object": {
        "fittings": ("lamp", "screen", "picture"),
        "things": ("plant", "cushion", "box", "thing"),
    },
}

# Furniture of which only that is sure; the network does not know it.
OTHER_FURNITURE = "other furniture"

_PATHS: tuple[tuple[int, str, str], ...] = tuple(
    (number, group, name)
    for number, groups in enumerate(INDOOR_TREE.values())
    for group, names in groups.items()
    for name in names or (group,)
    if group != OTHER_FURNITURE
)
INDOOR_CLASSES: tuple[str, ...] = tuple(name for _, _, name in _PATHS)
# Number of the kind and of the group of each class.
INDOOR_KINDS: NDArray[np.int64] = np.array([kind for kind, _, _ in _PATHS])
_GROUPS = list(dict.fromkeys(group for _, group, _ in _PATHS))
INDOOR_GROUPS: NDArray[np.int64] = np.array([_GROUPS.index(group) for _, group, _ in _PATHS])
