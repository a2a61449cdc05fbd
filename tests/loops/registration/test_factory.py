"""Registrars from settings."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from registered_room import motion

from toolkit.semantics.features.builtin import BuiltinEncoder
from toolkit.semantics.features.factory import build_differentiable_describer
from toolkit.semantics.features.options import FeatureOptions
from toolkit.slam.loops.registration import first_order_fine
from toolkit.slam.loops.registration.factory import build_registrar, needs_describer
from toolkit.slam.loops.registration.fine import FineRegistration
from toolkit.slam.loops.registration.options import RegistrationOptions
from toolkit.slam.loops.registration.result import RegistrationResult
from toolkit.slam.loops.registration.sgr import CoarseOnly, SemanticGuidedRegistration
from toolkit.slam.loops.registration.views import ViewRenderer

KINDS = {
    "sgr": SemanticGuidedRegistration,
    "coarse": CoarseOnly,
    "fine": FineRegistration,
}


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_can_be_built(kind):
    settings = RegistrationOptions(kind=kind)
    assert isinstance(build_registrar(settings, 3, ViewRenderer()), KINDS[kind])


@pytest.mark.parametrize("kind", ["sgr", "fine"])
def test_the_feature_term_describes_views_with_the_given_encoder(kind, room, monkeypatch):
    """G-6 has a feature term; without an encoder it would be left out in silence."""
    described = []

    def describe(encoder: BuiltinEncoder, images: torch.Tensor) -> torch.Tensor:
        described.append(images.requires_grad)
        return plain(encoder, images)

    plain = BuiltinEncoder.describe
    monkeypatch.setattr(BuiltinEncoder, "describe", describe)
    monkeypatch.setattr(first_order_fine, "_ITERATIONS", 1)
    settings = RegistrationOptions(kind=kind, optimiser="first-order", views=1)
    assert needs_describer(settings)
    describer = build_differentiable_describer(FeatureOptions())
    registrar = build_registrar(settings, 3, ViewRenderer(), describer)
    registrar.register(room.target, room.source, room.T_target_source)
    assert True in described and False in described  # of the target, and of the frozen source


def test_the_feature_term_has_a_weight(room, monkeypatch):
    monkeypatch.setattr(first_order_fine, "_ITERATIONS", 2)

    def found(feature: float) -> RegistrationResult:
        settings = RegistrationOptions("fine", optimiser="first-order", views=1, feature=feature)
        assert needs_describer(settings) is (feature > 0)
        describer = build_differentiable_describer(FeatureOptions())
        start = room.T_target_source @ motion(1, 0.02, 1.0)
        registrar = build_registrar(settings, 3, ViewRenderer(), describer)
        return registrar.register(room.target, room.source, start)

    assert not np.array_equal(found(0.0).T_target_source, found(5.0).T_target_source)


def test_settings_arrive():
    settings = RegistrationOptions(offsets="none")
    registrar = build_registrar(settings, 3, ViewRenderer())
    assert isinstance(registrar, SemanticGuidedRegistration)
    assert registrar.seed == 3
    assert registrar.options is registrar.refiner.options is settings
