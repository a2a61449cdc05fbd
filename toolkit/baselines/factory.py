"""Trackers and registrars from options: our method, or the baseline that they name."""

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
    """Build the tracker that the options name.

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
    """Build the registrar of submaps that the options name.

    Args:
        seed: of its random generators.
        renderer: renders the submaps, see `build_view_renderer`.
        describer: describes views for the feature term of the first-order optimiser; None
            leaves the term out.
    """
    clouds = CloudRegistration(options.clouds, renderer, seed)
    if options.kind == "clouds":
        return clouds
    registrar = _view_registrar(options, seed, renderer, describer)
    return SecondOpinion(registrar, clouds) if options.second_opinion else registrar


def build_fine(
    options: FineOptions, renderer: ViewRenderer, describer: ViewDescriber | None = None
) -> FineRegistration:
    """Build fine registration with the optimiser that the options name.

    Args:
        describer: see `build_registrar`.
    """
    if options.optimiser == "first-order":
        return FirstOrderFineRegistration(options, renderer, describer)
    return FineRegistration(options, renderer)


def needs_describer(options: RegistrationOptions) -> bool:
    """Whether registration has the feature term of G-6, which needs a describer of views."""
    fine = options.fine
    return fine.optimiser == "first-order" and fine.first_order.feature > 0


def _view_registrar(
    options: RegistrationOptions, seed: int, renderer: ViewRenderer, describer: ViewDescriber | None
) -> Registrar:
    """The registrar that compares rendered views."""
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
