"""Fixtures: scenes are created once, because this takes most of a second."""

import pytest

from toolkit.datasets.synthetic_rooms.layouts import Layout, build_scene, single_room
from toolkit.datasets.synthetic_rooms.ray_casting import Scene


@pytest.fixture(scope="session")
def layout() -> Layout:
    return single_room()


@pytest.fixture(scope="session")
def scene(layout: Layout) -> Scene:
    """The default room with coarse textures."""
    return build_scene(layout, seed=0, texel_m=0.016)
