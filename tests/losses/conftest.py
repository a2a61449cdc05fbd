"""Fixtures: compiled instruction sets, and a pair of similar images."""

from __future__ import annotations

from types import ModuleType

import pytest

from toolkit.base.native import available_instruction_sets, load_variant
from toolkit.splatting.losses import photometric


@pytest.fixture(params=[*available_instruction_sets(), "torch"])
def kernels(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """Each implementation of the losses: every compiled variant, then plain torch."""
    module: ModuleType | None = None if request.param == "torch" else load_variant(request.param)
    monkeypatch.setattr(photometric, "kernels_for", lambda tensor: module)
    return str(request.param)
