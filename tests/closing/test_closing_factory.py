"""Loop closure from settings: every part gets what the settings name."""

from __future__ import annotations

import pytest

from toolkit.closing.factory import ClosingContext, build_loop_closer
from toolkit.mapping.semantic_mapping import SemanticMapping
from toolkit.settings.loop_closure import LoopClosureSettings


@pytest.mark.parametrize("optimiser", ["dense", "first-order"])
def test_registration_describes_views_with_the_encoder_of_the_settings(optimiser):
    """The feature term of G-6 is left out where nobody supplies an encoder."""
    settings = LoopClosureSettings.model_validate(
        {
            "features": {"kind": "colour-histogram"},
            "registration": {"fine": {"optimiser": optimiser}},
        }
    )
    context = ClosingContext(0, "auto", SemanticMapping(), None)
    parts = build_loop_closer(settings, context)._parts
    for stage in (parts.registrar.refiner, parts.nearby):
        assert stage.view_features.describer.name == "colour-histogram/rgb"
