"""A finished map that need not be in memory as a whole."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from toolkit.gaussians.cloud import GaussianCloud
from toolkit.geometry.camera import Camera


class GaussianScene(Protocol):
    """Gaussians of one frame that come in parts."""

    def __len__(self) -> int:
        """How many Gaussians there are."""
        ...

    def parts(self) -> Iterator[GaussianCloud]:
        """All of them, one part after another."""
        ...

    def seen_from(self, camera: Camera, T_map_camera: NDArray[np.float64]) -> GaussianCloud:
        """At least those that a view [4, 4] shows, in the order in which they come."""
        ...


class WholeScene:
    """A map in memory, as a scene of one part."""

    def __init__(self, gaussians: GaussianCloud) -> None:
        self.gaussians = gaussians

    def __len__(self) -> int:
        return len(self.gaussians)

    def parts(self) -> Iterator[GaussianCloud]:
        """The map."""
        yield self.gaussians

    def seen_from(self, camera: Camera, T_map_camera: NDArray[np.float64]) -> GaussianCloud:
        """The map."""
        return self.gaussians


class RoundedScene:
    """A scene with features in half precision, as a run's folder keeps them."""

    def __init__(self, scene: GaussianScene) -> None:
        self._scene = scene

    def __len__(self) -> int:
        return len(self._scene)

    def parts(self) -> Iterator[GaussianCloud]:
        """All Gaussians, one part after another."""
        return (_rounded(part) for part in self._scene.parts())

    def seen_from(self, camera: Camera, T_map_camera: NDArray[np.float64]) -> GaussianCloud:
        """At least those that a view shows."""
        return _rounded(self._scene.seen_from(camera, T_map_camera))


def _rounded(cloud: GaussianCloud) -> GaussianCloud:
    return replace(cloud, features=cloud.features.half().float())
