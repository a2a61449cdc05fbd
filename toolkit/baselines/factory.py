"""Trackers and registrars from settings: our method, or the baseline that the settings name."""

from __future__ import annotations

from toolkit.baselines.clouds import CloudOptions, CloudRegistration
from toolkit.baselines.first_order_fine import FirstOrderFineRegistration
from toolkit.baselines.first_order_tracker import FirstOrderTracker
from toolkit.baselines.two_way import TwoWayRegistration
from toolkit.features.sources import ViewDescriber
from toolkit.frame import Recorder
from toolkit.registration.factory import coarse_options, fine_options
from toolkit.registration.fine import FineRegistration
from toolkit.registration.motion_average import AverageOptions
from toolkit.registration.result import Registrar
from toolkit.registration.second_opinion import SecondOpinion
from toolkit.registration.sgr import CoarseOnly, SemanticGuidedRegistration, SgrOptions
from toolkit.registration.views import ViewDrawer
from toolkit.semantics.codes import SemanticCode
from toolkit.settings.registration import FineSettings, RegistrationSettings
from toolkit.tracking.dense import DenseTracker
from toolkit.tracking.options import TrackingOptions
from toolkit.tracking.tracker import Tracker


def build_tracker(
    options: TrackingOptions,
    backend_name: str = "auto",
    recorder: Recorder | None = None,
    code: SemanticCode | None = None,
    centred: bool = True,
) -> Tracker:
    """Build the tracker that the options name.

    Args:
        code: semantic code of the map's features.
        centred: the map's colours belong to the Gaussians' centres, see `MapperOptions`.
    """
    if options.kind == "first-order":
        return FirstOrderTracker(options.first_order, options.health, backend_name, recorder, code)
    return DenseTracker(options.dense, options.health, backend_name, recorder, centred)


def build_registrar(
    settings: RegistrationSettings,
    seed: int,
    drawer: ViewDrawer,
    describer: ViewDescriber | None = None,
) -> Registrar:
    """Build the registrar of submaps that the settings name.

    Args:
        seed: of its random generators.
        drawer: renders the submaps, see `build_drawer`.
        describer: describes views for the feature term of the first-order optimiser; None
            leaves the term out.
    """
    clouds = CloudRegistration(CloudOptions(**settings.clouds.model_dump(), seed=seed), drawer)
    if settings.kind == "clouds":
        return clouds
    registrar = _view_registrar(settings, seed, drawer, describer)
    return SecondOpinion(registrar, clouds) if settings.second_opinion else registrar


def build_fine(
    settings: FineSettings, drawer: ViewDrawer, describer: ViewDescriber | None = None
) -> FineRegistration:
    """Build fine registration with the optimiser that the settings name.

    Args:
        describer: see `build_registrar`.
    """
    options = fine_options(settings)
    if options.optimiser == "first-order":
        return FirstOrderFineRegistration(options, drawer, describer)
    return FineRegistration(options, drawer)


def needs_describer(settings: RegistrationSettings) -> bool:
    """Whether registration has the feature term of G-6, which needs a describer of views."""
    fine = settings.fine
    return fine.optimiser == "first-order" and fine.first_order.feature > 0


def _view_registrar(
    settings: RegistrationSettings, seed: int, drawer: ViewDrawer, describer: ViewDescriber | None
) -> Registrar:
    """The registrar that compares rendered views."""
    fine = build_fine(settings.fine, drawer, describer)
    if settings.kind == "fine":
        return fine
    options = SgrOptions(coarse_options(settings.coarse), fine.options, seed)
    if settings.kind == "coarse":
        return CoarseOnly(options, drawer)
    if settings.kind == "two-way":
        average = AverageOptions(**settings.coarse.average.model_dump())
        return SemanticGuidedRegistration(options, drawer, TwoWayRegistration(fine, average))
    return SemanticGuidedRegistration(options, drawer, fine)
