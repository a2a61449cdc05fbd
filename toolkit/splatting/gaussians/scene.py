"""Finished maps that are accessed in parts, so that they need not be in memory as a whole."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from toolkit.base.geometry.camera import Camera
from toolkit.splatting.gaussians.cloud import GaussianCloud


class GaussianScene(Protocol):
    """Gaussians in one coordinate frame that are accessed in parts."""

    def __len__(self) -> int:
        """Return the number of Gaussians."""
        ...

    def parts(self) -> Iterator[GaussianCloud]:
        """Yield all Gaussians part by part."""
        ...

    def visible_from(self, camera: Camera, T_map_camera: NDArray[np.float64]) -> GaussianCloud:
        """Return a superset of the Gaussians visible from a pose [4, 4], in map order."""
        ...


class InMemoryScene:
    """A map in memory, represented as a scene of one part."""

    def __init__(self, gaussians: GaussianCloud) -> None:
        self.gaussians = gaussians

    def __len__(self) -> int:
        return len(self.gaussians)

    def parts(self) -> Iterator[GaussianCloud]:
        """Yield the map."""
        yield self.gaussians

    def visible_from(self, camera: Camera, T_map_camera: NDArray[np.float64]) -> GaussianCloud:
        """Return the map."""
        return self.gaussians


class HalfPrecisionScene:
    """A scene whose features are rounded to half precision, as stored in run folders."""

    def __init__(self, scene: GaussianScene) -> None:
        self._scene = scene

    def __len__(self) -> int:
        return len(self._scene)

    def parts(self) -> Iterator[GaussianCloud]:
        """Yield all Gaussians part by part."""
        return (_rounded(part) for part in self._scene.parts())

    def visible_from(self, camera: Camera, T_map_camera: NDArray[np.float64]) -> GaussianCloud:
        """Return a superset of the Gaussians visible from a pose [4, 4]."""
        return _rounded(self._scene.visible_from(camera, T_map_camera))


def _rounded(cloud: GaussianCloud) -> GaussianCloud:
    return replace(cloud, features=cloud.features.half().float())
