"""A few frames of a small room with their true poses, and few matches for small images."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from slam_room import SlamRoom, first_steps

from toolkit.slam.loops.registration import pooled
from toolkit.splatting.alignment import matching


@pytest.fixture(scope="session")
def room() -> SlamRoom:
    return first_steps()


@pytest.fixture(scope="module")
def few_matches() -> Iterator[None]:
    """Relocalisation and registration in images too small for many features."""
    with pytest.MonkeyPatch.context() as patch:
        for module in (matching, pooled):
            patch.setattr(module, "MIN_MATCHES", 6)
        yield
