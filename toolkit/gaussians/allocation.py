"""How many of a frame's pixels each class may seed (G-III.A)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def pixels_per_class(areas: NDArray[np.integer], total: int) -> NDArray[np.int64]:
    """Shares of `total` in proportion to the square root of areas, whole numbers.

    No class gets more pixels than it has; what is left over goes to the others in the same
    proportion (uncapped, a class of 50 pixels would be asked for 1,900).

    Args:
        areas: [C] pixels of each class.
        total: pixels to choose, at most as many as there are.
    """
    areas = np.asarray(areas, np.int64)
    counts = np.zeros_like(areas)
    left = min(int(total), int(areas.sum()))
    while left > 0:
        open_classes = np.flatnonzero(counts < areas)
        share = np.sqrt(areas[open_classes])
        wanted = left * share / share.sum()
        room = areas[open_classes] - counts[open_classes]
        full = wanted >= room
        if full.any():  # these are settled; the rest shares what they leave
            counts[open_classes[full]] += room[full]
            left -= int(room[full].sum())
            continue
        given = np.floor(wanted).astype(np.int64)
        # The largest remainders get the pixels that rounding left.
        order = np.argsort(given - wanted, kind="stable")
        given[order[: left - int(given.sum())]] += 1
        counts[open_classes] += given
        left = 0
    return counts


def choose_pixels(
    mask: NDArray[np.bool_],
    class_ids: NDArray[np.integer] | None,
    share: float,
    generator: np.random.Generator,
) -> tuple[NDArray[np.bool_], NDArray[np.float32]]:
    """A random part of the masked pixels, and how much area each of them stands for.

    Args:
        class_ids: [H, W] for as many of each class as `pixels_per_class` says, or None for
            the same share everywhere.
        share: of the masked pixels to choose, in (0, 1].

    Returns:
        Chosen pixels [H, W], and masked pixels per chosen one [H, W], 1 where nothing is.
    """
    pixels = np.flatnonzero(mask)
    total = int(np.ceil(share * len(pixels)))
    ids = np.zeros(len(pixels), np.int64) if class_ids is None else class_ids.reshape(-1)[pixels]
    classes, place, areas = np.unique(ids, return_inverse=True, return_counts=True)
    counts = pixels_per_class(areas, total)
    chosen = np.zeros(mask.size, bool)
    area = np.ones(mask.size, np.float32)
    shuffled = generator.permutation(len(pixels))
    # Within the shuffled order, the first so many of each class.
    by_class = shuffled[np.argsort(place[shuffled], kind="stable")]
    begin = np.cumsum(areas) - areas
    for k in range(len(classes)):
        taken = pixels[by_class[begin[k] : begin[k] + counts[k]]]
        chosen[taken] = True
        area[taken] = areas[k] / max(int(counts[k]), 1)
    return chosen.reshape(mask.shape), area.reshape(mask.shape)
