"""Build trackers and registrars from options: our methods or the baselines."""

from __future__ import annotations

from toolkit.baselines.clouds import CloudRegistration
from toolkit.baselines.first_order_fine import FirstOrderFineRegistration
from toolkit.baselines.first_order_tracker import FirstOrderTracker
from toolkit.baselines.two_way import TwoWayRegistration
from toolkit.features.sources import ViewDescriber
from toolkit.frame import Recorder
from toolkit.registration.fine import FineRegistration
from toolkit.registration.options import (
    FineOptions,
    RegistrationOptions,
)
from toolkit.registration.result import Registrar
from toolkit.registration.second_opinion import SecondOpinion
from toolkit.registration.sgr import CoarseOnly, SemanticGuidedRegistration, SgrOptions
from toolkit.registration.views import ViewRenderer
from toolkit.semantics.codes import SemanticCode
from toolkit.tracking.dense import DenseTracker
from toolkit.tracking.options import TrackingOptions
from toolkit.tracking.tracker import Tracker


def build_tracker(
    options: TrackingOptions,
    backend_name: str = "auto",
    recorder: Recorder | None = None,
    code: SemanticCode | None = None,
) -> Tracker:
    """Build the tracker selected by the options.

    Args:
        code: semantic code of the map's features.
    """
    if options.kind == "first-order":
        return FirstOrderTracker(options.first_order, options.health, backend_name, recorder, code)
    return DenseTracker(options.dense, options.health, backend_name, recorder)


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
