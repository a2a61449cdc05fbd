"""Clusters of classes by the shape of their objects (H-5, H-6)."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# For balance an item moves to a cluster whose centre is at most so much farther than its own,
# as a share of the distance between the two centres: at 0 it lies half-way, at 1 it is its
# own cluster's centre.
_REACH = 0.5


def standardised(embeddings: Mapping[str, Array]) -> dict[str, Array]:
    """Embeddings [D] with zero mean and unit variance over the classes (H-5).

    What is the same for all classes becomes 0.
    """
    if not embeddings:
        return {}
    table = np.stack(list(embeddings.values())).astype(np.float64)
    spread = table.std(axis=0)
    centred = table - table.mean(axis=0)
    table = np.where(spread > 1e-12, centred / np.where(spread > 1e-12, spread, 1.0), 0.0)
    return dict(zip(embeddings, table, strict=True))


def clusters_of(
    embeddings: Mapping[str, Array], most: int, most_items: int, seed: int = 0
) -> list[list[str]]:
    """k-means++ clusters, k by silhouette score, then balanced.

    Args:
        embeddings: standardised, [D] each.
        most: clusters at most, >= 2.
        most_items: items that a cluster should have at most; fewer clusters than that needs
            are not considered, unless `most` leaves no choice.
        seed: of k-means++.

    Returns:
        Clusters by their first name, names sorted; one of all where the shapes do not differ.
    """
    # Seconds to import, and of no use without shapes.
    from sklearn.cluster import KMeans
    from sklearn.metrics import silhouette_score

    names = sorted(embeddings)
    table = np.stack([embeddings[name] for name in names])
    distinct = len(np.unique(table, axis=0))
    if distinct < 2:
        return [names]
    most = min(most, distinct)
    least = min(max(2, math.ceil(len(names) / most_items)), most)
    best_score = -np.inf
    for k in range(least, most + 1):
        means = KMeans(k, init="k-means++", n_init=10, random_state=seed).fit(table)
        # With as many clusters as items there is nothing to compare.
        score = silhouette_score(table, means.labels_) if k < len(names) else -1.0
        if score > best_score:
            best_score, best = score, means
    labels = balanced(table, best.labels_, best.cluster_centers_, most_items)
    clusters = [[names[i] for i in np.flatnonzero(labels == c)] for c in range(best.n_clusters)]
    return sorted(cluster for cluster in clusters if cluster)


def balanced(
    table: Array, labels: NDArray[np.integer], centres: Array, most_items: int
) -> NDArray[np.integer]:
    """Cluster numbers [N] after moves that bring sizes to within one item where shape allows.

    The item that loses least moves first, from a larger to a smaller cluster. Beyond
    `most_items` an item moves however far it is, while another cluster has room.

    Args:
        table: embeddings [N, D].
        labels: cluster numbers [N].
        centres: [K, D].
        most_items: items that a cluster should have at most.
    """
    labels = labels.copy()
    distances = np.linalg.norm(table[:, None] - centres[None], axis=2)
    between = np.linalg.norm(centres[:, None] - centres[None], axis=2)
    while True:
        sizes = np.bincount(labels, minlength=len(centres))
        move = _best_move(labels, distances, between, sizes, most_items)
        if move is None:
            return labels
        labels[move[0]] = move[1]


def _best_move(
    labels: NDArray[np.integer],
    distances: Array,
    between: Array,
    sizes: NDArray[np.integer],
    most_items: int,
) -> tuple[int, int] | None:
    best, best_loss = None, np.inf
    for item, own in enumerate(labels):
        for other in np.flatnonzero(sizes <= sizes[own] - 2):
            loss = float(distances[item, other] - distances[item, own])
            near = loss <= _REACH * between[own, other]
            if (near or sizes[own] > most_items) and loss < best_loss:
                best, best_loss = (item, int(other)), loss
    return best


def with_strays(
    clusters: Sequence[Sequence[str]], strays: Sequence[str], kin: Sequence[Sequence[str]]
) -> list[tuple[str, ...]]:
    """Clusters that also hold the items whose shape is unknown.

    Args:
        clusters: of the items whose shape is known.
        strays: the others.
        kin: groups of all items by what their names say of their shape; a stray joins the
            cluster that holds most of its kin, or the smallest.
    """
    grown = [list(cluster) for cluster in clusters]
    for stray in sorted(strays):
        kinsfolk = {item for group in kin if stray in group for item in group}
        place = max(
            range(len(grown)),
            key=lambda n: (len(kinsfolk.intersection(clusters[n])), -len(grown[n]), -n),
        )
        grown[place].append(stray)
    return [tuple(sorted(cluster)) for cluster in grown]
