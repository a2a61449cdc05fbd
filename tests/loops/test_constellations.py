"""Constellations: poses from objects that are blocks of points, with outliers and mirror images."""

from __future__ import annotations

import numpy as np
import pytest

from toolkit.base.geometry import se3
from toolkit.slam.loops.constellations import Constellation, closest_view, match_constellations

T = se3.exp(np.array([1.0, -0.4, 0.2, 0.3, -0.8, 0.1]))
CENTRES_M = np.array(
    [
        [0.0, 0.0, 0.4], [1.5, 0.2, 0.9], [-1.2, 1.0, 0.2], [0.4, 2.2, 1.4],
        [2.0, 1.9, 0.5], [-0.8, -1.6, 0.8], [1.1, -1.2, 0.3], [-2.0, 0.1, 1.2],
    ]
)  # fmt: skip
CLASSES = np.array([1, 2, 3, 3, 4, 5, 6, 7])


def blocks(centres_m, rng, half_m=0.12):
    """Points [K * 400, 3] in cubes."""
    inside = rng.uniform(-half_m, half_m, (len(centres_m), 400, 3))
    return (centres_m[:, None] + inside).reshape(-1, 3)


def moved(points_m):
    return se3.transform_points(se3.inverse(T), points_m)


@pytest.fixture
def rng():
    return np.random.default_rng(0)


def objects(centres_m, classes, rng):
    return Constellation.of(blocks(centres_m, rng), np.repeat(classes, 400))


def error(found):
    difference = se3.log(se3.inverse(T) @ found.T_first_second)
    return np.linalg.norm(difference[:3]), np.linalg.norm(difference[3:])


def test_objects_are_the_connected_parts_of_each_class_in_any_frame(rng):
    points, ids = blocks(CENTRES_M, rng), np.repeat(CLASSES, 400)
    wall = np.stack([*np.meshgrid(*[np.arange(-2.5, 2.5, 0.04)] * 2), np.full((125, 125), 3.0)])
    points = np.concatenate([points, wall.reshape(3, -1).T])
    ids = np.concatenate([ids, np.full(125 * 125, 9)])
    for placed, centres in ((points, CENTRES_M), (moved(points), moved(CENTRES_M))):
        found = Constellation.of(placed, ids)
        order = [np.linalg.norm(found.centres_m - c, axis=1).argmin() for c in centres]
        assert len(found) == len(CENTRES_M)
        np.testing.assert_array_equal(found.class_ids[order], CLASSES)
        np.testing.assert_allclose(found.centres_m[order], centres, atol=0.03)
        np.testing.assert_allclose(found.sizes_m, 0.24 * np.sqrt(3), rtol=0.25)


def test_void_and_nothing_are_no_objects(rng):
    assert len(objects(CENTRES_M, np.zeros(8, int), rng)) == 0
    assert len(Constellation.of(np.zeros((0, 3)), np.zeros(0, int))) == 0


class TestInstances:
    """Instances [N] take the place of connected components."""

    IDS = np.repeat(np.arange(8) + 20, 400)

    def test_touching_objects_are_two_and_the_parts_of_one_are_one(self, rng):
        parts = np.array([[0, 0, 0], [0.24, 0, 0], [1, 1, 0], [1.5, 1, 0.0]])
        points, ids = blocks(parts, rng), np.repeat([3, 4, 7, 7], 400)
        components = Constellation.of(points, np.full(1600, 2))
        found = Constellation.of(points, np.full(1600, 2), ids)
        places = np.array([[0, 0, 0], [0.24, 0, 0], [1.25, 1, 0]])
        apart = np.linalg.norm(found.centres_m[:, None] - places[None], axis=2)
        assert len(components) == 3 and len(found) == 3
        assert (apart.min(axis=0) < 0.04).all()
        assert not (np.linalg.norm(components.centres_m - places[1], axis=1) < 0.1).any()

    def test_the_class_of_an_instance_is_that_of_most_of_its_labelled_points(self, rng):
        labels = np.repeat(CLASSES, 400)
        labels[rng.random(len(labels)) < 0.5] = 0
        labels[rng.random(len(labels)) < 0.2] = 9
        found = Constellation.of(blocks(CENTRES_M, rng), labels, self.IDS)
        order = [np.linalg.norm(found.centres_m - c, axis=1).argmin() for c in CENTRES_M]
        np.testing.assert_array_equal(found.class_ids[order], CLASSES)

    def test_points_without_an_instance_are_objects_of_classes_without_masks(self, rng):
        """The rim that masks leave out of an object is none."""
        points, labels = blocks(CENTRES_M, rng), np.repeat(CLASSES, 400)
        inside = points[:, 0] > np.repeat(CENTRES_M[:, 0], 400) - 0.06
        ids = np.where(inside & (labels < 6), self.IDS, 0)
        found = Constellation.of(points, labels, ids)
        assert sorted(found.class_ids) == sorted(CLASSES)

    def test_an_instance_without_a_class_needs_an_embedding(self, rng):
        points, void = blocks(CENTRES_M, rng), np.zeros(3200, int)
        assert len(Constellation.of(points, void, self.IDS)) == 0
        found = Constellation.of(points, void, self.IDS, {22: np.array([0.6, 0.8])})
        np.testing.assert_allclose(found.embeddings, [[0.6, 0.8]])
        np.testing.assert_allclose(found.centres_m, CENTRES_M[2:3], atol=0.03)

    @pytest.mark.parametrize("class_id", [0, 2])
    def test_embeddings_tell_many_objects_of_one_class_apart(self, rng, class_id):
        """As `test_the_pose_follows_from_objects_although_some_moved` without different classes."""
        vectors = np.eye(8) + 0.2 * rng.standard_normal((8, 8))
        vectors /= np.linalg.norm(vectors, axis=1, keepdims=True)
        known = dict(zip(range(20, 28), vectors, strict=True))
        centres = moved(CENTRES_M)
        centres[[1, 5]] += [[0.9, 0.3, 0.0], [0.0, -1.1, 0.2]]
        labels = np.full(3200, class_id)
        found = match_constellations(
            Constellation.of(blocks(CENTRES_M, rng), labels, self.IDS, known),
            Constellation.of(blocks(centres, rng), labels, self.IDS, known),
        )
        assert len(found.pairs) == 6 and max(error(found)) < 0.03
        assert (found.pairs[:, 0] == found.pairs[:, 1]).all()
        first, second = (
            Constellation.of(blocks(c, rng), np.full(3200, 2), self.IDS)
            for c in (CENTRES_M, centres)
        )
        assert match_constellations(first, second) is None

    def test_of_many_pairs_those_with_similar_embeddings_are_compared(self, rng):
        """All pairs are the only ones of their class, and wrong ones are of more equal sizes."""
        vectors = np.eye(48)
        others = np.concatenate([vectors[:6], vectors[6:] + np.roll(vectors[6:], 1, axis=0)])
        others /= np.linalg.norm(others, axis=1, keepdims=True)
        centres = np.concatenate([CENTRES_M[:6], 5.0 * rng.random((42, 3))])
        wrong = np.concatenate([moved(CENTRES_M[:6]), 5.0 * rng.random((42, 3))])
        sizes = np.repeat([0.3, 0.2], [6, 42])
        found = match_constellations(
            Constellation(np.arange(1, 49), centres, np.full(48, 0.2), vectors),
            Constellation(np.arange(1, 49), wrong, sizes, others),
        )
        assert found is not None and max(error(found)) < 1e-6

    def test_embeddings_of_one_map_alone_change_nothing(self, rng):
        known = {20: np.array([1.0, 0.0]), 21: np.array([0.0, 1.0])}
        first, second = (
            Constellation.of(blocks(c, rng), np.repeat(CLASSES, 400), self.IDS, embeddings)
            for c, embeddings in ((CENTRES_M, known), (moved(CENTRES_M), None))
        )
        assert len(match_constellations(first, second).pairs) == 8


def test_the_pose_follows_from_objects_although_some_moved(rng):
    first = objects(CENTRES_M, CLASSES, rng)
    centres = moved(CENTRES_M)
    centres[[1, 5]] += [[0.9, 0.3, 0.0], [0.0, -1.1, 0.2]]
    found = match_constellations(first, objects(centres, CLASSES, rng))
    assert len(found.pairs) == 6
    metres, radians = error(found)
    assert metres < 0.03 and radians < 0.02
    again = match_constellations(first, objects(centres, CLASSES, np.random.default_rng(0)))
    assert len(again.pairs) == 6


def test_few_or_aligned_or_other_objects_give_no_pose(rng):
    first = objects(CENTRES_M, CLASSES, rng)
    assert match_constellations(first, objects(moved(CENTRES_M[:3]), CLASSES[:3], rng)) is None
    assert match_constellations(first, objects(moved(CENTRES_M), CLASSES + 10, rng)) is None
    line = np.array([[0.8 * k, 0.0, 0.5] for k in range(5)])
    ids = np.arange(1, 6)
    one, other = objects(line, ids, rng), objects(moved(line), ids, rng)
    assert match_constellations(one, other) is None


def test_a_mirrored_constellation_is_not_accepted_as_a_whole(rng):
    mirrored = objects(moved(CENTRES_M * [-1.0, 1.0, 1.0]), CLASSES, rng)
    found = match_constellations(objects(CENTRES_M, CLASSES, rng), mirrored)
    assert found is None or len(found.pairs) < 6


def test_the_closest_view_is_near_in_place_and_direction():
    beside = se3.exp(np.array([0.3, 0.0, 0.0, 0.0, 0.1, 0.0]))
    turned = se3.exp(np.array([0.0, 0.0, 0.0, 0.0, 1.5, 0.0]))
    assert closest_view(np.eye(4), [turned, beside], 1.0, 0.8) == 1
    assert closest_view(np.eye(4), [turned], 1.0, 0.8) is None
