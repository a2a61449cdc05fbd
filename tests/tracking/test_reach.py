"""Where the camera may be, and which of several fitting poses is its own."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from toolkit.base.geometry import se3
from toolkit.slam.tracking.feature_pose import FeaturePose
from toolkit.slam.tracking.motion import ConstantVelocity
from toolkit.slam.tracking.reach import (
    Reach,
    is_only_place,
    likeliest,
    mean_pace,
    unless_contradicted,
)
from toolkit.slam.tracking.result import Health, TrackingResult, not_tracked
from toolkit.splatting.alignment.similarity import Similarity


class MetreTask:
    """A task at a depth of one metre."""

    def __init__(self, features: FeaturePose | None = None) -> None:
        self.features = features

    def distance(self, first: np.ndarray, second: np.ndarray) -> float:
        return float(np.linalg.norm(first[:3, 3] - second[:3, 3]))


def aside(metres: float) -> np.ndarray:
    return se3.exp(np.array([metres, 0.0, 0.0, 0.0, 0.0, 0.0]))


def found(metres: float, correlation: float = 0.95, covered: float = 0.9) -> TrackingResult:
    """A good result at a place, with this evidence."""
    similarity = Similarity(correlation, correlation, 50, covered, 1.0)
    good = replace(not_tracked(""), T_map_camera=aside(metres), health=Health.GOOD)
    return replace(good, similarity=similarity)


def chosen(*results: TrackingResult, metres: float = 0.05) -> TrackingResult:
    """The likeliest result if the camera is expected at the origin."""
    return likeliest(MetreTask(), results, Reach(np.eye(4), metres, 0.1))  # type: ignore[arg-type]


def test_a_velocity_limits_where_the_camera_may_be():
    motion = ConstantVelocity()
    assert motion.reach(0.0) is None
    motion.update(0.0, np.eye(4))
    anywhere = motion.reach(0.1)
    motion.update(0.1, aside(0.1))
    near = motion.reach(0.2)
    assert anywhere is not None and near is not None
    assert anywhere.contains(aside(0.2)) and anywhere.contains(aside(-0.2))
    assert (
        near.contains(aside(0.2)) and near.contains(aside(0.28)) and not near.contains(aside(0.0))
    )
    turned = aside(0.2) @ se3.exp(np.array([0.0, 0.0, 0.0, 0.0, 1.0, 0.0]))
    assert not near.contains(turned)


def test_a_velocity_from_a_doubtful_pose_limits_nothing():
    motion = ConstantVelocity()
    motion.update(0.0, np.eye(4))
    motion.update(0.1, aside(0.3), reliable=False)
    assert np.allclose(motion.predict(0.2), aside(0.6))
    for now_s in (0.2, 0.3):  # the velocity at the first reliable pose is not known either
        near = ConstantVelocity.from_state(motion.state()).reach(now_s)
        assert near is not None and near.contains(aside(0.3)) and near.contains(aside(0.15))
        motion.update(now_s, aside(0.3))
    near = motion.reach(0.4)
    assert near is not None and not near.contains(aside(0.15))


def test_the_longer_it_is_lost_or_doubtful_the_farther_it_may_be():
    motion = ConstantVelocity()
    motion.update(4.0, np.eye(4))
    assert motion.bound(5.0) is None, "the clock of the recording may be wrong"
    motion.update(5.0, aside(0.2))
    bounds = [motion.bound(5.0 + elapsed_s) for elapsed_s in (0.0, 1.0, 2.0)]
    motion.update(6.0, np.eye(4), reliable=False)
    bounds.append(motion.bound(6.0))
    metres = [bound.metres for bound in bounds if bound is not None]
    assert np.allclose(np.diff(metres[:3]), 1.5) and metres[0] == pytest.approx(0.5)
    assert metres[0] < metres[3] < metres[1], "doubtful poses are wrong by less than a walk"


def test_a_clock_that_is_too_fast_does_not_limit_the_motion():
    motion = ConstantVelocity()
    for index in range(4):
        motion.update(index / 30.0, aside(1.2 * index))
        restored = ConstantVelocity.from_state(motion.state())
        bound = restored.bound((index + 1) / 30.0)
        assert bound is None or bound.contains(aside(1.2 * (index + 1)))


def test_the_pace_is_a_mean():
    walk, jump = np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0]), np.array([0.0, 0.0, 0.0, 40.0, 0.0, 0.0])
    pace = mean_pace(mean_pace(0.0, walk), walk)
    assert pace == pytest.approx(2.0 / 3.0)
    assert mean_pace(pace, jump) == pytest.approx(pace + 0.2 * (20.0 - pace))


def test_of_two_poses_that_fit_the_possible_one_is_taken():
    best, possible = found(0.12, covered=1.0), found(0.01, covered=0.7)
    assert chosen(best, possible) is possible
    assert chosen(possible, best) is possible


@pytest.mark.parametrize("metres", [0.005, 0.2])
def test_a_frame_is_doubtful_if_none_or_several_poses_are_possible(metres: float):
    result = chosen(found(0.12, covered=1.0), found(0.02, covered=0.7), metres=metres)
    assert result.health is Health.DOUBTFUL and "repeats" in result.reason
    assert result.T_map_camera[0, 3] == pytest.approx(0.02)


def test_results_that_are_contradicted_are_no_places():
    contradicted = [replace(found(metres), health=Health.LOST, ambiguous=True) for metres in (0, 3)]
    assert chosen(*contradicted).lost


def test_garbage_fits_everywhere_and_repeats_nothing():
    garbage = [replace(found(metres, 0.0), health=Health.DOUBTFUL, reason="x") for metres in (0, 3)]
    assert chosen(*garbage).reason == "x" and not chosen(*garbage).ambiguous


def test_a_sudden_motion_is_believed_if_no_other_pose_fits():
    sudden = found(0.12)
    assert chosen(sudden, found(0.01, correlation=0.7)) is sudden
    assert chosen(sudden) is sudden
    assert chosen(sudden, replace(found(0.01), health=Health.LOST)) is sudden


def test_a_pose_at_which_the_map_shows_little_of_the_frame_is_no_rival():
    best = found(0.12, covered=1.0)
    assert chosen(best, found(0.01, covered=0.3)) is best


def test_results_at_one_place_are_no_contradiction():
    best, again = found(0.03), found(0.02, covered=0.8)
    assert chosen(best, again) is best


def followed(metres: float, motions: tuple[float, float] | None = None) -> FeaturePose:
    """Features that were followed to a place."""
    return FeaturePose(aside(metres), np.eye(6), np.ones(50, bool), motions)


@pytest.mark.parametrize(
    ("features", "metres", "lost"),
    [
        (followed(0.01), 3.75, True),  # the next door of a corridor
        (followed(0.01), 0.2, False),  # a correction of drift
        (followed(0.01), 0.04, False),
        (followed(3.7), 3.75, False),
        (followed(0.01, motions=(0.6, 0.4)), 3.75, False),
        (None, 3.75, False),  # after a cut
    ],
)
def test_features_tell_a_place_from_one_that_looks_like_it(features, metres: float, lost: bool):
    reach = Reach(np.eye(4), 0.05, 0.1)
    result = found(metres)
    kept = unless_contradicted(MetreTask(features), result, reach)  # type: ignore[arg-type]
    assert kept.lost == lost and (lost or kept is result)
    assert unless_contradicted(MetreTask(features), result, None) is result  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("others_m", "centre_m", "only"),
    [
        ([], 1.0, True),
        ([2.2], 1.0, True),
        ([4.0], 3.0, False),
        ([6.0], 1.0, True),
        ([4.0], 1.0, False),
    ],
    ids=["alone", "the same", "in reach", "out of reach", "out of reach, the opposite in it"],
)
def test_a_place_is_known_if_no_other_one_looks_like_it(others_m, centre_m, only):
    # What looks like 2 m and 4 m may be at 0 m, too.
    possible = Reach(aside(centre_m), 2.5, 1.0).contains
    assert is_only_place(aside(2.0), map(aside, others_m), possible) == only
