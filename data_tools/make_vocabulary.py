"""Learn the visual words of the VLAD encoder from synthetic rooms.

    python -m data_tools.make_vocabulary toolkit/semantics/features/vocabulary.npz

Takes a minute. The rooms are not among those of the benchmarks.
"""

from __future__ import annotations

import sys

import numpy as np
from numpy.typing import NDArray

from toolkit.datasets.synthetic_rooms import SensorModel, tiny_room
from toolkit.semantics.features.faiss_library import faiss
from toolkit.semantics.features.vlad import encoder_keypoints, root_sift

_SEEDS = range(100, 108)
_FRAMES = 24
_SIZES = ((160, 120), (320, 240))
_DIMENSIONS = _WORDS = 64


def main() -> None:
    """Render the rooms, learn the words and write them."""
    (out,) = sys.argv[1:]
    values = root_sift(np.concatenate([room_descriptors(seed) for seed in _SEEDS]))
    mean = values.mean(axis=0)
    # Ascending eigenvalues.
    basis = np.linalg.eigh(np.cov((values - mean).T))[1][:, : -_DIMENSIONS - 1 : -1]
    reduced = np.ascontiguousarray((values - mean) @ basis, dtype=np.float32)
    clusters = faiss().Kmeans(
        _DIMENSIONS, _WORDS, niter=25, seed=1, max_points_per_centroid=len(values)
    )
    clusters.train(reduced)
    # Half precision: 25 kB.
    arrays = {"mean": mean, "basis": basis, "words": clusters.centroids}
    np.savez_compressed(out, **{name: array.astype(np.float16) for name, array in arrays.items()})


def room_descriptors(seed: int) -> NDArray[np.uint8]:
    """SIFT descriptors [N, 128] of some frames of a room, with the noise of a sensor."""
    frames, _ = tiny_room(_FRAMES, *_SIZES[seed % len(_SIZES)], seed, SensorModel())
    found = [encoder_keypoints(frame.rgb.transpose(2, 0, 1)).descriptors for frame in frames]
    return np.concatenate(found)


if __name__ == "__main__":
    main()
