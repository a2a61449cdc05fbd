"""Build the registrar of an option, ours or a baseline, and its renderer."""

from __future__ import annotations

from toolkit.features.sources import ViewDescriber
from toolkit.loops.registration.clouds import CloudRegistration
from toolkit.loops.registration.fine import FineRegistration
from toolkit.loops.registration.first_order_fine import FirstOrderFineRegistration
from toolkit.loops.registration.options import (
    FineOptions,
    RegistrationOptions,
)
from toolkit.loops.registration.result import Registrar
from toolkit.loops.registration.second_opinion import SecondOpinion
from toolkit.loops.registration.sgr import CoarseOnly, SemanticGuidedRegistration, SgrOptions
from toolkit.loops.registration.two_way import TwoWayRegistration
from toolkit.loops.registration.views import ViewRenderer
from toolkit.mapping.semantic_mapping import SemanticMapping


def build_view_renderer(
    options: RegistrationOptions,
    semantics: SemanticMapping | None = None,
    backend_name: str = "auto",
) -> ViewRenderer:
    """Build the renderer of submaps for registration and its checks.

    Args:
        options: options of registration.
        semantics: decodes the features of the submaps; None disables classes.
        backend_name: rendering backend.
    """
    drawing = options.drawing
    return ViewRenderer(backend_name, semantics, drawing.min_silhouette, drawing.max_width)


def build_registrar(
    options: RegistrationOptions,
    seed: int,
    renderer: ViewRenderer,
    describer: ViewDescriber | None = None,
) -> Registrar:
    """Build the registrar of submaps selected by the options.

    Args:
        seed: random seed.
        renderer: renders the submaps, see `build_view_renderer`.
        describer: computes the view descriptors of the feature term of the first-order optimiser;
            None disables the term.
    """
    clouds = CloudRegistration(options.clouds, renderer, seed)
    if options.kind == "clouds":
        return clouds
    registrar = _view_registrar(options, seed, renderer, describer)
    return SecondOpinion(registrar, clouds) if options.second_opinion else registrar


def build_fine(
    options: FineOptions, renderer: ViewRenderer, describer: ViewDescriber | None = None
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
    fine = options.fine
    return fine.optimiser == "first-order" and fine.first_order.feature > 0


def _view_registrar(
    options: RegistrationOptions, seed: int, renderer: ViewRenderer, describer: ViewDescriber | None
) -> Registrar:
    """Build a registrar that compares rendered views."""
    fine = build_fine(options.fine, renderer, describer)
    if options.kind == "fine":
        return fine
    stages = SgrOptions(options.coarse, fine.options, seed)
    if options.kind == "coarse":
        return CoarseOnly(stages, renderer)
    if options.kind == "two-way":
        refiner = TwoWayRegistration(fine, options.coarse.average)
        return SemanticGuidedRegistration(stages, renderer, refiner)
    return SemanticGuidedRegistration(stages, renderer, fine)
