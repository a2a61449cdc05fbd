"""Bodies and parameters of requests, and JSON values of answers."""

from __future__ import annotations

from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, model_validator

from toolkit.base.errors import SettingsError
from toolkit.base.geometry import se3
from toolkit.semantics.options import ObjectOptions

Picture = Literal["colour", "depth", "classes"]

# Farther cameras see nothing, and their coordinates have no precision as float32.
_MAX_M = 1e5
_MIN_SIDE, _MAX_SIDE = 8, 8192
_MIN_QUATERNION = 1e-3

Metres = Annotated[float, Field(ge=-_MAX_M, le=_MAX_M, allow_inf_nan=False)]
Component = Annotated[float, Field(ge=-1e3, le=1e3, allow_inf_nan=False)]
Side = Annotated[int, Field(ge=_MIN_SIDE, le=_MAX_SIDE, strict=True)]
Row = tuple[Metres, Metres, Metres, Metres]


class RenderRequest(BaseModel):
    """A view to render: one of keyframe, T_map_camera, or translation and quaternion.

    Without a size, the image has the size of the run's images. Another size scales them and crops
    the centre. `horizontal_fov_deg` sets another field of view.
    """

    model_config = ConfigDict(extra="forbid")

    what: Picture = "colour"
    level: Annotated[int, Field(ge=0, le=64, strict=True)] | None = Field(
        default=None, description="Level of the class tree, 0 is the coarsest; classes by default."
    )
    width: Side | None = None
    height: Side | None = None
    horizontal_fov_deg: Annotated[float, Field(ge=20, le=120, allow_inf_nan=False)] | None = None
    keyframe: Annotated[int, Field(ge=0, le=10**9, strict=True)] | None = Field(
        default=None, description="Number of a keyframe, 0 is the first."
    )
    T_map_camera: tuple[Row, Row, Row, Row] | None = Field(
        default=None, description="Pose of the camera in the map, a 4x4 matrix by rows."
    )
    translation_m: tuple[Metres, Metres, Metres] | None = None
    quaternion_xyzw: tuple[Component, Component, Component, Component] | None = None

    @model_validator(mode="after")
    def _one_pose(self) -> RenderRequest:
        parts = (self.translation_m is not None) + (self.quaternion_xyzw is not None)
        poses = (self.keyframe is not None) + (self.T_map_camera is not None) + (parts > 0)
        if poses != 1 or parts == 1:
            raise ValueError(
                "give one of keyframe, T_map_camera, or translation_m with quaternion_xyzw"
            )
        if (self.width is None) != (self.height is None):
            raise ValueError("give width and height, or neither")
        return self

    def pose(self) -> NDArray[np.float64] | None:
        """Return T_map_camera [4, 4], None for a keyframe.

        Raises:
            SettingsError: the matrix is no rigid motion, or the quaternion is nearly zero.
        """
        if self.T_map_camera is not None:
            T_map_camera = np.array(self.T_map_camera)
            if not se3.is_rigid(T_map_camera):
                raise SettingsError("T_map_camera is not a rigid motion (rotation and translation)")
            return se3.orthonormalise(T_map_camera)
        if self.quaternion_xyzw is None:
            return None
        quaternion = np.array(self.quaternion_xyzw)
        if np.linalg.norm(quaternion) < _MIN_QUATERNION:
            raise SettingsError("quaternion_xyzw is nearly zero")
        rotation = se3.rotation_from_quaternion_xyzw(quaternion)
        return se3.from_rotation_translation(rotation, np.array(self.translation_m))


class QueryParameters(BaseModel):
    """Options of the extraction of objects, as those of `semsplat query`."""

    model_config = ConfigDict(extra="forbid")

    name: str = Field(
        min_length=1, max_length=200, description='Class or group, or path: "seating > chair".'
    )
    min_confidence: Annotated[float, Field(ge=0, le=1, allow_inf_nan=False)] = 0.0
    link_m: Annotated[float, Field(ge=0.01, le=1, allow_inf_nan=False)] = ObjectOptions.link_m
    min_gaussians: Annotated[int, Field(ge=1, le=10**9)] = ObjectOptions.min_gaussians


class PageParameters(BaseModel):
    """A part of a long list."""

    model_config = ConfigDict(extra="forbid")

    first: Annotated[int, Field(ge=0, le=10**9)] = 0
    count: Annotated[int, Field(ge=1, le=10_000)] = 1_000


class ViewParameters(BaseModel):
    """What to render at a keyframe."""

    model_config = ConfigDict(extra="forbid")

    what: Picture = "colour"
    level: Annotated[int, Field(ge=0, le=64)] | None = None
    width: Annotated[int, Field(ge=_MIN_SIDE, le=_MAX_SIDE)] | None = None
    height: Annotated[int, Field(ge=_MIN_SIDE, le=_MAX_SIDE)] | None = None


def pose_values(T_map_camera: NDArray[np.float64]) -> dict[str, Any]:
    """Return the JSON values of a pose."""
    return {
        "translation_m": T_map_camera[:3, 3].tolist(),
        "quaternion_xyzw": se3.quaternion_xyzw(T_map_camera[:3, :3]).tolist(),
    }
