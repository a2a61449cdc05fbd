"""Registrars from settings."""

from __future__ import annotations

from dataclasses import asdict

import pytest

from toolkit.registration.coarse import CoarseOptions
from toolkit.registration.factory import build_drawer, build_registrar
from toolkit.registration.fallbacks import CloudOptions, CloudRegistration
from toolkit.registration.fine import FineOptions, FineRegistration
from toolkit.registration.sgr import CoarseOnly, SemanticGuidedRegistration
from toolkit.registration.two_way import TwoWayRegistration
from toolkit.settings.registration import (
    CloudSettings,
    CoarseSettings,
    FineSettings,
    RegistrationSettings,
)

KINDS = {
    "sgr": SemanticGuidedRegistration,
    "coarse": CoarseOnly,
    "fine": FineRegistration,
    "two-way": SemanticGuidedRegistration,
    "clouds": CloudRegistration,
}


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_can_be_built(kind):
    settings = RegistrationSettings(kind=kind)
    drawer = build_drawer(settings)
    assert isinstance(build_registrar(settings, 3, drawer), KINDS[kind])


def test_two_way_takes_the_place_of_the_fine_stage():
    settings = RegistrationSettings(kind="two-way")
    registrar = build_registrar(settings, 3, build_drawer(settings))
    assert isinstance(registrar, SemanticGuidedRegistration)
    assert isinstance(registrar.refiner, TwoWayRegistration)
    assert registrar.refiner.drawer is registrar.drawer


def test_settings_arrive():
    settings = RegistrationSettings.model_validate(
        {"coarse": {"offsets": "none"}, "fine": {"dense": {"levels": 2}}}
    )
    registrar = build_registrar(settings, 3, build_drawer(settings))
    assert isinstance(registrar, SemanticGuidedRegistration)
    assert registrar.options.seed == 3
    assert registrar.options.coarse.offsets == "none"
    assert registrar.options.fine.dense.levels == 2


@pytest.mark.parametrize(
    ("options", "settings"),
    [(CoarseOptions(), CoarseSettings()), (FineOptions(), FineSettings())],
    ids=["coarse", "fine"],
)
def test_defaults_of_options_and_settings_are_equal(options, settings):
    assert asdict(options) == settings.model_dump()


def test_defaults_of_clouds_are_equal():
    assert asdict(CloudOptions()) == CloudSettings().model_dump() | {"seed": 0}
