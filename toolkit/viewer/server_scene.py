"""The 3D content of the server: Gaussians, camera path, keyframes and loops."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from toolkit.geometry.camera import Camera
from toolkit.viewer.colouring import COLOUR, appearance
from toolkit.viewer.scene import ShownKeyframe, ShownObject, ViewerScene

_LOOP_RGB, _FRUSTUM_RGB, _MARK_RGB = (255, 92, 82), (92, 158, 255), (255, 204, 51)
_PATH_PIXELS, _LOOP_PIXELS, _FRUSTUM_PIXELS, _MARK_PIXELS = 2.0, 3.0, 1.5, 3.0
# Corners of a box that differ in one axis are connected.
_BOX_EDGES = [(i, i | bit) for bit in (1, 2, 4) for i in range(8) if not i & bit]
_BACKGROUND_RGB = (13, 16, 21)
# Length of a frustum relative to the diagonal of the map, and its limits in metres.
_FRUSTUM, _FRUSTUM_M = 0.009, (0.03, 0.3)

# Called with a keyframe when its frustum is clicked, and with the client.
KeyframeClicked = Callable[[ShownKeyframe, Any], None]


class ServerScene:
    """Writes a scene to a viser server.

    Args:
        server: a viser server.
        scene: what is shown first; it determines the vertical and the first view.
    """

    def __init__(self, server: Any, scene: ViewerScene) -> None:
        self.server = server
        self.scene = scene
        self.shown = {"path": True, "keyframes": True, "loops": True}
        self.keyframe_clicked: KeyframeClicked = lambda _keyframe, _client: None
        self._nodes: dict[str, list[Any]] = {name: [] for name in self.shown}
        self._mark: list[Any] = []
        server.scene.set_up_direction(tuple(map(float, scene.up)))
        server.scene.set_background_image(np.full((1, 1, 3), _BACKGROUND_RGB, np.uint8))
        self._set_first_view()
        look = appearance(scene, COLOUR, 0)
        splats = scene.splats
        self._splats = server.scene.add_gaussian_splats(
            "/gaussians", splats.means_m, covariances(scene), look.rgb, look.opacities[:, None]
        )
        self._add_cameras()

    def replace(self, scene: ViewerScene) -> None:
        """Take another state of the same map; the Gaussians follow with the next `paint`."""
        self.scene = scene
        with self.server.atomic():
            for node in (node for nodes in self._nodes.values() for node in nodes):
                node.remove()
            self._add_cameras()

    def paint(self, mode: str, level: int, highlighted: list[int] | None) -> None:
        """Set colours and opacities of the Gaussians; arguments as of `appearance`."""
        scene = self.scene  # may be replaced meanwhile, by the thread that follows a run
        look = appearance(scene, mode, level, highlighted)
        self._splats.set_gaussians(
            scene.splats.means_m, covariances(scene), look.rgb, look.opacities[:, None]
        )

    def show_layer(self, name: str, shown: bool) -> None:
        """Show or hide the path, the keyframes or the loops."""
        self.shown[name] = shown
        for node in self._nodes[name]:
            node.visible = shown

    def view_from(self, keyframe: ShownKeyframe, client: Any) -> None:
        """Move the camera of a client to a keyframe."""
        T = keyframe.T_map_camera
        with client.atomic():
            client.camera.position = T[:3, 3]
            client.camera.look_at = T[:3, 3] + T[:3, 2]

    def mark(self, chosen: ShownObject | None) -> None:
        """Draw the box of an object with its name, instead of the one before; None for none."""
        with self.server.atomic():
            for node in self._mark:
                node.remove()
            self._mark = []
            if chosen is not None:
                edges = chosen.corners_m[np.array(_BOX_EDGES)]
                top = chosen.corners_m[np.argsort(chosen.corners_m @ self.scene.up)[4:]]
                label = self.server.scene.add_label(
                    "/object/name",
                    chosen.name,
                    position=top.mean(axis=0),
                    anchor="bottom-center",
                )
                self._mark = [self._lines("/object/box", edges, _MARK_RGB, _MARK_PIXELS), label]

    def look_at(self, chosen: ShownObject, client: Any) -> None:
        """Turn the camera of a client to an object."""
        client.camera.look_at = chosen.corners_m.mean(axis=0)

    def _set_first_view(self) -> None:
        """Start outside of the map and above it."""
        view, means_m, up = self.server.initial_camera, self.scene.splats.means_m, self.scene.up
        low_m, high_m = np.percentile(means_m, (1.0, 99.0), axis=0)
        centre_m, size_m = (low_m + high_m) / 2.0, float(np.linalg.norm(high_m - low_m))
        side = np.cross(up, [0.5, 0.2, 0.8])
        side /= np.linalg.norm(side)
        view.position = centre_m + size_m * (0.6 * side + 0.4 * up)
        view.look_at = centre_m

    def _add_cameras(self) -> None:
        scene = self.scene
        self._nodes = {"path": [], "keyframes": [], "loops": []}
        positions_m = scene.path[:, :3, 3]
        if len(positions_m) > 1:
            segments = np.stack([positions_m[:-1], positions_m[1:]], axis=1)
            colours = np.repeat(scene.path_colours[:, None], 2, axis=1)
            self._nodes["path"].append(self._lines("/path", segments, colours, _PATH_PIXELS))
        if scene.loops:
            segments = np.stack([loop.ends_m for loop in scene.loops])
            self._nodes["loops"].append(self._lines("/loops", segments, _LOOP_RGB, _LOOP_PIXELS))
        if scene.camera is not None:
            self._add_keyframes(scene.camera)
        for name, nodes in self._nodes.items():
            for node in nodes:
                node.visible = self.shown[name]

    def _add_keyframes(self, camera: Camera) -> None:
        """Add frusta: with images as objects that can be clicked, the others as lines."""
        length_m = frustum_length_m(self.scene)
        plain = [k for k in self.scene.keyframes if k.image is None]
        if plain:
            segments = np.concatenate([_frustum(k, camera, length_m) for k in plain])
            node = self._lines("/keyframes/plain", segments, _FRUSTUM_RGB, _FRUSTUM_PIXELS)
            self._nodes["keyframes"].append(node)
        for keyframe in self.scene.keyframes:
            if keyframe.image is not None:
                self._nodes["keyframes"].append(self._frustum_node(keyframe, camera, length_m))

    def _frustum_node(self, keyframe: ShownKeyframe, camera: Camera, length_m: float) -> Any:
        T = keyframe.T_map_camera
        node = self.server.scene.add_camera_frustum(
            # A frame that ends one submap and starts the next one is a keyframe of both.
            f"/keyframes/{keyframe.submap}/{keyframe.index}",
            fov=2.0 * math.atan2(camera.height / 2.0, camera.fy),
            aspect=camera.width / camera.height,
            scale=length_m,
            thickness=_FRUSTUM_PIXELS,
            thickness_units="screen",
            color=_FRUSTUM_RGB,
            image=keyframe.image,
            format="jpeg",
            wxyz=np.roll(Rotation.from_matrix(T[:3, :3]).as_quat(), 1),
            position=T[:3, 3],
        )
        node.on_click(lambda event: self.keyframe_clicked(keyframe, event.client))
        return node

    def _lines(
        self,
        name: str,
        segments: NDArray[np.float64],
        rgb: tuple[int, int, int] | NDArray[np.uint8],
        pixels: float,
    ) -> Any:
        return self.server.scene.add_line_segments(
            name,
            segments.astype(np.float32),
            rgb,
            thickness=pixels,
            thickness_units="screen",
        )


def covariances(scene: ViewerScene) -> NDArray[np.float32]:
    """Return the covariances [N, 3, 3] of the Gaussians in square metres."""
    splats = scene.splats
    variances = (splats.sigmas_m**2)[:, None, None]
    if splats.shapes is None:
        return variances * np.eye(3, dtype=np.float32)
    full = splats.shapes[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)
    return variances * full


def frustum_length_m(scene: ViewerScene) -> float:
    """Return the length of the frusta in metres."""
    diagonal_m = float(np.linalg.norm(np.ptp(scene.splats.means_m, axis=0)))
    return float(np.clip(_FRUSTUM * diagonal_m, *_FRUSTUM_M))


def _frustum(keyframe: ShownKeyframe, camera: Camera, length_m: float) -> NDArray[np.float64]:
    """Return the eight edges [8, 2, 3] of a frustum."""
    x = (np.array([-0.5, camera.width - 0.5]) - camera.cx) / camera.fx
    y = (np.array([-0.5, camera.height - 0.5]) - camera.cy) / camera.fy
    rays = np.array([[x[0], y[0], 1], [x[1], y[0], 1], [x[1], y[1], 1], [x[0], y[1], 1]])
    T = keyframe.T_map_camera
    corners = length_m * rays @ T[:3, :3].T + T[:3, 3]
    tip = np.broadcast_to(T[:3, 3], (4, 3))
    sides = np.stack([tip, corners], axis=1)
    return np.concatenate([sides, np.stack([corners, np.roll(corners, -1, axis=0)], axis=1)])
