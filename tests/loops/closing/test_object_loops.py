"""Object hypotheses: poses and views from submaps whose Gaussians are blocks of classes."""

from __future__ import annotations

from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from toolkit.base.geometry import se3
from toolkit.slam.loops.closing.object_loops import ObjectHypotheses
from toolkit.splatting.gaussians.cloud import GaussianCloud

T = se3.exp(np.array([0.5, 0.1, 0.0, 0.0, 0.4, 0.0]))
CENTRES_M = np.array(
    [[0, 0, 0], [1.5, 0, 1], [-1, 1, 0.5], [0, 2, 1.5], [2, 2, 0], [-1, -2, 1], [1, -1, 2]]
)


def gaussians(centres_m, rng):
    """Gaussians of one class per block; the feature is the class."""
    inside = rng.uniform(-0.15, 0.15, (len(centres_m), 300, 3))
    points = torch.from_numpy((centres_m[:, None] + inside).reshape(-1, 3)).float()
    classes = torch.arange(1, len(centres_m) + 1).repeat_interleave(300)
    return GaussianCloud.from_values(
        points,
        torch.full((len(points),), 0.01),
        torch.full((len(points),), 0.9),
        torch.zeros(len(points), 3),
        classes.float()[:, None],
    )


@dataclass
class Submaps:
    """Two submaps; counts how often they are read."""

    clouds: list
    poses: list
    read: int = 0

    def keyframe_poses(self, number):
        return self.poses[number]

    def submap(self, number):
        self.read += 1
        return SimpleNamespace(
            gaussians=self.clouds[number], number=number, T_world_submap=np.eye(4)
        )


class Semantics:
    def decode_gaussians(self, features):
        ids = features[:, 0].numpy().astype(np.int32)
        return SimpleNamespace(class_ids=ids, confidence=np.ones(len(ids)))


@pytest.fixture
def submaps():
    rng = np.random.default_rng(0)
    second = se3.transform_points(se3.inverse(T), CENTRES_M.astype(float))
    turned = se3.exp(np.array([0.0, 0.0, 0.0, 0.0, 2.0, 0.0]))
    old = {5: turned, 10: T}
    return Submaps(
        [gaussians(CENTRES_M.astype(float), rng), gaussians(second, rng)],
        [old, {100: np.eye(4), 110: se3.exp(np.array([9.0, 0, 0, 0, 0, 0]))}],
    )


class Blocks:
    """Every block of Gaussians is an instance, of the submaps that have masks."""

    def __init__(self, *masked):
        self.masked = masked

    def of_points(self, submap, points_m, T_world_submap):
        return np.repeat(np.arange(7) + 5, 300) if submap in self.masked else None

    def embeddings(self, numbers):
        return {int(n): np.eye(8, dtype=np.float32)[n - 5] for n in numbers if n != 6}


def hypotheses(gap=30, instances=None):
    return ObjectHypotheses(Semantics(), gap, instances)


def test_objects_give_the_pose_and_the_views_of_one_place(submaps):
    (found,) = hypotheses().of(submaps, 0, 1, [100, 110])
    difference = se3.log(se3.inverse(T) @ found.edge.T_first_second)
    assert np.linalg.norm(difference) < 0.05
    assert len(found.match.pairs) == len(CENTRES_M)
    # The other view of the old submap looks elsewhere, and the other query is far away.
    assert found.pairs == [(100, 10)]


@pytest.mark.parametrize("masked", [(0, 1), (1,)])
def test_instances_are_objects_where_a_submap_has_masks(submaps, masked):
    """Only their embeddings tell seven objects of one class apart."""
    for cloud in submaps.clouds:
        cloud.features.fill_(3.0)
    found = hypotheses(instances=Blocks(*masked)).of(submaps, 0, 1, [100])
    assert [one.pairs for one in found] == [[(100, 10)]] * (masked == (0, 1))
    for one in found:
        difference = se3.log(se3.inverse(T) @ one.edge.T_first_second)
        assert np.linalg.norm(difference) < 0.05


def test_components_are_compared_as_well_and_come_second_if_fewer_agree(submaps):
    """Two blocks of the first submap have no class, and one of these has an embedding."""
    submaps.clouds[0].features[:600] = 0.0
    found = hypotheses(instances=Blocks(0, 1)).of(submaps, 0, 1, [100])
    assert [len(one.match.pairs) for one in found] == [6, 5]


def test_without_masks_the_same_objects_are_not_compared_twice(submaps):
    assert len(hypotheses(instances=Blocks()).of(submaps, 0, 1, [100])) == 1


def test_too_few_objects_and_frames_in_succession_are_no_hypothesis(submaps):
    assert hypotheses(gap=91).of(submaps, 0, 1, [100]) == []
    assert hypotheses().of(submaps, 0, 1, [110]) == []
    submaps.clouds[1] = gaussians(CENTRES_M[:4].astype(float), np.random.default_rng(1))
    assert hypotheses().of(submaps, 0, 1, [100]) == []


def test_a_submap_is_read_again_only_if_it_has_grown(submaps):
    known = hypotheses()
    for _ in range(3):
        known.of(submaps, 0, 1, [100])
    assert submaps.read == 2
    submaps.poses[1][120] = np.eye(4)
    known.of(submaps, 0, 1, [100])
    assert submaps.read == 3


def test_a_resumed_run_compares_the_objects_that_an_uninterrupted_one_remembers(submaps):
    known, resumed = (hypotheses(instances=Blocks(0, 1)) for _ in range(2))
    expected = known.of(submaps, 0, 1, [100])[0]
    resumed.restore(known.state())
    # Optimisation moves the Gaussians of a submap that gets no further keyframes.
    submaps.clouds[0].means.add_(0.02 * torch.randn(submaps.clouds[0].means.shape))
    found = resumed.of(submaps, 0, 1, [100])[0]
    assert submaps.read == 2
    assert np.array_equal(found.edge.T_first_second, expected.edge.T_first_second)
    assert found.match.error_m == expected.match.error_m
