"""Clustering of classes by the shape of their objects (H-5, H-6)."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# Balancing moves an item only if this increases the distance to its cluster centre by at most this
# fraction of the distance between the two centres: 0 for an item half-way between the centres, 1
# for an item at its own centre.
_MAX_INCREASE = 0.5


def standardised(embeddings: Mapping[str, Array]) -> dict[str, Array]:
    """Return embeddings [D] with zero mean and unit variance over the classes (H-5).

    Components that are equal for all classes become 0.
    """
    if not embeddings:
        return {}
    table = np.stack(list(embeddings.values())).astype(np.float64)
    spread = table.std(axis=0)
    centred = table - table.mean(axis=0)
    table = np.where(spread > 1e-12, centred / np.where(spread > 1e-12, spread, 1.0), 0.0)
    return dict(zip(embeddings, table, strict=True))


def clusters_of(
    embeddings: Mapping[str, Array], max_clusters: int, max_items: int, seed: int = 0
) -> list[list[str]]:
    """Cluster by k-means++ with k selected by silhouette score, then balance the clusters.

    Args:
        embeddings: standardised vector [D] of each class.
        max_clusters: maximum number of clusters, >= 2.
        max_items: target maximum number of items per cluster; the minimum k follows from it,
            unless `max_clusters` is smaller.
        seed: seed of k-means++.

    Returns:
        Clusters sorted by their first name, with sorted names; one cluster if all shapes are equal.
    """
    # Imported on demand: takes seconds.
    from sklearn.cluster import KMeans
    from sklearn.metrics import silhouette_score

    names = sorted(embeddings)
    table = np.stack([embeddings[name] for name in names])
    distinct = len(np.unique(table, axis=0))
    if distinct < 2:
        return [names]
    max_clusters = min(max_clusters, distinct)
    min_clusters = min(max(2, math.ceil(len(names) / max_items)), max_clusters)
    best_score = -np.inf
    for k in range(min_clusters, max_clusters + 1):
        means = KMeans(k, init="k-means++", n_init=10, random_state=seed).fit(table)
        # The silhouette score is undefined for as many clusters as items.
        score = silhouette_score(table, means.labels_) if k < len(names) else -1.0
        if score > best_score:
            best_score, best = score, means
    labels = balanced(table, best.labels_, best.cluster_centers_, max_items)
    clusters = [[names[i] for i in np.flatnonzero(labels == c)] for c in range(best.n_clusters)]
    return sorted(cluster for cluster in clusters if cluster)


def balanced(
    table: Array, labels: NDArray[np.integer], centres: Array, max_items: int
) -> NDArray[np.integer]:
    """Return cluster indices [N] with balanced sizes.

    Items move from larger to smaller clusters, in the order of the increase in distance to the
    centre, until sizes differ by at most one or no item is close enough. The limit on the distance
    is ignored for clusters with more than `max_items` items.

    Args:
        table: embeddings [N, D].
        labels: cluster indices [N].
        centres: cluster centres [K, D].
        max_items: target maximum number of items per cluster.
    """
    labels = labels.copy()
    distances = np.linalg.norm(table[:, None] - centres[None], axis=2)
    between = np.linalg.norm(centres[:, None] - centres[None], axis=2)
    while True:
        sizes = np.bincount(labels, minlength=len(centres))
        move = _best_move(labels, distances, between, sizes, max_items)
        if move is None:
            return labels
        labels[move[0]] = move[1]


def _best_move(
    labels: NDArray[np.integer],
    distances: Array,
    between: Array,
    sizes: NDArray[np.integer],
    max_items: int,
) -> tuple[int, int] | None:
    best, best_loss = None, np.inf
    for item, own in enumerate(labels):
        for other in np.flatnonzero(sizes <= sizes[own] - 2):
            loss = float(distances[item, other] - distances[item, own])
            near = loss <= _MAX_INCREASE * between[own, other]
            if (near or sizes[own] > max_items) and loss < best_loss:
                best, best_loss = (item, int(other)), loss
    return best


def with_unmeasured(
    clusters: Sequence[Sequence[str]], unmeasured: Sequence[str], similar: Sequence[Sequence[str]]
) -> list[tuple[str, ...]]:
    """Add the items of unknown shape to the clusters.

    Args:
        clusters: clusters of the items of known shape.
        unmeasured: items of unknown shape.
        similar: groups of all items by the shape expected from their names; an unmeasured item is
            added to the cluster with the most items of its group, or to the smallest cluster.
    """
    extended = [list(cluster) for cluster in clusters]
    for name in sorted(unmeasured):
        peers = {item for group in similar if name in group for item in group}
        best = max(
            range(len(extended)),
            key=lambda n: (len(peers.intersection(clusters[n])), -len(extended[n]), -n),
        )
        extended[best].append(name)
    return [tuple(sorted(cluster)) for cluster in extended]
