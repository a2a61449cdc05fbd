"""A few frames of a small room, a map of the first, and every compiled instruction set."""

from __future__ import annotations

from types import ModuleType

import numpy as np
import pytest
from tracked_room import Room, first_steps

from toolkit.gaussians.cloud import GaussianCloud
from toolkit.gaussians.seeding import SeedingOptions, seed
from toolkit.keyframe import Keyframe
from toolkit.mapping.mapper import Mapper
from toolkit.native import available_instruction_sets, load_variant


@pytest.fixture(scope="session")
def room() -> Room:
    return first_steps()


@pytest.fixture(scope="session")
def gaussians(room: Room) -> GaussianCloud:
    """A map of the first frame alone."""
    mapper = Mapper()
    mapper.add_keyframe(Keyframe.from_frame(room.frames[0], room.T_map_camera[0]))
    return mapper.gaussians


@pytest.fixture(scope="session")
def opaque_map(room: Room) -> GaussianCloud:
    """The same, as the papers seed it: a wide Gaussian a pixel, no holes for their mask."""
    frame = room.frames[0]
    everywhere = np.ones_like(frame.depth_m, dtype=bool)
    return seed(frame, np.eye(4), everywhere, SeedingOptions(1.0, 0.95, largest_cell=1))


@pytest.fixture(params=available_instruction_sets())
def module(request: pytest.FixtureRequest) -> ModuleType:
    """The compiled kernels, once for each instruction set; skipped where none was built."""
    loaded = load_variant(request.param)
    assert loaded is not None
    return loaded
