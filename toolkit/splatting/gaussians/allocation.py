"""Allocation of seed pixels to classes (G-III.A)."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

Distribution = Callable[[NDArray[np.integer], int], NDArray[np.int64]]


def pixels_per_class(areas: NDArray[np.integer], total: int) -> NDArray[np.int64]:
    """Distribute a number of pixels over classes in proportion to the square root of their areas.

    No class gets more pixels than it has; the remainder is distributed over the other classes in
    the same proportion. Without this limit, a class of 50 pixels could be assigned 1,900.

    Args:
        areas: [C] number of pixels of each class.
        total: number of pixels to choose; limited to the sum of the areas.

    Returns:
        Number of pixels to choose per class, [C].
    """
    areas = np.asarray(areas, np.int64)
    counts = np.zeros_like(areas)
    left = min(int(total), int(areas.sum()))
    while left > 0:
        open_classes = np.flatnonzero(counts < areas)
        weight = np.sqrt(areas[open_classes])
        wanted = left * weight / weight.sum()
        room = areas[open_classes] - counts[open_classes]
        full = wanted >= room
        if full.any():  # these classes are complete; distribute the remainder over the others
            counts[open_classes[full]] += room[full]
            left -= int(room[full].sum())
            continue
        given = np.floor(wanted).astype(np.int64)
        # Largest-remainder rounding.
        order = np.argsort(given - wanted, kind="stable")
        given[order[: left - int(given.sum())]] += 1
        counts[open_classes] += given
        left = 0
    return counts


def printed_pixels_per_class(areas: NDArray[np.integer], total: int) -> NDArray[np.int64]:
    """Distribute a number of pixels over classes as printed in G-III.A.

    No class gets more pixels than it has. The paper does not distribute the remainder, so that
    fewer pixels than `total` are chosen.

    Args:
        areas: [C] number of pixels of each class.
        total: N_tot of the paper.

    Returns:
        Number of pixels to choose per class, [C].
    """
    areas = np.asarray(areas, np.int64)
    weight = np.sqrt(areas)
    wanted = np.floor(total * weight / max(float(weight.sum()), 1.0)).astype(np.int64)
    return np.minimum(wanted, areas)


def choose_pixels(
    mask: NDArray[np.bool_],
    class_ids: NDArray[np.integer] | None,
    share: float,
    generator: np.random.Generator,
    distribute: Distribution = pixels_per_class,
) -> tuple[NDArray[np.bool_], NDArray[np.float32]]:
    """Choose a random subset of the masked pixels.

    Args:
        mask: [H, W] pixels to choose from.
        class_ids: [H, W] class ids, to choose as many pixels per class as `distribute` returns, or
            None for uniform sampling.
        share: fraction of the masked pixels to choose, in (0, 1].
        generator: source of randomness.
        distribute: from areas [C] and the total to the number of pixels per class [C].

    Returns:
        Mask of the chosen pixels [H, W], and the number of masked pixels that each chosen pixel
        represents [H, W], 1 at other pixels.
    """
    pixels = np.flatnonzero(mask)
    total = int(np.ceil(share * len(pixels)))
    ids = np.zeros(len(pixels), np.int64) if class_ids is None else class_ids.reshape(-1)[pixels]
    classes, class_index, areas = np.unique(ids, return_inverse=True, return_counts=True)
    counts = distribute(areas, total)
    chosen = np.zeros(mask.size, bool)
    area = np.ones(mask.size, np.float32)
    shuffled = generator.permutation(len(pixels))
    # The first pixels of each class in the shuffled order.
    by_class = shuffled[np.argsort(class_index[shuffled], kind="stable")]
    begin = np.cumsum(areas) - areas
    for k in range(len(classes)):
        subset = pixels[by_class[begin[k] : begin[k] + counts[k]]]
        chosen[subset] = True
        area[subset] = areas[k] / max(int(counts[k]), 1)
    return chosen.reshape(mask.shape), area.reshape(mask.shape)
