"""Two submaps of a small room, without semantics and with it."""

from __future__ import annotations

import pytest
from registered_room import Scene, classes, scene

from toolkit.mapping.semantic_mapping import SemanticMapping
from toolkit.registration.views import ViewRenderer


@pytest.fixture(scope="session")
def room() -> Scene:
    return scene()


@pytest.fixture(scope="session")
def semantics() -> SemanticMapping:
    return classes()


@pytest.fixture(scope="session")
def labelled_room(semantics: SemanticMapping) -> Scene:
    return scene((0, 8), (12, 4), semantics)


@pytest.fixture
def renderer() -> ViewRenderer:
    return ViewRenderer()
