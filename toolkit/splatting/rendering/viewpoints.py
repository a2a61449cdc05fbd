"""Camera poses for rendering a map without a trajectory."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from toolkit.base.geometry import se3
from toolkit.base.geometry.camera import Camera
from toolkit.splatting.gaussians.cloud import GaussianCloud

# Percentage of the Gaussians that an overview must show; the rest may be outliers.
_SHOWN_PERCENT = 99.5
_OVERVIEW_YAW_RAD = math.radians(30.0)
_OVERVIEW_PITCH_RAD = math.radians(-35.0)


@dataclass(frozen=True)
class Viewpoint:
    """Position and viewing direction in a frame with x right, y down, z forward.

    Attributes:
        position_m: (x, y, z).
        yaw_rad: rotation to the right.
        pitch_rad: rotation upwards, applied after yaw.
    """

    position_m: tuple[float, float, float]
    yaw_rad: float = 0.0
    pitch_rad: float = 0.0

    @property
    def T_map_camera(self) -> NDArray[np.float64]:
        """The camera's pose [4, 4]."""
        turn = se3.exp(np.array([0.0, 0.0, 0.0, 0.0, self.yaw_rad, 0.0]))
        tilt = se3.exp(np.array([0.0, 0.0, 0.0, self.pitch_rad, 0.0, 0.0]))
        R = (turn @ tilt)[:3, :3]
        return se3.from_rotation_translation(R, np.array(self.position_m))


def overview(gaussians: GaussianCloud, camera: Camera) -> NDArray[np.float64]:
    """Return T_map_camera [4, 4] of an oblique view from above that shows the whole map.

    "Above" is -y, which holds for maps whose first camera pose is upright.

    Raises:
        ValueError: the map is empty.
    """
    if len(gaussians) == 0:
        raise ValueError("an empty map has no overview")
    means = gaussians.means.detach().cpu().numpy().astype(np.float64)
    centre = np.median(means, axis=0)
    R = Viewpoint((0.0, 0.0, 0.0), _OVERVIEW_YAW_RAD, _OVERVIEW_PITCH_RAD).T_map_camera[:3, :3]
    x, y, z = ((means - centre) @ R).T
    # Distance of the camera from the centre at which a point with offset (x, y, z) is in view.
    needed_m = np.maximum(
        np.abs(x) * 2.0 * camera.fx / camera.width - z,
        np.abs(y) * 2.0 * camera.fy / camera.height - z,
    )
    distance_m = float(np.percentile(needed_m, _SHOWN_PERCENT))
    return se3.from_rotation_translation(R, centre - R[:, 2] * distance_m)
