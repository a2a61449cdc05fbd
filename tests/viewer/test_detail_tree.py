"""Levels of detail: every Gaussian is in one leaf, and merging conserves moments and classes."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from painted_scenes import two_panels

from toolkit.tools.viewer.detail_tree import DetailTree
from toolkit.tools.viewer.moments import Moments
from toolkit.tools.viewer.scene import ShownSplats


def splats_at(means_m: np.ndarray, sigma_m: float = 0.01) -> ShownSplats:
    rng = np.random.default_rng(0)
    count = len(means_m)
    return ShownSplats(
        means_m=np.asarray(means_m, np.float32),
        sigmas_m=np.full(count, sigma_m, np.float32),
        opacities=rng.uniform(0.2, 0.9, count).astype(np.float32),
        rgb=rng.integers(0, 255, (count, 3), np.uint8),
    )


def cases() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(1)
    room = rng.random((4000, 3)) * [6.0, 3.0, 0.01]
    return {
        "one": np.zeros((1, 3)),
        "a point": np.ones((3000, 3)),
        "two points": np.repeat([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]], 2000, axis=0),
        "a sheet": room,
        "far away": np.concatenate([room, rng.normal(0.0, 1e6, (40, 3))]),
    }


@pytest.mark.parametrize("case", cases())
def test_every_gaussian_is_in_exactly_one_leaf(case):
    given = splats_at(cases()[case])
    tree = DetailTree.build(given, node_size=256, root_size=512)
    leaves = sorted((n.first, n.last) for n in tree.nodes if not n.children)
    assert leaves[0][0] == 0 and leaves[-1][1] == len(given)
    assert all(a[1] == b[0] for a, b in pairwise(leaves))
    table = np.column_stack([given.means_m, given.opacities, given.rgb])
    kept = np.column_stack([tree.splats.means_m, tree.splats.opacities, tree.splats.rgb])
    assert np.array_equal(np.unique(table, axis=0), np.unique(kept, axis=0))
    for node in tree.nodes:
        below = [tree.nodes[child] for child in node.children]
        if below:
            assert (below[0].first, below[-1].last) == (node.first, node.last)
        own = tree.splats.means_m[node.first : node.last]
        assert (own >= node.box_m[0]).all() and (own <= node.box_m[1]).all()


def test_nodes_are_small_and_children_are_not_coarser():
    tree = DetailTree.build(splats_at(cases()["a sheet"]), node_size=256, root_size=512)
    for number, node in enumerate(tree.nodes):
        assert tree.count(number) == len(tree.content(number)) <= (256 if number else 2 * 512)
        assert all(tree.nodes[child].cell_m <= node.cell_m for child in node.children)


def test_gaussians_far_away_do_not_make_the_map_coarse():
    tree = DetailTree.build(splats_at(cases()["far away"]), node_size=256, root_size=512)
    near = [n for n in tree.nodes if np.abs(n.box_m).max() < 10.0]
    assert sum(n.last - n.first for n in near if not n.children) >= 4000
    assert max(n.last - n.first for n in near if not n.children) <= 256


def test_merging_conserves_mass_mean_covariance_and_colour():
    rng = np.random.default_rng(2)
    given = replace(two_panels(300).splats, opacities=rng.uniform(0.1, 1, 300).astype(np.float32))
    before = Moments.of(given)
    once = before.merged(rng.integers(0, 40, 300))
    after = once.merged(np.zeros(len(once), np.intp))

    def weighted(moments: Moments, values: np.ndarray) -> np.ndarray:
        return moments.mass @ values.reshape(len(moments), -1)

    def second(moments: Moments) -> np.ndarray:
        rows, columns = np.triu_indices(3)
        squares = moments.means_m[:, rows] * moments.means_m[:, columns]
        return weighted(moments, moments.covariances + squares)

    assert len(after) == 1 and after.mass.sum() == pytest.approx(before.mass.sum())
    for name in ("means_m", "values"):
        expected = weighted(before, getattr(before, name))
        assert weighted(after, getattr(after, name)) == pytest.approx(expected, rel=1e-5)
    assert second(after) == pytest.approx(second(before))


def test_merged_gaussians_have_the_class_of_most_of_their_area():
    given = two_panels(5).splats  # tables are 0, 2 and 4, walls 1 and 3
    merged = Moments.of(given).merged(np.zeros(5, np.intp)).shown(given)
    assert (merged.levels[0] == given.levels[0]).all() and merged.submap[0] == 0
    sizes = np.where(np.arange(5) % 2, 0.2, 0.06).astype(np.float32)
    larger = replace(given, sigmas_m=sizes)
    merged = Moments.of(larger).merged(np.zeros(5, np.intp)).shown(larger)
    assert (merged.levels[0] == given.levels[1]).all() and merged.inferred[0]


def test_a_merged_surface_is_closed():
    """A sheet of 64 x 64 spheres remains opaque if each 4 x 4 of them are merged."""
    x, y = np.meshgrid(np.arange(64), np.arange(64))
    means_m = 0.01 * np.stack([x, y, np.zeros_like(x)], axis=-1).reshape(-1, 3)
    given = replace(splats_at(means_m), opacities=np.full(4096, 0.9, np.float32))
    groups = (16 * (y // 4) + x // 4).ravel()
    merged = Moments.of(given).merged(groups).shown(given)
    assert len(merged) == 256
    rays = np.random.default_rng(3).uniform(0.05, 0.58, (200, 1, 2))
    offsets = rays - merged.means_m[:, :2]
    variances = merged.sigmas_m**2 * merged.shapes[:, 0]
    assert np.abs(merged.shapes[:, 1]).max() < 1e-6 and (merged.shapes[:, 5] < 1.0).all()
    alpha = merged.opacities * np.exp(-0.5 * (offsets**2).sum(axis=2) / variances)
    assert 1.0 - np.prod(1.0 - alpha, axis=1).max() > 0.85


def test_harmonics_are_averaged():
    harmonics = np.zeros((2, 3, 3), np.int8)
    harmonics[0, 0], harmonics[1, 2] = 100, -60
    pair = splats_at(np.zeros((2, 3)))
    pair = replace(pair, harmonics=harmonics, opacities=np.full(2, 0.5, np.float32))
    merged = Moments.of(pair).merged(np.zeros(2, np.intp)).shown(pair)
    assert merged.harmonics[0].tolist() == [[50] * 3, [0] * 3, [-30] * 3]
