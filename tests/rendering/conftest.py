"""Fixtures: one test per compiled instruction set that this CPU supports."""

from __future__ import annotations

import pytest
from splat_scenes import native_backend

from toolkit.native import available_instruction_sets
from toolkit.rendering.native import NativeRenderer


@pytest.fixture(params=available_instruction_sets())
def native(request: pytest.FixtureRequest) -> NativeRenderer:
    """The native backend with each instruction set; skipped if none was built."""
    return native_backend(request.param)
