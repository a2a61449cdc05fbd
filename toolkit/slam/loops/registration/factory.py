"""Build the registrar of an option, ours or a baseline."""

from __future__ import annotations

from toolkit.semantics.features.sources import ViewDescriber
from toolkit.slam.loops.registration.clouds import CloudRegistration
from toolkit.slam.loops.registration.fine import FineRegistration
from toolkit.slam.loops.registration.first_order_fine import FirstOrderFineRegistration
from toolkit.slam.loops.registration.options import RegistrationOptions
from toolkit.slam.loops.registration.result import Registrar
from toolkit.slam.loops.registration.sgr import (
    CoarseOnly,
    SecondOpinion,
    SemanticGuidedRegistration,
)
from toolkit.slam.loops.registration.two_way import TwoWayRegistration
from toolkit.slam.loops.registration.views import ViewRenderer


def build_registrar(
    options: RegistrationOptions,
    seed: int,
    renderer: ViewRenderer,
    describer: ViewDescriber | None = None,
) -> Registrar:
    """Build the registrar of submaps selected by the options.

    Args:
        seed: random seed.
        renderer: renders the submaps.
        describer: computes the view descriptors of the feature term of the first-order optimiser;
            None disables the term.
    """
    clouds = CloudRegistration(renderer=renderer, seed=seed)
    if options.kind == "clouds":
        return clouds
    registrar = _view_registrar(options, seed, renderer, describer)
    return SecondOpinion(registrar, clouds) if options.second_opinion else registrar


def build_fine(
    options: RegistrationOptions, renderer: ViewRenderer, describer: ViewDescriber | None = None
) -> FineRegistration:
    """Build fine registration with the optimiser selected by the options.

    Args:
        describer: see `build_registrar`.
    """
    if options.optimiser == "first-order":
        return FirstOrderFineRegistration(options, renderer, describer)
    return FineRegistration(options, renderer)


def needs_describer(options: RegistrationOptions) -> bool:
    """Whether registration uses the feature term of G-6, which needs view descriptors."""
    return options.optimiser == "first-order" and options.feature > 0


def _view_registrar(
    options: RegistrationOptions, seed: int, renderer: ViewRenderer, describer: ViewDescriber | None
) -> Registrar:
    """Build a registrar that compares rendered views."""
    fine = build_fine(options, renderer, describer)
    if options.kind == "fine":
        return fine
    if options.kind == "coarse":
        return CoarseOnly(options, renderer, seed)
    refiner = TwoWayRegistration(fine) if options.kind == "two-way" else fine
    return SemanticGuidedRegistration(options, renderer, refiner, seed)
