"""Two submaps of a small room, without semantics and with it, and Open3D on one thread."""

from __future__ import annotations

import numpy as np
import pytest
from registered_room import Scene, classes, motion, scene

from toolkit.datasets.synthetic import tiny_room
from toolkit.keyframe import Keyframe
from toolkit.mapping.semantic_mapping import SemanticMapping
from toolkit.registration.views import ViewDrawer


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
    frames, _ = tiny_room(1, 160, 120, seed=5)
    return Keyframe.from_frame(frames[0], motion(8, 1.0, 30.0))


@pytest.fixture
def drawer() -> ViewDrawer:
    return ViewDrawer()


@pytest.fixture
def generator() -> np.random.Generator:
    return np.random.default_rng(0)
