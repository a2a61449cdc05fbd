"""SE(3): group axioms, including rotations near zero and near pi, and comparison with SciPy."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from toolkit.base.geometry import se3

Array = NDArray[np.float64]
PROFILE = settings(deadline=None, max_examples=60)

seeds = st.integers(0, 2**32 - 1)
# From far below the threshold of the series to just below pi, log-uniform near both ends.
angles_rad = st.one_of(
    st.just(0.0),
    st.floats(-14.0, -3.0).map(lambda e: 10.0**e),
    st.floats(1e-3, 3.1),
    st.floats(-12.0, -2.0).map(lambda e: math.pi - 10.0**e),
)


def direction(seed: int) -> Array:
    vector = np.random.default_rng(seed).normal(size=3)
    return vector / np.linalg.norm(vector)


def random_motion(seed: int, scale: float = 1.0) -> Array:
    return se3.exp(np.random.default_rng(seed).normal(scale=scale, size=6))


def tangent_of(seed: int, angle_rad: float) -> Array:
    translation = np.random.default_rng(seed + 1).normal(size=3)
    return np.concatenate([translation, angle_rad * direction(seed)])


@PROFILE
@given(seed=seeds, angle_rad=angles_rad)
@example(seed=0, angle_rad=0.99e-4)  # both sides of the series' threshold
@example(seed=0, angle_rad=1.01e-4)
def test_log_undoes_exp(seed: int, angle_rad: float) -> None:
    tangent = tangent_of(seed, angle_rad)
    np.testing.assert_allclose(se3.log(se3.exp(tangent)), tangent, rtol=0, atol=1e-9)


@PROFILE
@given(seed=seeds, angle_rad=angles_rad)
def test_exp_undoes_log(seed: int, angle_rad: float) -> None:
    T = se3.exp(tangent_of(seed, angle_rad))
    np.testing.assert_allclose(se3.exp(se3.log(T)), T, rtol=0, atol=1e-12)


@PROFILE
@given(seed=seeds, angle_rad=angles_rad)
@example(seed=0, angle_rad=0.99e-4)
@example(seed=0, angle_rad=1.01e-4)
def test_exp_is_the_matrix_exponential(seed: int, angle_rad: float) -> None:
    tangent = tangent_of(seed, angle_rad)
    generator = np.zeros((4, 4))
    generator[:3, :3] = se3.hat(tangent[3:])
    generator[:3, 3] = tangent[:3]
    np.testing.assert_allclose(se3.exp(tangent), expm(generator), rtol=0, atol=1e-12)


@PROFILE
@given(seed=seeds)
def test_log_of_a_rotation_beyond_pi_wraps(seed: int) -> None:
    axis = direction(seed)
    log = se3.log_so3(se3.exp_so3(axis * (math.pi + 0.5)))
    np.testing.assert_allclose(log, -axis * (math.pi - 0.5), atol=1e-9)


@pytest.mark.parametrize("axis", np.eye(3).tolist() + (-np.eye(3)).tolist())
def test_rotation_by_exactly_pi(axis: list[float]) -> None:
    R = 2.0 * np.outer(axis, axis) - np.eye(3)
    log = se3.log_so3(R)
    assert np.linalg.norm(log) == pytest.approx(math.pi, abs=1e-12)
    np.testing.assert_allclose(se3.exp_so3(log), R, atol=1e-12)


@PROFILE
@given(seed=seeds, angle_rad=angles_rad)
def test_log_and_angle_agree_with_scipy(seed: int, angle_rad: float) -> None:
    R = se3.exp_so3(angle_rad * direction(seed))
    rotation = Rotation.from_rotvec(angle_rad * direction(seed))
    np.testing.assert_allclose(R, rotation.as_matrix(), atol=1e-12)
    np.testing.assert_allclose(se3.log_so3(R), rotation.as_rotvec(), atol=1e-9)
    # atan2 of the sine and cosine is accurate both near zero and near pi.
    assert float(se3.rotation_angle_rad(R)) == pytest.approx(angle_rad, abs=1e-12, rel=1e-9)


@PROFILE
@given(seed=seeds, angle_rad=angles_rad)
def test_quaternions_agree_with_scipy(seed: int, angle_rad: float) -> None:
    rotation = Rotation.from_rotvec(angle_rad * direction(seed))
    q = se3.quaternion_xyzw(rotation.as_matrix())
    assert q[3] >= 0.0
    assert np.linalg.norm(q) == pytest.approx(1.0, abs=1e-14)
    expected = rotation.as_quat()
    if expected @ q < 0:  # at an angle of pi w is 0 and both signs are correct
        expected = -expected
    np.testing.assert_allclose(q, expected, atol=1e-9)
    np.testing.assert_allclose(
        se3.rotation_from_quaternion_xyzw(3.7 * q), rotation.as_matrix(), atol=1e-9
    )


@PROFILE
@given(seed=seeds)
def test_inverse(seed: int) -> None:
    T = np.stack([random_motion(seed + k, scale=2.0) for k in range(6)]).reshape(2, 3, 4, 4)
    identity = np.broadcast_to(np.eye(4), T.shape)
    np.testing.assert_allclose(T @ se3.inverse(T), identity, atol=1e-12)
    np.testing.assert_allclose(se3.inverse(T) @ T, identity, atol=1e-12)


@PROFILE
@given(seed=seeds, angle_rad=st.floats(0.0, 2.0))
def test_adjoint_transforms_tangents(seed: int, angle_rad: float) -> None:
    T = random_motion(seed)
    tangent = tangent_of(seed + 7, angle_rad)
    moved = T @ se3.exp(tangent) @ se3.inverse(T)
    np.testing.assert_allclose(se3.exp(se3.adjoint(T) @ tangent), moved, atol=1e-11)


@PROFILE
@given(seed=seeds)
def test_adjoint_is_a_homomorphism(seed: int) -> None:
    A, B = random_motion(seed), random_motion(seed + 1)
    np.testing.assert_allclose(se3.adjoint(A @ B), se3.adjoint(A) @ se3.adjoint(B), atol=1e-12)


@PROFILE
@given(seed=seeds)
def test_hat_is_the_cross_product(seed: int) -> None:
    a, b = np.random.default_rng(seed).normal(size=(2, 3))
    np.testing.assert_allclose(se3.hat(a) @ b, np.cross(a, b), atol=1e-14)


@PROFILE
@given(seed=seeds)
def test_orthonormalise_corrects_drift(seed: int) -> None:
    T = random_motion(seed)
    np.testing.assert_allclose(se3.orthonormalise(T), T, atol=1e-12)
    drifted = T.copy()
    drifted[:3, :3] += np.random.default_rng(seed).normal(scale=1e-4, size=(3, 3))
    corrected = se3.orthonormalise(drifted)
    assert se3.is_rigid(corrected, tolerance=1e-12)
    np.testing.assert_allclose(corrected, T, atol=1e-3)
    reflected = np.diag([1.0, 1.0, -1.0, 1.0]) @ T
    assert np.linalg.det(se3.orthonormalise(reflected)[:3, :3]) == pytest.approx(1.0)


def test_is_rigid_rejects_other_matrices() -> None:
    T = random_motion(1)
    assert se3.is_rigid(T)
    scaled, reflected, skewed, broken = T.copy(), T.copy(), T.copy(), T.copy()
    scaled[:3, :3] *= 1.01
    reflected[:3, 0] *= -1
    skewed[3, 0] = 0.1
    broken[0, 3] = np.nan
    for wrong in (scaled, reflected, skewed, broken, T[:3], np.zeros((4, 4))):
        assert not se3.is_rigid(wrong)


@PROFILE
@given(seed=seeds)
def test_transform_points_composes(seed: int) -> None:
    T_a_b, T_b_c = random_motion(seed), random_motion(seed + 1)
    points_c = np.random.default_rng(seed).normal(size=(2, 5, 3))
    through = se3.transform_points(T_a_b, se3.transform_points(T_b_c, points_c))
    np.testing.assert_allclose(through, se3.transform_points(T_a_b @ T_b_c, points_c), atol=1e-12)
    homogeneous = T_b_c @ np.append(points_c[1, 2], 1.0)
    np.testing.assert_allclose(
        se3.transform_points(T_b_c, points_c)[1, 2], homogeneous[:3], atol=1e-12
    )
