"""Trajectories: validation, length and lookup of poses by time."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from toolkit.base.errors import FormatError
from toolkit.base.geometry import se3
from toolkit.base.geometry.trajectory import Trajectory

seeds = st.integers(0, 2**32 - 1)


def random_walk(seed: int, poses: int = 12) -> Trajectory:
    rng = np.random.default_rng(seed)
    T = [se3.exp(rng.normal(size=6))]
    for tangent in rng.normal(scale=0.1, size=(poses - 1, 6)):
        T.append(T[-1] @ se3.exp(tangent))
    return Trajectory(np.cumsum(rng.uniform(0.01, 0.05, poses)), np.stack(T))


def straight(count: int = 5) -> Trajectory:
    T = np.tile(np.eye(4), (count, 1, 1))
    T[:, 0, 3] = 0.5 * np.arange(count)
    return Trajectory(np.arange(count, dtype=float), T)


def test_length_and_number_of_poses() -> None:
    path = straight()
    assert len(path) == 5
    assert path.path_length_m == pytest.approx(2.0)
    assert str(path) == "5 poses, 2.000 m"
    np.testing.assert_array_equal(path.positions_m[:, 0], [0.0, 0.5, 1.0, 1.5, 2.0])


def test_empty_and_single() -> None:
    empty = Trajectory(np.empty(0), np.empty((0, 4, 4)))
    assert len(empty) == 0
    assert empty.path_length_m == 0.0
    assert empty.at(0.0) is None
    assert straight(1).path_length_m == 0.0


@pytest.mark.parametrize(
    ("times", "message"),
    [
        ([0.0, 1.0], "2 timestamps but 3 poses"),
        ([0.0, 1.0, 1.0], "strictly increasing"),
        ([0.0, 2.0, 1.0], "strictly increasing"),
        ([0.0, np.nan, 1.0], "finite"),
        ([0.0, 1.0, np.inf], "finite"),
    ],
)
def test_invalid_timestamps_raise(times: list[float], message: str) -> None:
    with pytest.raises(FormatError, match=message):
        Trajectory(np.array(times), straight(3).T_world_camera)


def test_error_for_a_non_rigid_pose_states_its_timestamp() -> None:
    T = straight(3).T_world_camera.copy()
    T[1, :3, :3] *= 1.1
    with pytest.raises(FormatError, match=r"pose at 1\.000000 s is not a rigid motion"):
        Trajectory(np.arange(3.0), T)


@settings(deadline=None, max_examples=30)
@given(seed=seeds)
def test_world_transform_preserves_relative_motion(seed: int) -> None:
    path = random_walk(seed)
    moved = path.transformed(se3.exp(np.random.default_rng(seed).normal(size=6)))
    assert moved.path_length_m == pytest.approx(path.path_length_m)

    def steps(t: Trajectory) -> np.ndarray:
        return se3.inverse(t.T_world_camera[:-1]) @ t.T_world_camera[1:]

    np.testing.assert_allclose(steps(moved), steps(path), atol=1e-10)


@settings(deadline=None, max_examples=30)
@given(seed=seeds, time=st.floats(-0.1, 0.8), tolerance_s=st.floats(0.0, 0.05))
def test_at_finds_the_nearest_pose_or_none(seed: int, time: float, tolerance_s: float) -> None:
    path = random_walk(seed)
    found = path.at(time, tolerance_s)
    differences = np.abs(path.timestamps_s - time)
    if differences.min() > tolerance_s:
        assert found is None
    else:
        np.testing.assert_array_equal(found, path.T_world_camera[np.argmin(differences)])


def test_association_keeps_the_requested_timestamps() -> None:
    path = straight()
    requested = np.array([-3.0, 0.02, 1.4, 2.98, 9.0])
    found = path.associated_to(requested, max_difference_s=0.05)
    np.testing.assert_array_equal(found.timestamps_s, [0.02, 2.98])
    np.testing.assert_array_equal(found.positions_m[:, 0], [0.0, 1.5])
    assert len(path.associated_to(np.array([50.0]), 0.1)) == 0


def test_association_with_itself_changes_nothing() -> None:
    path = random_walk(3)
    again = path.associated_to(path.timestamps_s, 0.0)
    np.testing.assert_array_equal(again.T_world_camera, path.T_world_camera)


@given(seeds, st.floats(0.0, 1.0))
def test_poses_between_others_are_interpolated(seed: int, share: float) -> None:
    walk = random_walk(seed)
    own_s, own = walk.timestamps_s, walk.T_world_camera
    times_s = own_s[:-1] + share * np.diff(own_s)
    found = walk.interpolated(times_s)
    for k, pose in enumerate(found):
        turn = share * se3.log_so3(own[k, :3, :3].T @ own[k + 1, :3, :3])
        np.testing.assert_allclose(pose[:3, :3], own[k, :3, :3] @ se3.exp_so3(turn), atol=1e-9)
        straight_m = (1.0 - share) * own[k, :3, 3] + share * own[k + 1, :3, 3]
        np.testing.assert_allclose(pose[:3, 3], straight_m, atol=1e-9)
    np.testing.assert_allclose(walk.interpolated(own_s), own, atol=1e-9)


def test_no_poses_are_known_outside_of_a_trajectory() -> None:
    found = straight(5).interpolated(np.array([-0.1, 0.0, 4.00005, 4.1]))
    assert np.isnan(found).all(axis=(1, 2)).tolist() == [True, False, False, True]
    assert np.isnan(straight(1).interpolated(np.zeros(1))).all()
    assert len(straight(1).delayed(0.5)) == 0
    late = straight(5).delayed(0.5)
    np.testing.assert_allclose(late.positions_m[:, 0], 0.25 + 0.5 * np.arange(4), atol=1e-12)
