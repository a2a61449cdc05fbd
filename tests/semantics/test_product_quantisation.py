"""Product quantisation of embeddings: size, error, determinism."""

from __future__ import annotations

import numpy as np
import pytest

from toolkit.io.object_embeddings import unit_rows
from toolkit.semantics.product_quantisation import compress

KINDS = unit_rows(np.random.default_rng(0).normal(size=(20, 32)))


def embeddings(count: int) -> np.ndarray:
    """Objects of 20 kinds, with noise."""
    generator = np.random.default_rng(1)
    noise = generator.normal(0, 0.3 / np.sqrt(32), (count, 32))
    return unit_rows(KINDS[generator.integers(0, len(KINDS), count)] + noise)


def test_codes_are_small_and_similarities_nearly_remain():
    found = embeddings(400)
    packed = compress(found, 8, 64)
    assert packed.codes.shape == (400, 8)
    assert packed.codebooks.shape == (8, 64, 4)
    assert packed.codes.nbytes + packed.codebooks.nbytes < found.astype(np.float16).nbytes / 3
    decoded = packed.decoded()
    np.testing.assert_allclose(np.linalg.norm(decoded, axis=1), 1, atol=1e-5)
    assert (decoded * found).sum(axis=1).min() > 0.9
    finer = compress(found, 16, 64).decoded()
    assert (finer * found).sum() > (decoded * found).sum()
    np.testing.assert_array_equal(packed.codes, compress(found, 8, 64).codes)


def test_as_many_codewords_as_objects_lose_only_precision():
    found = embeddings(10)
    np.testing.assert_allclose(compress(found, 4).decoded(), found, atol=2e-3)


def test_wrong_numbers_are_refused():
    with pytest.raises(ValueError, match="32 dimensions cannot be divided into 5 parts"):
        compress(embeddings(10), 5)
    with pytest.raises(ValueError, match=r"must be in 1\.\.256, got 300"):
        compress(embeddings(10), 4, 300)
    with pytest.raises(ValueError, match="no embeddings"):
        compress(embeddings(0), 4)
