"""Frames of a small room, two submaps of it, and every compiled instruction set."""

from __future__ import annotations

from types import ModuleType

import pytest
from tracked_room import Room, first_steps

from toolkit.base.keyframe import Keyframe
from toolkit.base.native import available_instruction_sets, load_variant


@pytest.fixture(scope="session")
def room() -> Room:
    return first_steps()


@pytest.fixture(scope="session")
def submaps():
    # Imported here: the tests of the GPU run where libraries that submaps need are missing.
    from registered_room import scene

    return scene()


@pytest.fixture(scope="session")
def stranger() -> Keyframe:
    from registered_room import stranger

    return stranger()


@pytest.fixture(params=available_instruction_sets())
def module(request: pytest.FixtureRequest) -> ModuleType:
    """The compiled kernels, once for each instruction set."""
    return load_variant(request.param)
