"""Rigid motions SE(3) as 4x4 float64 matrices.

`T_a_b` maps coordinates in frame b to frame a. Tangent vectors are ordered (translation,
rotation), as in most of the literature. GTSAM and SciPy put the rotation first; only the modules
that call them reorder.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# Below this angle the closed forms lose precision and Taylor series are used.
_SMALL_ANGLE_RAD = 1e-4


def hat(vector: Array) -> Array:
    """Return the skew-symmetric matrix [3, 3] of a vector [3]: hat(a) @ b = a x b."""
    x, y, z = vector
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def exp_so3(rotation_rad: Array) -> Array:
    """Return the rotation matrix [3, 3] of a rotation vector [3] in radians (Rodrigues)."""
    return _exp_and_left_jacobian(rotation_rad)[0]


def log_so3(R: Array) -> Array:
    """Return the rotation vector [3] (radians, norm at most pi) of a rotation [3, 3]."""
    # The quaternion is well conditioned both at 0 and at pi.
    x, y, z, w = quaternion_xyzw(R)
    vector = np.array([x, y, z])
    sine = float(np.linalg.norm(vector))
    if w < 0.0:
        vector, w = -vector, -w
    if sine < 1e-12:
        return 2.0 * vector
    return vector * (2.0 * np.arctan2(sine, w) / sine)


def _exp_and_left_jacobian(rotation_rad: Array) -> tuple[Array, Array]:
    """The exponential of a rotation vector [3] and its left Jacobian, [3, 3] each."""
    angle = float(np.sqrt(rotation_rad @ rotation_rad))
    K = hat(rotation_rad)
    if angle < _SMALL_ANGLE_RAD:
        square = angle**2
        a, b, c = 1.0 - square / 6.0, 0.5 - square / 24.0, 1.0 / 6.0 - square / 120.0
    else:
        a, b = np.sin(angle) / angle, (1.0 - np.cos(angle)) / angle**2
        c = (angle - np.sin(angle)) / angle**3
    identity, KK = np.eye(3), K @ K
    return identity + a * K + b * KK, identity + b * K + c * KK


def from_rotation_translation(R: Array, t: Array) -> Array:
    """Return the rigid motion [4, 4] of a rotation [3, 3] and a translation [3]."""
    T = np.eye(4)
    T[:3, :3] = R
    T[:3, 3] = t
    return T


def exp(tangent: Array) -> Array:
    """Return the rigid motion [4, 4] of a tangent vector [6] (translation m, rotation rad)."""
    tangent = np.asarray(tangent, dtype=np.float64)
    rho, phi = tangent[:3], tangent[3:]
    R, left_jacobian = _exp_and_left_jacobian(phi)
    return from_rotation_translation(R, left_jacobian @ rho)


def log(T: Array) -> Array:
    """Return the tangent vector [6] (translation m, rotation rad) of a rigid motion [4, 4]."""
    phi = log_so3(T[:3, :3])
    rho = np.linalg.solve(_exp_and_left_jacobian(phi)[1], T[:3, 3])
    return np.concatenate([rho, phi])


def inverse(T: Array) -> Array:
    """Return the inverse (R^T, -R^T t) of rigid motions [..., 4, 4]."""
    T = np.asarray(T, dtype=np.float64)
    R_transposed = np.swapaxes(T[..., :3, :3], -1, -2)
    out = np.zeros_like(T)
    out[..., :3, :3] = R_transposed
    out[..., :3, 3] = -np.einsum("...ij,...j->...i", R_transposed, T[..., :3, 3])
    out[..., 3, 3] = 1.0
    return out


def interpolated(first: Array, second: Array, share: float) -> Array:
    """The pose [4, 4] at a share of the screw motion from one pose to another one."""
    return first @ exp(share * log(inverse(first) @ second))


def adjoint(T: Array) -> Array:
    """Return the adjoint [6, 6]: exp(adjoint(T) @ x) = T @ exp(x) @ inverse(T)."""
    R, t = T[:3, :3], T[:3, 3]
    out = np.zeros((6, 6))
    out[:3, :3] = R
    out[:3, 3:] = hat(t) @ R
    out[3:, 3:] = R
    return out


def rotation_angle_rad(R: Array) -> Array:
    """Return the angles in [0, pi] of rotations [..., 3, 3], accurate also near zero."""
    R = np.asarray(R, dtype=np.float64)
    sine = 0.5 * np.linalg.norm(
        np.stack(
            [
                R[..., 2, 1] - R[..., 1, 2],
                R[..., 0, 2] - R[..., 2, 0],
                R[..., 1, 0] - R[..., 0, 1],
            ],
            axis=-1,
        ),
        axis=-1,
    )
    cosine = 0.5 * (np.trace(R, axis1=-2, axis2=-1) - 1.0)
    return np.asarray(np.arctan2(sine, cosine))


def orthonormalise(T: Array) -> Array:
    """Return the rigid motion nearest to T [4, 4], to remove drift from products of motions."""
    U, _, Vt = np.linalg.svd(T[:3, :3])
    R = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
    return from_rotation_translation(R, T[:3, 3])


def is_rigid(T: Array, tolerance: float = 1e-3) -> bool:
    """Check whether T [4, 4] is finite and a rigid motion within the tolerance."""
    T = np.asarray(T)
    if T.shape != (4, 4) or not np.isfinite(T).all():
        return False
    R = T[:3, :3]
    return bool(
        np.abs(R @ R.T - np.eye(3)).max() < tolerance
        and np.linalg.det(R) > 0
        and np.abs(T[3] - [0, 0, 0, 1]).max() < tolerance
    )


def quaternion_xyzw(R: Array) -> Array:
    """Return the unit quaternion [4] (x, y, z, w), w >= 0, of a rotation [3, 3]."""
    m = np.asarray(R, dtype=np.float64)
    # Shepperd's method: divide by the largest of the four components.
    squares = np.array(
        [
            1.0 + m[0, 0] - m[1, 1] - m[2, 2],
            1.0 - m[0, 0] + m[1, 1] - m[2, 2],
            1.0 - m[0, 0] - m[1, 1] + m[2, 2],
            1.0 + m[0, 0] + m[1, 1] + m[2, 2],
        ]
    )
    largest = int(np.argmax(squares))
    rows = {
        0: [squares[0], m[0, 1] + m[1, 0], m[0, 2] + m[2, 0], m[2, 1] - m[1, 2]],
        1: [m[0, 1] + m[1, 0], squares[1], m[1, 2] + m[2, 1], m[0, 2] - m[2, 0]],
        2: [m[0, 2] + m[2, 0], m[1, 2] + m[2, 1], squares[2], m[1, 0] - m[0, 1]],
        3: [m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1], squares[3]],
    }
    q = np.array(rows[largest])
    q /= np.linalg.norm(q)
    return -q if q[3] < 0 else q


def rotation_from_quaternion_xyzw(q: Array) -> Array:
    """Return the rotation [3, 3] of a quaternion [4] (x, y, z, w) of any non-zero norm."""
    x, y, z, w = np.asarray(q, dtype=np.float64) / np.linalg.norm(q)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def transform_points(T_a_b: Array, points_b: NDArray) -> Array:
    """Transform points [..., 3] from frame b to frame a."""
    return points_b @ T_a_b[:3, :3].T + T_a_b[:3, 3]
