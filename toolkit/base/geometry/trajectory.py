"""Validated camera trajectories: timestamps and poses."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from toolkit.base.errors import FormatError
from toolkit.base.geometry import se3


@dataclass(frozen=True)
class Trajectory:
    """Timestamped camera poses.

    Attributes:
        timestamps_s: [N] float64, strictly increasing, seconds.
        T_world_camera: [N, 4, 4] float64, camera to world, metres.

    Raises:
        FormatError: shapes do not match, timestamps do not increase or a pose is not rigid.
    """

    timestamps_s: NDArray[np.float64]
    T_world_camera: NDArray[np.float64]

    def __post_init__(self) -> None:
        times = np.asarray(self.timestamps_s, dtype=np.float64).reshape(-1)
        poses = np.asarray(self.T_world_camera, dtype=np.float64).reshape(-1, 4, 4)
        object.__setattr__(self, "timestamps_s", times)
        object.__setattr__(self, "T_world_camera", poses)
        if len(times) != len(poses):
            raise FormatError(f"trajectory has {len(times)} timestamps but {len(poses)} poses")
        if not np.isfinite(times).all() or (np.diff(times) <= 0).any():
            raise FormatError("trajectory timestamps must be finite and strictly increasing")
        for time, pose in zip(times, poses, strict=True):
            if not se3.is_rigid(pose):
                raise FormatError(f"trajectory pose at {time:.6f} s is not a rigid motion")

    def __len__(self) -> int:
        return len(self.timestamps_s)

    def __str__(self) -> str:
        return f"{len(self)} poses, {self.path_length_m:.3f} m"

    @property
    def positions_m(self) -> NDArray[np.float64]:
        """Camera centres [N, 3]."""
        return self.T_world_camera[:, :3, 3]

    @property
    def path_length_m(self) -> float:
        """Sum of the distances between consecutive camera centres."""
        return float(np.linalg.norm(np.diff(self.positions_m, axis=0), axis=1).sum())

    def at(self, timestamp_s: float, max_difference_s: float = 1e-4) -> NDArray[np.float64] | None:
        """Return the pose [4, 4] nearest in time, or None if it is more than the limit away."""
        if len(self) == 0:
            return None
        right = int(np.searchsorted(self.timestamps_s, timestamp_s))
        candidates = [i for i in (right - 1, right) if 0 <= i < len(self)]
        nearest = min(candidates, key=lambda i: abs(self.timestamps_s[i] - timestamp_s))
        if abs(self.timestamps_s[nearest] - timestamp_s) > max_difference_s:
            return None
        return self.T_world_camera[nearest]

    def interpolated(self, times_s: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return poses [N, 4, 4] between those before and after times [N].

        Outside of the times of at least two poses, they are NaN.
        """
        from scipy.spatial.transform import Rotation, Slerp

        poses = np.full((len(times_s), 4, 4), np.nan)
        if len(self) < 2:
            return poses
        own_s, rounding_s = self.timestamps_s, 1e-4
        known = (times_s >= own_s[0] - rounding_s) & (times_s <= own_s[-1] + rounding_s)
        inner_s = np.clip(times_s[known], own_s[0], own_s[-1])
        rotations = Slerp(own_s, Rotation.from_matrix(self.T_world_camera[:, :3, :3]))(inner_s)
        positions_m = [np.interp(inner_s, own_s, axis_m) for axis_m in self.positions_m.T]
        poses[known] = np.eye(4)
        poses[known, :3, :3], poses[known, :3, 3] = rotations.as_matrix(), np.stack(positions_m, 1)
        return poses

    def delayed(self, delay_s: float) -> Trajectory:
        """Return the trajectory of a camera whose poses were recorded late by a time.

        The pose at a time becomes that at the time plus the delay, interpolated; poses without
        another one so much later, or earlier, are omitted.
        """
        poses = self.interpolated(self.timestamps_s + delay_s)
        known = ~np.isnan(poses[:, 3, 3])
        return Trajectory(self.timestamps_s[known], poses[known])

    def transformed(self, T_new_world: NDArray[np.float64]) -> Trajectory:
        """Return the trajectory in another world frame."""
        return Trajectory(self.timestamps_s, T_new_world @ self.T_world_camera)

    def associated_to(
        self, timestamps_s: NDArray[np.float64], max_difference_s: float
    ) -> Trajectory:
        """Return the trajectory at the given timestamps.

        Each timestamp gets the nearest pose; timestamps without a pose within
        `max_difference_s` are omitted.
        """
        found = [(t, self.at(float(t), max_difference_s)) for t in timestamps_s]
        kept = [(t, pose) for t, pose in found if pose is not None]
        if not kept:
            return Trajectory(np.empty(0), np.empty((0, 4, 4)))
        return Trajectory(np.array([t for t, _ in kept]), np.stack([p for _, p in kept]))
