"""Trajectory files: round trips, formats of other tools and malformed lines."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from toolkit.base.errors import DatasetError, FormatError
from toolkit.base.geometry import se3
from toolkit.base.geometry.trajectory import Trajectory
from toolkit.io import trajectories


def random_trajectory(seed: int, count: int = 7) -> Trajectory:
    rng = np.random.default_rng(seed)
    poses = [se3.exp(np.concatenate([rng.normal(size=3) * 5, rng.normal(size=3)]))] * count
    poses = [se3.exp(rng.normal(size=6)) @ pose for pose in poses]
    return Trajectory(1.3e9 + np.cumsum(rng.uniform(0.01, 1.0, count)), np.array(poses))


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 10**6))
def test_tum_round_trip(tmp_path_factory, seed):
    path = tmp_path_factory.mktemp("tum") / "trajectory.txt"
    written = random_trajectory(seed)
    trajectories.write_tum(path, written)
    read = trajectories.read_tum(path)
    np.testing.assert_allclose(read.T_world_camera, written.T_world_camera, atol=2e-8)
    np.testing.assert_allclose(read.timestamps_s, written.timestamps_s, atol=1e-6)


def test_output_is_reproducible(tmp_path):
    for name in ("a.txt", "b.txt"):
        trajectories.write_tum(tmp_path / name, random_trajectory(3))
    assert (tmp_path / "a.txt").read_bytes() == (tmp_path / "b.txt").read_bytes()


def test_tum_quaternions_are_xyzw_and_negative_zero_is_not_written(tmp_path):
    turned = se3.exp(np.array([1.0, -0.0, 2.0, np.pi / 2, 0.0, 0.0]))
    turned[1, 3] = -1e-12
    trajectories.write_tum(tmp_path / "t.txt", Trajectory(np.zeros(1), turned[None]))
    line = (tmp_path / "t.txt").read_text().splitlines()[1]
    half = "0.707106781"
    assert line.split()[4:] == [half, "0.000000000", "0.000000000", half]
    assert line.split()[2] == "0.000000000"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("1 0 0 0 0 0 0\n", "line 1: expected 8 numbers"),
        ("1 0 0 0 0 0 0 1\n2 0 x 0 0 0 0 1\n", "line 2: could not convert"),
        ("2 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n", "strictly increasing"),
        ("1 nan 0 0 0 0 0 1\n", "not a rigid motion"),
        ("1 0 0 0 0 0 0 0\n", "not a rigid motion"),
    ],
)
def test_errors_of_malformed_tum_lines_name_the_file(tmp_path, text, message):
    (tmp_path / "bad.txt").write_text(text)
    with pytest.raises(FormatError, match=message) as caught:
        trajectories.read_tum(tmp_path / "bad.txt")
    assert "bad.txt" in str(caught.value)


def test_repeated_timestamps_are_ignored(tmp_path):
    (tmp_path / "t.txt").write_text("# truth\n1 5 0 0 0 0 0 1\n1 6 0 0 0 0 0 1\n2 7 0 0 0 0 0 1\n")
    read = trajectories.read_tum(tmp_path / "t.txt")
    np.testing.assert_array_equal(read.positions_m[:, 0], [5, 7])


def test_error_names_the_missing_file(tmp_path):
    with pytest.raises(DatasetError, match=r"nowhere\.txt: No such file"):
        trajectories.read_tum(tmp_path / "nowhere.txt")


def test_matrix_entries_may_be_infinite_but_rows_must_have_equal_length(tmp_path):
    (tmp_path / "pose.txt").write_text("-inf -inf -inf -inf\n" * 3 + "0 0 0 1\n")
    assert np.isinf(trajectories.read_matrix(tmp_path / "pose.txt")[0, 0])
    (tmp_path / "pose.txt").write_text("1 0 0 0\n0 1 0\n")
    with pytest.raises(FormatError, match="4x4 or 3x3"):
        trajectories.read_matrix(tmp_path / "pose.txt")
