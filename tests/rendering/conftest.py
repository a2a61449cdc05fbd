"""Fixtures: one test per compiled instruction set that this CPU supports."""

from __future__ import annotations

import pytest
from splat_scenes import native_backend

from toolkit.native import available_instruction_sets
from toolkit.rendering.native import NativeBackend


@pytest.fixture(params=available_instruction_sets())
def native(request: pytest.FixtureRequest) -> NativeBackend:
    """The native backend with each instruction set; skipped if none was built."""
    return native_backend(request.param)
