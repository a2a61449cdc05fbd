"""A few frames of a small room with their true poses."""

from __future__ import annotations

import pytest
from slam_room import SlamRoom, first_steps


@pytest.fixture(scope="session")
def room() -> SlamRoom:
    return first_steps()
