"""The vocabulary that ORB-SLAM3 reads."""

from __future__ import annotations

import numpy as np

from benchmarks.accuracy.orbslam3 import write_vocabulary


def test_a_vocabulary_is_a_tree_of_words_with_weights(tmp_path):
    rng = np.random.default_rng(0)
    coarse = rng.integers(0, 255, (4, 15, 20), np.uint8)
    images = [np.kron(image, np.ones((16, 16), np.uint8)) for image in coarse]
    path = tmp_path / "folder" / "words.txt"
    write_vocabulary(path, images)
    header, *lines = path.read_text().splitlines()
    assert header == "10 6 0 0"
    nodes = [line.split() for line in lines]
    assert {len(node) for node in nodes} == {1 + 1 + 32 + 1}
    parents = np.array([int(node[0]) for node in nodes])
    words = np.array([node[1] == "1" for node in nodes])
    # Nodes are numbered from 1 in the order of the file, and follow their parents.
    assert (parents <= np.arange(len(nodes))).all()
    assert np.bincount(parents).max() <= 10
    inner = np.unique(parents[parents > 0]) - 1
    assert set(np.flatnonzero(~words)) == set(inner)
    assert all(0.0 <= float(node[-1]) <= np.log(4) + 1e-6 for node in nodes)
    assert max(int(value) for node in nodes for value in node[2:-1]) <= 255
