"""Keyframes: frames with a pose and an exposure, which the map is optimised against."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any, ClassVar, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from toolkit.base.exposure import IDENTITY, NEUTRAL, Exposure
from toolkit.base.frame import Frame
from toolkit.base.geometry import se3
from toolkit.base.geometry.camera import Camera

Item = TypeVar("Item")

# Covisibility is estimated from every n-th pixel in each direction.
_STRIDE = 16

_MIN_DEPTH_M = 0.05
# Depth tolerances relative to the measured depth: of points inside the viewing volume, and of
# points on the measured surface.
_MAX_BEHIND = 1.05
_ON_SURFACE = 0.05


@dataclass(frozen=True)
class Observed:
    """The images of a keyframe on a device.

    Attributes:
        rgb: [3, H, W] uint8. depth_m: [H, W] float32. class_ids: [H, W] int16, or None.
        inferred, transient: [H, W] bool, or None.
    """

    rgb: Tensor
    depth_m: Tensor
    class_ids: Tensor | None
    inferred: Tensor | None = None
    transient: Tensor | None = None

    @property
    def measured_m(self) -> Tensor:
        """Depth [H, W] without the inferred one, 0 where missing."""
        return _measured(self.depth_m, self.inferred)

    def to(self, device: torch.device) -> Observed:
        """Copy the images to a device."""
        ids, inferred, transient = (
            None if image is None else image.to(device)
            for image in (self.class_ids, self.inferred, self.transient)
        )
        return Observed(self.rgb.to(device), self.depth_m.to(device), ids, inferred, transient)


@dataclass
class Keyframe:
    """A frame that the map is optimised against. Its images are on the CPU.

    Attributes:
        index: the frame's index in the sequence.
        timestamp_s: the frame's time in seconds.
        T_map_camera: [4, 4] float64; local bundle adjustment and loop closure change it.
        rgb: [3, H, W] uint8 and depth_m: [H, W] float32, as observed.
        camera: intrinsics of both images.
        exposure: of the observed image against the map.
        points: [P, 3] float32 sparse observed points in camera coordinates (m).
        class_ids: [H, W] int16 class ids of the taxonomy, 0 void, or None.
        pose_moments: [13] float64 state of the pose optimiser; None until it moves the pose.
        inferred: [H, W] bool, where the depth follows from a depth prior, or None.
        prior_m: [H, W] float32 depth whose scale and shift are optimised with the map, or None.
        depth_moments: [7] float64 scale, shift and the state of their optimiser, or None.
        log_balance: [3] float64 estimated white balance, logarithms of gains with the sum 0; None
            is neutral. `exposure.balance` is neutral for small ones.
        balance_links: [L, 5] float64 differences of white balance to earlier keyframes: frame
            index, log gains and weight; None before they are estimated.
        transient: [H, W] bool, where something hides the scene that is not mapped: what the frame
            ignores, and moving objects; or None. See `hide`.
        observed_m: [H, W] float32 depth with that of moving objects; None without any.
    """

    index: int
    timestamp_s: float
    T_map_camera: NDArray[np.float64]
    rgb: Tensor
    depth_m: Tensor
    camera: Camera
    exposure: Exposure
    points: NDArray[np.float32]
    class_ids: Tensor | None = None
    pose_moments: NDArray[np.float64] | None = None
    inferred: Tensor | None = None
    prior_m: Tensor | None = None
    depth_moments: NDArray[np.float64] | None = None
    log_balance: NDArray[np.float64] | None = None
    balance_links: NDArray[np.float64] | None = None
    transient: Tensor | None = None
    observed_m: Tensor | None = None

    ARRAYS: ClassVar = (
        *("T_map_camera", "rgb", "depth_m", "points", "class_ids", "pose_moments"),
        *("inferred", "prior_m", "depth_moments", "log_balance", "balance_links"),
        *("transient", "observed_m"),
    )

    def arrays(self) -> dict[str, NDArray]:
        """Arrays of a checkpoint; None is left out."""
        arrays = {name: getattr(self, name) for name in self.ARRAYS}
        return {name: np.asarray(a) for name, a in arrays.items() if a is not None}

    def values(self) -> dict[str, Any]:
        """JSON values of a checkpoint."""
        return {
            "index": self.index,
            "timestamp_s": self.timestamp_s,
            "camera": asdict(self.camera),
            **asdict(self.exposure),
        }

    @classmethod
    def from_state(cls, arrays: dict[str, NDArray], values: dict[str, Any]) -> Keyframe:
        """Restore a keyframe from its `arrays` and `values`."""
        optional = {
            name: None if name not in arrays else np.array(arrays[name])
            for name in ("pose_moments", "depth_moments", "log_balance", "balance_links")
        }
        return cls(
            index=int(values["index"]),
            timestamp_s=float(values["timestamp_s"]),
            T_map_camera=np.array(arrays["T_map_camera"]),
            rgb=torch.from_numpy(np.array(arrays["rgb"])),
            depth_m=torch.from_numpy(np.array(arrays["depth_m"])),
            camera=Camera(**values["camera"]),
            exposure=Exposure.from_values(values),
            points=np.array(arrays["points"]),
            class_ids=_tensor(arrays.get("class_ids")),
            inferred=_tensor(arrays.get("inferred")),
            prior_m=_tensor(arrays.get("prior_m")),
            transient=_tensor(arrays.get("transient")),
            observed_m=_tensor(arrays.get("observed_m")),
            **optional,
        )

    @classmethod
    def from_frame(
        cls,
        frame: Frame,
        T_map_camera: NDArray[np.float64],
        exposure: Exposure = IDENTITY,
    ) -> Keyframe:
        """Create the keyframe of a tracked frame."""
        levels = torch.from_numpy(np.rint(frame.rgb * 255.0).astype(np.uint8))
        return cls(
            index=frame.index,
            timestamp_s=frame.timestamp_s,
            T_map_camera=T_map_camera.copy(),
            rgb=levels.permute(2, 0, 1).contiguous(),
            depth_m=torch.from_numpy(frame.depth_m),
            camera=frame.camera,
            exposure=exposure,
            points=_sparse(frame.camera, frame.depth_m),
            class_ids=_tensor(None if frame.labels is None else frame.labels.astype(np.int16)),
            inferred=_tensor(frame.inferred),
            transient=_tensor(frame.ignored),
        )

    def hide(self, transient: Tensor) -> None:
        """Remove moving objects: depth and labels within a mask [H, W] are missing from now on.

        Losses of colour leave out the mask as well; the colour itself is kept.
        """
        ignored, self.observed_m = self.transient, self.depth_m
        self.transient = transient if ignored is None else transient | ignored
        self.depth_m = self.depth_m.masked_fill(transient, 0.0)
        if self.class_ids is not None:
            self.class_ids = self.class_ids.masked_fill(transient, 0)
        self.points = _sparse(self.camera, self.depth_m.numpy())

    @property
    def images(self) -> Observed:
        """The keyframe's images on the CPU."""
        return Observed(self.rgb, self.depth_m, self.class_ids, self.inferred, self.transient)

    @property
    def measured_m(self) -> Tensor:
        """Depth [H, W] without the inferred one, 0 where missing."""
        return _measured(self.depth_m, self.inferred)

    def target_rgb(self, images: Observed | None = None) -> Tensor:
        """Observed colour [3, H, W] at the map's exposure; it may exceed 1.

        A map that is limited to 1 has no texture where the reference is brighter than the image.

        Args:
            images: the keyframe's images on another device; on the CPU by default.
        """
        rgb = self.rgb if images is None else images.rgb
        gain, bias, balance = self.exposure.gain, self.exposure.bias, self.exposure.balance
        colours = rgb.to(torch.float32).mul_(gain / 255.0).add_(bias)
        if balance != NEUTRAL:
            # By numbers: copying a tensor to a GPU would wait for it.
            for channel, factor in zip(colours, balance, strict=True):
                channel.mul_(factor)
        return colours

    def observed(self, images: Observed | None = None) -> tuple[Tensor, Tensor, Tensor | None]:
        """Colour, depth and labels in the form that the losses expect.

        Args:
            images: the keyframe's images on another device; on the CPU by default.
        """
        images = self.images if images is None else images
        ids = images.class_ids
        labels = None if ids is None else ids.to(torch.int32)
        return self.target_rgb(images), images.depth_m, labels

    @property
    def labels(self) -> Tensor | None:
        """Class ids [H, W] int32, in the form that the losses expect."""
        return None if self.class_ids is None else self.class_ids.to(torch.int32)

    def as_frame(self) -> Frame:
        """The observed images as a frame, at the map's exposure."""
        rgb = self.target_rgb().permute(1, 2, 0).contiguous().numpy()
        labels = None if self.labels is None else self.labels.numpy()
        depth_m = self.depth_m.numpy()
        inferred = None if self.inferred is None else self.inferred.numpy()
        return Frame(self.index, self.timestamp_s, rgb, depth_m, self.camera, labels, inferred)

    @property
    def median_depth_m(self) -> float:
        """Median depth of the sparse observed points; 0 if there are none."""
        return float(np.median(self.points[:, 2])) if len(self.points) else 0.0

    def points_in_map(self) -> NDArray[np.float64]:
        """The sparse observed points [P, 3] in the map's frame."""
        return se3.transform_points(self.T_map_camera, self.points.astype(np.float64))

    def reaches(self, points_map: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Mask [P] of the points [P, 3] that lie between the camera and the measured surface."""
        inside, z, depth_m = self._depths_at(points_map)
        inside[inside] = _not_behind(z, depth_m)
        return inside

    def measures(
        self, points_map: NDArray[np.float64], max_depth_m: NDArray[np.float64]
    ) -> NDArray[np.bool_]:
        """Mask [P] of the points [P, 3] on the measured surface, not farther than depths [P]."""
        inside, z, depth_m = self._depths_at(points_map)
        inside[inside] = (np.abs(z - depth_m) < _ON_SURFACE * depth_m) & (z <= max_depth_m[inside])
        return inside

    def shows(self, points_map: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Mask [P] of the points [P, 3] inside the image, hidden or not."""
        return self._projected(self._to_camera(points_map))[0]

    def in_front_of_surface(self, points_camera: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Mask [P] of the points [P, 3] that are not behind the measured surface.

        Args:
            points_camera: points in camera coordinates that project into the image.
        """
        depth_m = self._measured_at(self.camera.project(points_camera))
        return _not_behind(points_camera[:, 2], depth_m)

    def _depths_at(
        self, points_map: NDArray[np.float64]
    ) -> tuple[NDArray[np.bool_], NDArray[np.float64], NDArray[np.float32]]:
        """Mask [P] of the map points inside the image; their depths; the measured depths there."""
        points = self._to_camera(points_map)
        inside, uv = self._projected(points)
        return inside, points[inside, 2], self._measured_at(uv[inside])

    def _to_camera(self, points_map: NDArray[np.float64]) -> NDArray[np.float64]:
        """Map points [P, 3] in camera coordinates."""
        return se3.transform_points(se3.inverse(self.T_map_camera), points_map)

    def _measured_at(self, uv: NDArray[np.float64]) -> NDArray[np.float32]:
        """Depth [P] at the pixels nearest to image points [P, 2] inside the image."""
        column, row = np.rint(uv).astype(np.intp).T
        return self.depth_m.numpy()[row, column]

    def _projected(
        self, points: NDArray[np.float64]
    ) -> tuple[NDArray[np.bool_], NDArray[np.float64]]:
        """Mask [..., P] of camera points [..., P, 3] inside the image, and all pixels."""
        ahead = points[..., 2] > _MIN_DEPTH_M
        uv = self.camera.project(np.where(ahead[..., None], points, [0.0, 0.0, 1.0]))
        inside = ahead & (uv >= 0).all(axis=-1)
        inside &= (uv[..., 0] <= self.camera.width - 1) & (uv[..., 1] <= self.camera.height - 1)
        return inside, uv

    def fraction_seen_by(self, T_map_camera: NDArray[np.float64]) -> float:
        """Fraction of this keyframe's points inside the image of a camera at a pose [4, 4]."""
        return float(self.fractions_seen_by(T_map_camera[None])[0])

    def fractions_seen_by(self, T_map_cameras: NDArray[np.float64]) -> NDArray[np.float64]:
        """As `fraction_seen_by` [K], for cameras at poses [K, 4, 4]."""
        if len(self.points) == 0:
            return np.zeros(len(T_map_cameras))
        T_others_self = se3.inverse(T_map_cameras) @ self.T_map_camera
        R_transposed = np.swapaxes(T_others_self[:, :3, :3], -1, -2)
        points = self.points @ R_transposed + T_others_self[:, None, :3, 3]
        inside, _ = self._projected(points)
        return np.asarray(inside.mean(axis=-1))


def fractions_observed(
    keyframes: Sequence[Keyframe], points_map: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Fractions [K] of map points [P, 3] on the surfaces that each of K keyframes measured."""
    if len(points_map) == 0 or not keyframes:
        return np.zeros(len(keyframes))
    T_cameras_map = se3.inverse(np.array([k.T_map_camera for k in keyframes]))
    R_transposed = np.swapaxes(T_cameras_map[:, :3, :3], -1, -2)
    x, y, z = np.moveaxis(points_map @ R_transposed + T_cameras_map[:, None, :3, 3], -1, 0)
    cameras = [k.camera for k in keyframes]
    fx, fy, cx, cy, width, height = np.array(
        [[(c.fx, c.fy, c.cx, c.cy, c.width, c.height)] for c in cameras]
    ).T.swapaxes(1, 2)
    ahead = z > _MIN_DEPTH_M
    safe_z = np.where(ahead, z, 1.0)
    u, v = fx * x / safe_z + cx, fy * y / safe_z + cy
    inside = ahead & (u >= 0) & (v >= 0) & (u <= width - 1) & (v <= height - 1)
    columns, rows = (np.rint(np.where(inside, a, 0.0)).astype(np.intp) for a in (u, v))
    images = zip(keyframes, rows, columns, strict=True)
    depth_m = np.stack([k.depth_m.numpy()[row, column] for k, row, column in images])
    on_surface = inside & (np.abs(z - depth_m) < _ON_SURFACE * depth_m)
    return np.asarray(on_surface.mean(axis=1))


def evenly_spaced(items: Sequence[Item], count: int) -> list[Item]:
    """At most a number of items, evenly spaced, including the first and the last."""
    places = np.linspace(0, len(items) - 1, min(len(items), count)).round().astype(int)
    return [items[place] for place in places]


def _not_behind(z_m: NDArray[np.float64], measured_m: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Mask [P] of depths that are not behind the measured ones, 0 where nothing was measured."""
    # Where depth is missing, the viewing volume is unbounded.
    return (measured_m == 0) | (z_m <= _MAX_BEHIND * measured_m)


def _sparse(camera: Camera, depth_m: NDArray[np.float32]) -> NDArray[np.float32]:
    """Points [P, 3] of a sparse grid of the measured pixels, in camera coordinates."""
    # The grid leaves out the border, whose points leave the view with the smallest motion.
    points = camera.unproject(depth_m, _STRIDE)
    return points[points[..., 2] > 0].astype(np.float32)


def _tensor(array: NDArray | None) -> Tensor | None:
    return None if array is None else torch.from_numpy(np.array(array))


def _measured(depth_m: Tensor, inferred: Tensor | None) -> Tensor:
    return depth_m if inferred is None else depth_m.masked_fill(inferred, 0.0)
