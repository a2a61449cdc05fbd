"""A few frames of a small room with their true poses."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from numpy.typing import NDArray

from toolkit.base.frame import Frame
from toolkit.base.geometry import se3
from toolkit.datasets.synthetic_rooms import tiny_room
from toolkit.slam.mapping import hidden_gaussians


@dataclass(frozen=True)
class MappedRoom:
    """Frames, and their true poses in the first camera's frame."""

    frames: list[Frame]
    T_map_camera: NDArray[np.float64]


@pytest.fixture(scope="session")
def room() -> MappedRoom:
    frames, truth = tiny_room(12, 80, 60)
    T_map_world = se3.inverse(truth.T_world_camera[0])
    return MappedRoom(frames, T_map_world @ truth.T_world_camera)


@pytest.fixture
def hidden_too(monkeypatch: pytest.MonkeyPatch) -> None:
    """Finished maps keep the Gaussians that no keyframe shows."""
    monkeypatch.setattr(hidden_gaussians, "_MIN_PIXELS", 0.0)
