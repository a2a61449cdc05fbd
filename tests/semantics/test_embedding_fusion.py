"""Fusion of the embeddings of views: weights, wrong views, determinism."""

from __future__ import annotations

import numpy as np
import pytest

from toolkit.io.object_embeddings import unit_rows
from toolkit.semantics.embedding_fusion import (
    FusionOptions,
    fuse_views,
    view_weights,
)

DIMENSIONS = 64


def direction(generator: np.random.Generator) -> np.ndarray:
    return unit_rows(generator.normal(size=(1, DIMENSIONS)))[0]


def views(seed: int, count: int, wrong: int, noise: float = 0.5) -> tuple[np.ndarray, np.ndarray]:
    """The true embedding, and views of it of which some show one and the same other object."""
    generator = np.random.default_rng(seed)
    truth, other = direction(generator), direction(generator)
    means = np.where(np.arange(count)[:, None] < wrong, other, truth)
    found = means + generator.normal(0, noise / np.sqrt(DIMENSIONS), means.shape)
    return truth, generator.permutation(found)


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("noise", [0.1, 0.5, 1.0])
def test_three_of_ten_wrong_views_are_left_out(seed, noise):
    truth, found = views(seed, 20, 6, noise)
    robust, plain = (fuse_views(found, None, FusionOptions(robust=r)) for r in (True, False))
    assert robust is not None
    assert plain is not None
    # As good as the mean of the right views alone.
    _, right = views(seed, 20, 0, noise)
    best = fuse_views(right, None, FusionOptions(robust=False))
    assert best is not None
    assert robust.embedding @ truth > best.embedding @ truth - 0.04
    assert robust.embedding @ truth > plain.embedding @ truth + 0.03
    assert robust.used.sum() <= 14


def test_right_views_are_kept():
    truth, found = views(0, 40, 0)
    fused = fuse_views(found)
    assert fused is not None
    assert fused.used.sum() >= 36
    assert fused.embedding @ truth > 0.98
    assert fused.weight == fused.used.sum()
    same = fuse_views(np.tile(truth, (5, 1)))
    assert same is not None
    assert same.used.all()
    assert same.agreement == pytest.approx(1.0, abs=1e-6)


def test_the_result_is_reproducible_and_independent_of_order_and_length():
    _, found = views(3, 20, 6)
    weights = np.random.default_rng(0).uniform(0.1, 1, 20)
    first, again = fuse_views(found, weights), fuse_views(found, weights)
    assert first is not None
    assert again is not None
    np.testing.assert_array_equal(first.embedding, again.embedding)
    order = np.random.default_rng(1).permutation(20)
    scaled = found[order] * np.linspace(0.1, 9, 20)[:, None]
    other = fuse_views(scaled, weights[order])
    assert other is not None
    np.testing.assert_allclose(first.embedding, other.embedding, atol=1e-6)
    np.testing.assert_array_equal(first.used[order], other.used)


def test_every_view_with_a_weight_has_one_vote():
    first, second = np.eye(4)[:2]
    found = np.stack([first, first, first, second, second])
    for weights, best in (([1, 1, 1, 9, 9], first), ([0, 0, 1, 1, 1], second)):
        fused = fuse_views(found, np.array(weights, float))
        assert fused is not None
        np.testing.assert_allclose(fused.embedding, best)
    two = fuse_views(found[2:4], np.array([3.0, 1.0]))
    assert two is not None
    np.testing.assert_allclose(two.embedding, np.array([3, 1, 0, 0]) / np.sqrt(10), atol=1e-6)


def test_without_any_weight_there_is_no_result():
    assert fuse_views(np.empty((0, 4))) is None
    assert fuse_views(np.eye(3), np.zeros(3)) is None
    assert fuse_views(np.zeros((2, 3))) is None
    assert fuse_views(np.array([[1.0, 0], [-1, 0]])) is None


@pytest.mark.parametrize(
    ("embeddings", "weights", "said"),
    [
        (np.eye(3), np.ones(2), r"got \[3, 3\] and \[2\]"),
        (np.ones(3), np.ones(3), "expected"),
        (np.full((2, 2), np.nan), np.ones(2), "must be finite"),
        (np.eye(2), np.array([1.0, -1.0]), "not negative"),
    ],
)
def test_wrong_arguments_are_refused(embeddings, weights, said):
    with pytest.raises(ValueError, match=said):
        fuse_views(embeddings, weights)


def test_near_large_and_certain_views_weigh_more():
    weights = view_weights(
        np.array([4096.0, 1e6, 1024.0, 4096.0, 4096.0, 0.0]),
        np.array([1.0, 0.2, 1.0, 4.0, 1.0, 1.0]),
        np.array([1.0, 1.0, 1.0, 1.0, 0.5, 1.0]),
    )
    np.testing.assert_allclose(weights, [1, 1, 0.25**0.25, 0.25**0.25, 0.5, 0])
    np.testing.assert_allclose(view_weights(np.array([4096.0]), np.array([2.0])), [0.5**0.25])
    for areas, distances, scores in ((-1, 1, 1), (1, np.nan, 1), (1, 1, 1.5)):
        arguments = (np.array([float(v)]) for v in (areas, distances, scores))
        with pytest.raises(ValueError, match="must be"):
            view_weights(*arguments)
