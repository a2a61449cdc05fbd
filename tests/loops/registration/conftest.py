"""Two submaps of a small room, without semantics and with it, and Open3D on one thread."""

from __future__ import annotations

import numpy as np
import pytest
import registered_room
from registered_room import Scene, classes, scene

from toolkit.base.keyframe import Keyframe
from toolkit.slam.loops.registration.views import ViewRenderer
from toolkit.slam.mapping.semantic_mapping import SemanticMapping


@pytest.fixture(scope="session")
def room() -> Scene:
    return scene()


@pytest.fixture(scope="session")
def semantics() -> SemanticMapping:
    return classes()


@pytest.fixture(scope="session")
def labelled_room(semantics: SemanticMapping) -> Scene:
    return scene((0, 8), (12, 4), semantics)


@pytest.fixture(scope="session")
def stranger() -> Keyframe:
    """A view of another room, at a pose that means nothing."""
    return registered_room.stranger()


@pytest.fixture
def renderer() -> ViewRenderer:
    return ViewRenderer()


@pytest.fixture
def generator() -> np.random.Generator:
    return np.random.default_rng(0)
