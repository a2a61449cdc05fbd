"""Loop closure from settings: every part gets what the settings name."""

from __future__ import annotations

import pytest

from toolkit.base.errors import SettingsError
from toolkit.base.options import validated
from toolkit.runs.building import build_slam
from toolkit.runs.settings import RunSettings
from toolkit.semantics.features.options import FeatureOptions
from toolkit.slam.loops.closing.factory import ClosingContext, build_loop_closer
from toolkit.slam.loops.closing.options import LoopClosureOptions
from toolkit.slam.loops.options import ObjectOptions
from toolkit.slam.loops.registration.options import RegistrationOptions
from toolkit.slam.mapping.semantic_mapping import SemanticMapping


def test_the_feature_term_of_registration_has_the_encoder_of_the_settings():
    """Without an encoder, the feature term of G-6 would be left out."""
    settings = LoopClosureOptions(features=FeatureOptions("colour-histogram"))
    registration = RegistrationOptions(optimiser="first-order")
    context = ClosingContext(0, "auto", SemanticMapping(), None)
    parts = build_loop_closer(settings, context, registration=registration)._parts
    for stage in (parts.registrar.refiner, parts.nearby):
        assert stage.view_features.describer.name == "colour-histogram/rgb"


def test_objects_are_the_instances_of_the_run():
    settings = validated(
        RunSettings,
        {
            "loops": {"features": {"kind": "colour-histogram"}, "objects": {"use": True}},
            "instances": {"kind": "geometric"},
            "segmenter": {"kind": "geometric"},
        },
    )
    slam = build_slam(settings=settings)
    listener = slam.listener("instances")
    assert listener is not None
    assert slam._closer._parts.objects._instances is listener.tracker


@pytest.mark.parametrize(("verify", "said"), [(True, "needs classes"), (False, "no-verify")])
def test_objects_need_classes_and_tests(verify, said):
    settings = LoopClosureOptions(
        features=FeatureOptions("colour-histogram"), verify=verify, objects=ObjectOptions(use=True)
    )
    with pytest.raises(SettingsError, match=said):
        build_loop_closer(settings, ClosingContext(0, "auto", SemanticMapping(), None))
