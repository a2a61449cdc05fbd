"""A vocabulary of ORB descriptors in DBoW2's text format, which ORB-SLAM3 requires."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

Bits = NDArray[np.float32]

# Children of a node and levels, as in ORB-SLAM3's own vocabulary, whose matching depends on them.
_BRANCHES, _LEVELS = 10, 6
# A node with fewer descriptors is a word.
_MIN_SPLIT = 20
_ITERATIONS = 8
_FEATURES = 800
# L1 distances of word histograms that are weighted by TF-IDF.
_SCORING, _WEIGHTING = 0, 0


@dataclass
class _Tree:
    """Lines of the file: parent, whether it is a word, descriptor, weight."""

    images: int
    nodes: list[tuple[int, bool, NDArray[np.uint8], float]] = field(default_factory=list)

    def split(self, parent: int, level: int, bits: Bits, image: NDArray[np.int64]) -> None:
        """Add the descriptors below a node; 0 is the root."""
        centres, member = _clusters(bits)
        for number, centre in enumerate(centres):
            own = member == number
            word = level == _LEVELS or int(own.sum()) < _MIN_SPLIT
            weight = np.log(self.images / len(np.unique(image[own]))) if word else 0.0
            self.nodes.append((parent, word, np.packbits(centre > 0.5), float(weight)))
            if not word:
                self.split(len(self.nodes), level + 1, bits[own], image[own])


def write_vocabulary(path: Path, images: Iterable[NDArray[np.uint8]]) -> None:
    """Train a vocabulary on grey images [H, W]."""
    orb = cv2.ORB_create(_FEATURES)
    found = [orb.detectAndCompute(image, None)[1] for image in images]
    found = [descriptors for descriptors in found if descriptors is not None]
    image = np.repeat(np.arange(len(found)), [len(descriptors) for descriptors in found])
    tree = _Tree(len(found))
    tree.split(0, 1, np.unpackbits(np.concatenate(found), axis=1).astype(np.float32), image)
    lines = [f"{_BRANCHES} {_LEVELS} {_SCORING} {_WEIGHTING}"]
    for parent, word, descriptor, weight in tree.nodes:
        lines.append(f"{parent} {int(word)} {' '.join(map(str, descriptor))} {weight:.6g}")
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(lines) + "\n", encoding="ascii")


def _clusters(bits: Bits) -> tuple[Bits, NDArray[np.int64]]:
    """K-majority: centres [K, 256] without empty ones, and the centre of each descriptor."""
    rng = np.random.default_rng(0)
    unique = np.unique(bits, axis=0) if len(bits) < 10_000 else bits
    centres = rng.permutation(unique)[:_BRANCHES]
    member = np.zeros(len(bits), np.int64)
    for _ in range(_ITERATIONS):
        # Hamming distance, apart from the number of bits of the descriptor itself.
        distance = centres.sum(1) - 2.0 * bits @ centres.T
        member = distance.argmin(1)
        used = np.unique(member)
        member = np.searchsorted(used, member)
        centres = np.stack([bits[member == n].mean(0) > 0.5 for n in range(len(used))])
        centres = centres.astype(np.float32)
    return centres, member
