"""Fixtures: each instruction set that this CPU supports; new memory without usable values."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
import torch
from splat_scenes import native_backend

from toolkit.base.native import available_instruction_sets
from toolkit.splatting.rendering.native import NativeRenderer


@pytest.fixture(params=available_instruction_sets())
def native(request: pytest.FixtureRequest) -> NativeRenderer:
    """The native backend with each instruction set; skipped if none was built."""
    return native_backend(request.param)


@pytest.fixture
def poisoned_memory() -> Iterator[None]:
    """Fill new memory with NaN and maximum integers to detect elements that are not written."""
    torch.set_deterministic_debug_mode("warn")
    assert torch.empty(1).isnan()
    yield
    torch.set_deterministic_debug_mode("default")
