"""Keypoints: detection, matches and similar images."""

from __future__ import annotations

import cv2
import numpy as np

from toolkit.semantics.features.keypoints import (
    Keypoints,
    detect_keypoints,
    match_keypoints,
    similarity_votes,
    votes_for,
)


def scene(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    noise = rng.uniform(0, 255, (24, 32)).astype(np.float32)
    return (
        cv2.resize(noise, (160, 120), interpolation=cv2.INTER_CUBIC).clip(0, 255).astype(np.uint8)
    )


def shifted(image: np.ndarray, x: int, y: int) -> np.ndarray:
    return np.roll(image, (y, x), (0, 1))


def test_matches_follow_a_shift():
    first = detect_keypoints(scene(0), 200)
    second = detect_keypoints(shifted(scene(0), 9, 4), 200)
    matches = match_keypoints(first, second, 0.8)
    assert len(matches) > 40
    moved = second.px[matches[:, 1]] - first.px[matches[:, 0]]
    np.testing.assert_allclose(np.median(moved, axis=0), [9.0, 4.0], atol=0.1)


def test_matches_are_those_of_opencv():
    first, second = detect_keypoints(scene(0), 200), detect_keypoints(shifted(scene(0), 5, 0), 200)
    a, b = (k.descriptors.astype(np.float32) for k in (first, second))

    def distinct(own, others):
        pairs = cv2.BFMatcher(cv2.NORM_L2).knnMatch(own, others, k=2)
        return {x.queryIdx: x.trainIdx for x, y in pairs if x.distance < 0.8 * y.distance}

    forward, backward = distinct(a, b), distinct(b, a)
    expected = [(i, j) for i, j in forward.items() if backward.get(j) == i]
    assert [tuple(pair) for pair in match_keypoints(first, second, 0.8)] == expected


def test_uniform_images_have_no_keypoints():
    nothing = detect_keypoints(np.full((60, 80), 100, np.uint8), 100)
    assert len(nothing) == 0
    assert match_keypoints(nothing, detect_keypoints(scene(0), 50), 0.8).shape == (0, 2)
    assert similarity_votes([nothing, nothing]).sum() == 0


def test_the_same_place_gets_the_most_votes():
    images = [scene(0), scene(1), scene(2), shifted(scene(1), 4, 3)]
    votes = similarity_votes([detect_keypoints(image, 200) for image in images])
    assert votes[3].argmax() == 1
    assert votes[3, 1] > 5 * max(votes[3, 0], votes[3, 2], 1)
    assert not votes[np.triu_indices(4)].any()


def test_votes_for_one_image_are_those_of_all_pairs():
    images = [scene(seed) for seed in range(3)]
    found = [detect_keypoints(image, 200) for image in [*images, shifted(scene(1), 4, 3)]]
    votes = votes_for(found[:3], found[3])
    np.testing.assert_array_equal(votes, similarity_votes(found)[3, :3])
    assert votes.argmax() == 1
    assert votes_for([], found[0]).shape == (0,)


def test_votes_skip_images_without_keypoints():
    blank = Keypoints(np.zeros((0, 2)), np.zeros((0, 128), np.uint8), np.zeros(0, np.float32))
    image = detect_keypoints(scene(0), 100)
    votes = similarity_votes([image, blank, image])
    assert votes[2, 0] > 50
    assert votes[2, 1] == votes[1, 0] == 0
