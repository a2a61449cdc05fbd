"""Poses of the tracked frames relative to keyframes, so that they move with the map."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toolkit.base.exposure import IDENTITY, NEUTRAL, Balance, Exposure
from toolkit.base.geometry import se3
from toolkit.base.geometry.trajectory import Trajectory
from toolkit.slam.loops.closing.uncertainty import PathPose
from toolkit.slam.submaps.atlas import Atlas

Array = NDArray[np.float64]


@dataclass(frozen=True)
class TrackedFrame:
    """A tracked frame and its reference keyframe.

    Attributes:
        keyframe: frame index of the reference keyframe, which belongs to `submap`.
        doubt: why the pose may be wrong; empty if it is reliable.
        ambiguous: whether the frame was followed, but shows several places or motions.
        steps: number of optimisation steps on the frame, if it became a keyframe.
        fingerprint: of its images as they were recorded.
        repeats: whether they are those of the frame before.
    """

    index: int
    timestamp_s: float
    submap: int
    keyframe: int
    exposure: Exposure
    doubt: str = ""
    ambiguous: bool = False
    steps: int = 0
    fingerprint: int = 0
    repeats: bool = False


class FramePoses:
    """The frames with a pose, in order."""

    def __init__(self) -> None:
        self._frames: list[TrackedFrame] = []
        self._T_keyframe_camera: list[Array] = []
        self._covariances: list[Array] = []

    def _append(self, frame: TrackedFrame, T_keyframe_camera: Array, covariance: Array) -> None:
        """Add a frame, its pose [4, 4] and the covariance [6, 6] of that."""
        self._frames.append(frame)
        self._T_keyframe_camera.append(T_keyframe_camera)
        self._covariances.append(covariance)

    @property
    def indices(self) -> list[int]:
        """Indices of the frames."""
        return [f.index for f in self._frames]

    @property
    def steps(self) -> dict[int, int]:
        """Number of optimisation steps by index of the keyframes."""
        return {f.index: f.steps for f in self._frames if f.steps}

    @property
    def submaps(self) -> list[int]:
        """Number of the submap that each frame was tracked in."""
        return [f.submap for f in self._frames]

    @property
    def keyframes(self) -> list[int]:
        """Frame index of the reference keyframe of each frame."""
        return [f.keyframe for f in self._frames]

    @property
    def T_keyframe_camera(self) -> Array:
        """Poses [M, 4, 4] of the frames relative to their reference keyframes."""
        return np.array(self._T_keyframe_camera).reshape(-1, 4, 4)

    def last_pose(self, atlas: Atlas) -> tuple[int, Array]:
        """Submap and pose [4, 4] of the newest frame; without frames, the active anchor."""
        return self._pose(atlas, -1) if self._frames else (atlas.active, np.eye(4))

    def _pose(self, atlas: Atlas, position: int) -> tuple[int, Array]:
        """Submap and pose [4, 4] of a frame by its position."""
        frame = self._frames[position]
        T_submap_keyframe = atlas.keyframe_poses(frame.submap)[frame.keyframe]
        return frame.submap, T_submap_keyframe @ self._T_keyframe_camera[position]

    def poses_in_submaps(self, atlas: Atlas) -> list[Array]:
        """T_submap_camera [4, 4] of each frame, in its own submap."""
        known = {f.submap: atlas.keyframe_poses(f.submap) for f in self._frames}
        return [
            known[f.submap][f.keyframe] @ T
            for f, T in zip(self._frames, self._T_keyframe_camera, strict=True)
        ]

    def measured_poses(self, atlas: Atlas) -> list[PathPose]:
        """Pose of each frame in its own submap, and how well tracking determined it."""
        return [
            PathPose(f.submap, T, f.keyframe == f.index, covariance)
            for f, T, covariance in zip(
                self._frames, self.poses_in_submaps(atlas), self._covariances, strict=True
            )
        ]

    def exposures(self, atlas: Atlas, of_submaps: Mapping[int, Exposure]) -> list[Exposure]:
        """Exposure of each frame against the map.

        The white balance of frames between two keyframes is interpolated.

        Args:
            of_submaps: exposures of submaps against the fused map; the identity where missing.
        """
        known = {f.submap: atlas.keyframe_balances(f.submap) for f in self._frames}
        return [
            of_submaps.get(f.submap, IDENTITY).after(
                f.exposure.with_balance(_interpolated(known[f.submap], f.index))
            )
            for f in self._frames
        ]

    def trajectory(self, atlas: Atlas) -> Trajectory:
        """Poses of the frames in the world frame."""
        anchors = [atlas.T_world_submap(number) for number in range(len(atlas))]
        poses = [
            se3.orthonormalise(anchors[f.submap] @ T)
            for f, T in zip(self._frames, self.poses_in_submaps(atlas), strict=True)
        ]
        times = np.array([f.timestamp_s for f in self._frames])
        return Trajectory(times, np.array(poses).reshape(-1, 4, 4))

    def state(self) -> tuple[dict[str, NDArray], dict[str, Any]]:
        """Arrays and JSON values from which `restore` continues identically."""
        arrays = {
            "T_keyframe_camera": self.T_keyframe_camera,
            "covariances": np.array(self._covariances).reshape(-1, 6, 6),
        }
        return arrays, {"tracked": [asdict(f) for f in self._frames]}

    def restore(self, arrays: dict[str, NDArray], values: dict[str, Any]) -> None:
        """Restore an earlier `state`."""
        self._frames = [
            TrackedFrame(**{**f, "exposure": Exposure.from_values(f["exposure"])})
            for f in values["tracked"]
        ]
        self._T_keyframe_camera = [np.array(T) for T in arrays["T_keyframe_camera"]]
        self._covariances = list(np.array(arrays["covariances"]))


def _interpolated(balances: Mapping[int, Balance], index: int) -> Balance:
    """White balance of a frame, between those of keyframes by ascending frame index."""
    if index in balances:
        return balances[index]
    if all(balance == NEUTRAL for balance in balances.values()):
        return NEUTRAL
    indices = list(balances)
    red, green, blue = (
        float(np.exp(np.interp(index, indices, channel)))
        for channel in np.log(list(balances.values())).T
    )
    return (red, green, blue)
