"""A person who walks through a room in front of the camera."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from toolkit.base.geometry import se3
from toolkit.base.geometry.camera import Camera
from toolkit.datasets.synthetic_rooms import textures as tx
from toolkit.datasets.synthetic_rooms.parts import Part
from toolkit.datasets.synthetic_rooms.patches import box, cylinder, ellipsoid, placement
from toolkit.datasets.synthetic_rooms.ray_casting import LENS_BLUR_PIXELS, RayCastView, Scene

# The part of the sequence in which the walker crosses the view, and the angle to either side of the
# viewing direction at which the walk begins and ends, outside the image.
_BEGIN, _END = 0.4, 0.7
_SIDE_RAD = 0.65
# Distances from the camera that are tried, and the clearance to the furniture.
_DISTANCES_M = np.arange(1.9, 0.85, -0.1)
_CLEARANCE_M = 0.35
_HIP_M, _HIP_HALF_M, _CHEST_M = 0.86, 0.1, 1.0
# Both feet step once in this distance.
_STRIDE_M, _SWING_RAD = 1.3, 0.4
_SAMPLES = 2
# Lights of the figure alone, which casts no shadow on the room.
_LAMPS_M = np.array([[0.6, 0.6, 2.45], [-0.6, -0.6, 2.45]])


@dataclass(frozen=True)
class _Limb:
    """A rigid part of the figure: its surfaces, its joint in the body's frame, and its swing."""

    scene: Scene
    joint_m: tuple[float, float, float]
    swing_rad: float

    def T_world_limb(self, T_world_body: NDArray[np.float64], phase: float) -> NDArray[np.float64]:
        """Pose [4, 4] at a phase of the stride."""
        turn = np.array([0.0, self.swing_rad * math.sin(phase), 0.0])
        return T_world_body @ se3.from_rotation_translation(
            se3.exp_so3(turn), np.array(self.joint_m)
        )


class Walker:
    """Walks across the view, from the side that the camera turns away from to the other one.

    Args:
        room: what the walker keeps clear of.
        T_world_camera: [N, 4, 4] poses of the whole sequence.
        texel_m: edge of a texture element, metres.
        rng: source of randomness of the clothes.
    """

    def __init__(
        self, room: Scene, T_world_camera: NDArray, texel_m: float, rng: np.random.Generator
    ) -> None:
        count = len(T_world_camera)
        self._room = room
        self._first = round(_BEGIN * count)
        poses = np.asarray(T_world_camera)[self._first : max(round(_END * count), self._first + 1)]
        self._places = _path(room, poses)
        steps = np.linalg.norm(np.diff(self._places, axis=0), axis=1)
        self._walked_m = np.concatenate([[0.0], np.cumsum(steps)])
        self._limbs = _figure(texel_m, rng)

    def add_to(
        self, index: int, view: RayCastView, camera: Camera, T_world_camera: NDArray
    ) -> RayCastView:
        """Add the walker to the ideal view of frame `index`, with the mask of its pixels."""
        number = index - self._first
        view = replace(view, walker=np.zeros(view.depth_m.shape, bool))
        if not 0 <= number < len(self._places):
            return view
        T_world_body = self._pose(number)
        phase = 2 * math.pi * self._walked_m[number] / _STRIDE_M
        for limb in self._limbs:
            T_limb_world = se3.inverse(limb.T_world_limb(T_world_body, phase))
            view = self._with_limb(view, limb.scene, camera, T_limb_world @ T_world_camera)
        return view

    def _pose(self, number: int) -> NDArray[np.float64]:
        places = self._places
        before, after = places[max(number - 1, 0)], places[min(number + 1, len(places) - 1)]
        ahead = after - before
        x, y = places[number]
        return placement(x, y, yaw_rad=math.atan2(ahead[1], ahead[0]))

    def _with_limb(
        self, view: RayCastView, limb: Scene, camera: Camera, T_limb_camera: NDArray
    ) -> RayCastView:
        fine = camera.scaled(_SAMPLES, _SAMPLES, *(side * _SAMPLES for side in camera.size))
        depth_m = limb.render_depth(fine, T_limb_camera)
        if not depth_m.any():
            return view
        seen = limb.render(camera, T_limb_camera, _SAMPLES)
        behind_m = cv2.resize(view.depth_m, fine.size, interpolation=cv2.INTER_NEAREST)
        visible = (depth_m > 0) & ((depth_m < behind_m) | (behind_m == 0))
        # The limb is rendered on black; the share of it that the furniture leaves visible is added.
        whole, shown = (_coverage(mask, camera) for mask in (depth_m > 0, visible))
        share = shown / np.maximum(whole, 1e-6)
        rgb = view.rgb * (1.0 - shown)[..., None] + seen.rgb * share[..., None]
        front = (seen.depth_m > 0) & ((seen.depth_m < view.depth_m) | (view.depth_m == 0))
        return RayCastView(
            rgb=rgb.clip(0.0, 1.0).astype(np.float32),
            depth_m=np.where(front, seen.depth_m, view.depth_m),
            labels=np.where(front, 0, view.labels).astype(np.int32),
            cosine=np.where(front, seen.cosine, view.cosine),
            walker=view.walker | front | (shown > 0.02),
            objects=None if view.objects is None else np.where(front, 0, view.objects),
        )


def _coverage(mask: NDArray[np.bool_], camera: Camera) -> NDArray[np.float32]:
    """Fraction [H, W] of each pixel that a fine mask covers, as the lens sees it."""
    image = cv2.GaussianBlur(mask.astype(np.float32), (0, 0), LENS_BLUR_PIXELS * _SAMPLES)
    return np.asarray(cv2.resize(image, camera.size, interpolation=cv2.INTER_AREA))


def _path(room: Scene, T_world_camera: NDArray) -> NDArray[np.float64]:
    """Places [n, 2] of the walker at the poses [n, 4, 4] of the camera, metres."""
    count = len(T_world_camera)
    time = np.linspace(0.0, 1.0, count)
    forward = T_world_camera[:, :2, 2]
    heading = np.unwrap(np.arctan2(forward[:, 1], forward[:, 0]))
    # Without the sway of the camera.
    smooth = [
        np.polyval(np.polyfit(time, values, min(3, count - 1)), time)
        for values in (*T_world_camera[:, :2, 3].T, heading)
    ]
    turn = 1.0 if heading[-1] >= heading[0] else -1.0
    azimuth = smooth[2] + turn * _SIDE_RAD * (2.0 * time - 1.0)
    direction = np.stack([np.cos(azimuth), np.sin(azimuth)], axis=1)
    paths = [np.stack(smooth[:2], axis=1) + d * direction for d in _DISTANCES_M]
    chests = [np.column_stack([path, np.full(count, _CHEST_M)]) for path in paths]
    clearance = np.array([room.distance_m(points).min() for points in chests])
    clear = clearance >= _CLEARANCE_M
    return paths[int(np.argmax(clear)) if clear.any() else int(np.argmax(clearance))]


def _figure(texel_m: float, rng: np.random.Generator) -> list[_Limb]:
    """The body with head and arms, and two legs; x is ahead, the origin on the floor."""
    streams = iter(rng.spawn(8))
    shirt = tx.plaid((0.75, 0.22, 0.18), ((0.12, 0.12, 0.3), (0.9, 0.85, 0.6)))
    skin, cloth = tx.speckled((0.82, 0.6, 0.48)), tx.weave((0.16, 0.2, 0.34))

    def part(patches: list, texture: tx.Texture) -> Part:
        return Part("clothing", patches, texture, next(streams))

    arms = [p for y in (-0.25, 0.25) for p in cylinder(0.045, 0.6, (0.0, y, 0.8))]
    body = [
        part([ellipsoid((0.13, 0.21, 0.34), (0.0, 0.0, 1.14)), *arms], shirt),
        part([ellipsoid((0.1, 0.09, 0.13), (0.0, 0.0, 1.57))], skin),
    ]
    limbs = [_Limb(Scene(body, _LAMPS_M, texel_m), (0.0, 0.0, 0.0), 0.0)]
    for side in (-1.0, 1.0):
        leg = part(cylinder(0.075, _HIP_M - 0.04, (0.0, 0.0, -_HIP_M + 0.04)), cloth)
        shoe = part(box((0.26, 0.1, 0.08), (0.05, 0.0, -_HIP_M)), tx.speckled((0.15, 0.13, 0.12)))
        scene = Scene([leg, shoe], _LAMPS_M, texel_m)
        limbs.append(_Limb(scene, (0.0, side * _HIP_HALF_M, _HIP_M), side * _SWING_RAD))
    return limbs
