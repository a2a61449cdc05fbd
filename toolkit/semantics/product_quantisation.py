"""Compression of embeddings by product quantisation (Jegou et al. 2011), with FAISS's k-means."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from toolkit.io.object_embeddings import CompressedEmbeddings
from toolkit.semantics.features.faiss_library import faiss

_MAX_CODEWORDS = 256  # a code has 8 bits
_ITERATIONS = 25


def compress(
    embeddings: NDArray[np.float32], parts: int, codewords: int = _MAX_CODEWORDS, seed: int = 0
) -> CompressedEmbeddings:
    """Compress embeddings: each part of a vector becomes the number of the nearest codeword.

    A vector takes `parts` bytes instead of 2 D, and the codebooks 2 D bytes for each codeword: with
    256 codewords, this saves space from about 300 objects on.

    Args:
        embeddings: [K, D], unit length.
        parts: number M of parts, a divisor of D.
        codewords: number C of codewords of each part, at most 256 and at most K.
        seed: of the initial codewords.

    Raises:
        DependencyError: FAISS cannot be loaded.
        ValueError: there are no embeddings, or a number is out of range.
    """
    count, dimensions = embeddings.shape
    if count == 0:
        raise ValueError("there are no embeddings to compress")
    if parts < 1 or dimensions % parts:
        raise ValueError(f"{dimensions} dimensions cannot be divided into {parts} parts")
    if not 1 <= codewords <= _MAX_CODEWORDS:
        raise ValueError(f"codewords must be in 1..{_MAX_CODEWORDS}, got {codewords}")
    codewords = min(codewords, count)
    width = dimensions // parts
    codes = np.empty((count, parts), np.uint8)
    books = np.empty((parts, codewords, width), np.float16)
    for part in range(parts):
        values = np.ascontiguousarray(embeddings[:, part * width : (part + 1) * width], np.float32)
        clusters = faiss().Kmeans(
            width,
            codewords,
            niter=_ITERATIONS,
            seed=seed,
            min_points_per_centroid=1,
            max_points_per_centroid=count,
        )
        clusters.train(values)
        books[part] = clusters.centroids
        codes[:, part] = clusters.index.search(values, 1)[1][:, 0]
    return CompressedEmbeddings(codes, books)
