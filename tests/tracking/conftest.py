"""A few frames of a small room, a map of the first, and every compiled instruction set."""

from __future__ import annotations

from types import ModuleType

import pytest
from tracked_room import Room, first_steps, map_of_first_frame

from toolkit.base.native import available_instruction_sets, load_variant
from toolkit.splatting.gaussians.cloud import GaussianCloud


@pytest.fixture(scope="session")
def room() -> Room:
    return first_steps()


@pytest.fixture(scope="session")
def gaussians() -> GaussianCloud:
    return map_of_first_frame()


@pytest.fixture(params=available_instruction_sets())
def module(request: pytest.FixtureRequest) -> ModuleType:
    """The compiled kernels, once for each instruction set; skipped where none was built."""
    loaded = load_variant(request.param)
    assert loaded is not None
    return loaded
