"""Keyframes: which frames become one, and which of them a mapping call works on."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from toolkit.frame import Frame
from toolkit.geometry import se3
from toolkit.geometry.camera import Camera
from toolkit.tracking.pose_adam import MOMENTS

# Covisibility is judged on every n-th pixel in each direction.
_STRIDE = 16

_NEAREST_M = 0.05
# A point so much beyond the measured depth is still on the surface.
_REACH = 1.05
# And one that differs by less, as a share of the depth, is a point of it.
_ON_SURFACE = 0.05


@dataclass(frozen=True)
class Observed:
    """What a keyframe saw, on some device.

    Attributes:
        rgb: [3, H, W] uint8. depth_m: [H, W] float32. class_ids: [H, W] int16, or None.
    """

    rgb: Tensor
    depth_m: Tensor
    class_ids: Tensor | None

    def to(self, device: torch.device) -> Observed:
        """The same on a device."""
        ids = None if self.class_ids is None else self.class_ids.to(device)
        return Observed(self.rgb.to(device), self.depth_m.to(device), ids)


@dataclass
class Keyframe:
    """A frame that the map is optimised against; its images lie on the CPU.

    Attributes:
        index: the frame's index in the sequence.
        T_map_camera: [4, 4] float64; local bundle adjustment may move it.
        rgb: [3, H, W] uint8 and depth_m: [H, W] float32, as observed.
        gain, bias: exposure against the map, map = gain * observed + bias.
        class_ids: [H, W] int16 labels of the taxonomy, 0 void, or None.
        points: [P, 3] float32 sparse observed points in camera coordinates (m).
        pose_moments: [13] float64 of the optimiser that adjusts the pose.
    """

    index: int
    timestamp_s: float
    T_map_camera: NDArray[np.float64]
    rgb: Tensor
    depth_m: Tensor
    camera: Camera
    gain: float
    bias: float
    points: NDArray[np.float32]
    class_ids: Tensor | None = None
    pose_moments: NDArray[np.float64] = field(default_factory=lambda: np.zeros(MOMENTS))

    ARRAYS: ClassVar = ("T_map_camera", "rgb", "depth_m", "points", "pose_moments")

    def arrays(self) -> dict[str, NDArray]:
        """The arrays of a checkpoint."""
        arrays = {name: np.asarray(getattr(self, name)) for name in self.ARRAYS}
        if self.class_ids is not None:
            arrays["class_ids"] = self.class_ids.numpy()
        return arrays

    def values(self) -> dict[str, Any]:
        """The rest of a checkpoint, as JSON holds it."""
        return {
            "index": self.index,
            "timestamp_s": self.timestamp_s,
            "camera": asdict(self.camera),
            "gain": self.gain,
            "bias": self.bias,
        }

    @classmethod
    def from_state(cls, arrays: dict[str, NDArray], values: dict[str, Any]) -> Keyframe:
        """The keyframe that `arrays` and `values` came from."""
        return cls(
            index=int(values["index"]),
            timestamp_s=float(values["timestamp_s"]),
            T_map_camera=np.array(arrays["T_map_camera"]),
            rgb=torch.from_numpy(np.array(arrays["rgb"])),
            depth_m=torch.from_numpy(np.array(arrays["depth_m"])),
            camera=Camera(**values["camera"]),
            gain=float(values["gain"]),
            bias=float(values["bias"]),
            points=np.array(arrays["points"]),
            class_ids=_tensor(arrays.get("class_ids")),
            pose_moments=np.array(arrays["pose_moments"]),
        )

    @classmethod
    def from_frame(
        cls, frame: Frame, T_map_camera: NDArray[np.float64], gain: float = 1.0, bias: float = 0.0
    ) -> Keyframe:
        """A keyframe of a tracked frame."""
        levels = torch.from_numpy(np.rint(frame.rgb * 255.0).astype(np.uint8))
        half = _STRIDE // 2  # away from the border, which the least motion crosses
        sparse = frame.camera.unproject(frame.depth_m)[half::_STRIDE, half::_STRIDE]
        return cls(
            index=frame.index,
            timestamp_s=frame.timestamp_s,
            T_map_camera=T_map_camera.copy(),
            rgb=levels.permute(2, 0, 1).contiguous(),
            depth_m=torch.from_numpy(frame.depth_m),
            camera=frame.camera,
            gain=gain,
            bias=bias,
            points=sparse[sparse[..., 2] > 0].astype(np.float32),
            class_ids=_tensor(None if frame.labels is None else frame.labels.astype(np.int16)),
        )

    @property
    def images(self) -> Observed:
        """Its own images."""
        return Observed(self.rgb, self.depth_m, self.class_ids)

    def target_rgb(self, images: Observed | None = None) -> Tensor:
        """Observed colour [3, H, W] at the map's exposure, of its images on any device."""
        rgb = self.rgb if images is None else images.rgb
        return (rgb.to(torch.float32) * (self.gain / 255.0) + self.bias).clamp(0.0, 1.0)

    def observed(self, images: Observed | None = None) -> tuple[Tensor, Tensor, Tensor | None]:
        """Colour, depth and labels as the losses take them.

        Args:
            images: the keyframe's own on another device, where the losses are.
        """
        images = images or self.images
        ids = images.class_ids
        labels = None if ids is None else ids.to(torch.int32)
        return self.target_rgb(images), images.depth_m, labels

    @property
    def labels(self) -> Tensor | None:
        """Class ids [H, W] int32, as the losses take them."""
        return None if self.class_ids is None else self.class_ids.to(torch.int32)

    def points_in_map(self) -> NDArray[np.float64]:
        """The sparse observed points [P, 3] in the map's frame."""
        return se3.transform_points(self.T_map_camera, self.points.astype(np.float64))

    def reaches(self, points_map: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Which points [P, 3] of the map lie in the volume between camera and measured depth."""
        inside, z, depth_m = self._measured_at(points_map)
        # Where nothing was measured the view may end anywhere.
        inside[inside] = (depth_m == 0) | (z <= _REACH * depth_m)
        return inside

    def share_observed(self, points_map: NDArray[np.float64]) -> float:
        """Share of points [P, 3] of the map that lie on what this keyframe measured."""
        if len(points_map) == 0:
            return 0.0
        _, z, depth_m = self._measured_at(points_map)
        near = np.abs(z - depth_m) < _ON_SURFACE * depth_m
        return float(near.sum() / len(points_map))

    def _measured_at(
        self, points_map: NDArray[np.float64]
    ) -> tuple[NDArray[np.bool_], NDArray[np.float64], NDArray[np.float32]]:
        """Which points [P, 3] of the map are in the image; their z, and the depth seen there."""
        points = se3.transform_points(se3.inverse(self.T_map_camera), points_map)
        inside, uv = self._projected(points)
        column, row = np.rint(uv[inside]).astype(np.intp).T
        return inside, points[inside, 2], self.depth_m.numpy()[row, column]

    def _projected(
        self, points: NDArray[np.float64]
    ) -> tuple[NDArray[np.bool_], NDArray[np.float64]]:
        """Which points [P, 3] in camera coordinates are in the image, and the pixels [P, 2]."""
        ahead = points[:, 2] > _NEAREST_M
        uv = self.camera.project(np.where(ahead[:, None], points, [0.0, 0.0, 1.0]))
        inside = ahead & (uv >= 0).all(axis=1)
        inside &= (uv[:, 0] <= self.camera.width - 1) & (uv[:, 1] <= self.camera.height - 1)
        return inside, uv

    def share_seen_by(self, T_map_camera: NDArray[np.float64]) -> float:
        """Share of this keyframe's points inside the image of a camera at another pose."""
        if len(self.points) == 0:
            return 0.0
        T_other_self = se3.inverse(T_map_camera) @ self.T_map_camera
        points = se3.transform_points(T_other_self, self.points)
        return float(self._projected(points)[0].mean())


def _tensor(array: NDArray | None) -> Tensor | None:
    return None if array is None else torch.from_numpy(np.array(array))


@dataclass(frozen=True)
class KeyframePolicy:
    """When a tracked frame becomes a keyframe.

    Attributes:
        interval: every so many frames (G: d_k).
        least_overlap: sooner, when less than this share of the last keyframe's points is
            still in view.
    """

    interval: int = 5
    least_overlap: float = 0.95

    def wants(self, frames_since_last: int, overlap: float) -> bool:
        """Whether the newest frame should become a keyframe."""
        return frames_since_last >= self.interval or overlap < self.least_overlap


def choose_window(
    keyframes: list[Keyframe],
    size: int,
    least_overlap: float,
    generator: np.random.Generator,
) -> list[Keyframe]:
    """The newest keyframe and random ones among those that see the same place.

    When fewer than `size` overlap, the rest is drawn from everywhere: recent views would
    otherwise pull the old ones out of shape.
    """
    newest = keyframes[-1]
    others = keyframes[:-1]
    overlapping = [k for k in others if newest.share_seen_by(k.T_map_camera) > least_overlap]
    count = min(size - 1, len(overlapping))
    chosen = (
        [overlapping[i] for i in generator.choice(len(overlapping), count, replace=False)]
        if count
        else []
    )
    return [newest, *chosen]
