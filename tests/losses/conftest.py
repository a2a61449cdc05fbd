"""Every compiled instruction set, and two images that differ as renderings do."""

from __future__ import annotations

from types import ModuleType

import pytest

from toolkit.losses import photometric
from toolkit.native import available_instruction_sets, load_variant


@pytest.fixture(params=[*available_instruction_sets(), "torch"])
def kernels(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """Each way to compute the losses: every compiled variant, then plain torch."""
    module: ModuleType | None = None if request.param == "torch" else load_variant(request.param)
    monkeypatch.setattr(photometric, "kernels_for", lambda tensor: module)
    return str(request.param)
