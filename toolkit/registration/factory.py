"""Registration from settings."""

from __future__ import annotations

from typing import Any

from toolkit.alignment.joint import JointOptions
from toolkit.features.sources import ViewDescriber
from toolkit.mapping.semantic_mapping import SemanticMapping
from toolkit.registration.coarse import CoarseOptions
from toolkit.registration.fallbacks import CloudOptions, CloudRegistration
from toolkit.registration.fine import FineOptions, FineRegistration
from toolkit.registration.fine_first_order import FirstOrderFineOptions
from toolkit.registration.matching import MatchingOptions
from toolkit.registration.motion_average import AverageOptions
from toolkit.registration.placement import KeyframePlacement, PlacementOptions
from toolkit.registration.result import Registrar
from toolkit.registration.second_opinion import SecondOpinion
from toolkit.registration.sgr import CoarseOnly, SemanticGuidedRegistration, SgrOptions
from toolkit.registration.two_way import TwoWayRegistration
from toolkit.registration.views import ViewDrawer
from toolkit.settings.registration import (
    CoarseSettings,
    FineSettings,
    MatchingSettings,
    PlacementSettings,
    RegistrationSettings,
)
from toolkit.tracking.health import HealthLimits


def build_registrar(
    settings: RegistrationSettings,
    seed: int,
    drawer: ViewDrawer,
    describer: ViewDescriber | None = None,
) -> Registrar:
    """The registrar that the settings name.

    Args:
        seed: of its random choices.
        drawer: as `build_drawer` makes it.
        describer: of views, for the feature term of the first-order optimiser; None leaves the
            term out.
    """
    clouds = CloudRegistration(CloudOptions(**settings.clouds.model_dump(), seed=seed), drawer)
    if settings.kind == "clouds":
        return clouds
    registrar = _by_views(settings, seed, drawer, describer)
    return SecondOpinion(registrar, clouds) if settings.second_opinion else registrar


def needs_describer(settings: RegistrationSettings) -> bool:
    """Whether registration has the feature term of G-6, and so needs a describer of views."""
    fine = settings.fine
    return fine.optimiser == "first-order" and fine.first_order.feature > 0


def _by_views(
    settings: RegistrationSettings, seed: int, drawer: ViewDrawer, describer: ViewDescriber | None
) -> Registrar:
    fine = fine_options(settings.fine)
    if settings.kind == "fine":
        return FineRegistration(fine, drawer, describer)
    options = SgrOptions(coarse_options(settings.coarse), fine, seed)
    if settings.kind == "coarse":
        return CoarseOnly(options, drawer)
    refiner = None
    if settings.kind == "two-way":
        average = AverageOptions(**settings.coarse.average.model_dump())
        refiner = TwoWayRegistration(fine, drawer, average, describer)
    return SemanticGuidedRegistration(options, drawer, describer, refiner)


def build_placement(settings: PlacementSettings) -> KeyframePlacement | None:
    """What places keyframes, None where the tracker does it alone."""
    if not settings.use:
        return None
    values: dict[str, Any] = settings.model_dump(exclude={"use"})
    values["dense"] = JointOptions(**values["dense"])
    return KeyframePlacement(PlacementOptions(**values))


def build_drawer(
    settings: RegistrationSettings,
    semantics: SemanticMapping | None = None,
    backend_name: str = "auto",
    centred: bool = True,
) -> ViewDrawer:
    """What draws submaps for registration and for its checks.

    Args:
        centred: how their colours were fitted, see `MapperOptions`; False once refined.
    """
    drawing = settings.drawing.model_dump()
    return ViewDrawer(backend_name, semantics, centred=centred, **drawing)


def matching_options(settings: MatchingSettings) -> MatchingOptions:
    """Values of `measure_offset`."""
    values: dict[str, Any] = settings.model_dump()
    values["dense"] = JointOptions(**values["dense"])
    values["limits"] = HealthLimits(**values["limits"])
    return MatchingOptions(**values)


def coarse_options(settings: CoarseSettings) -> CoarseOptions:
    """Values of the coarse stage."""
    return CoarseOptions(
        pairs=settings.pairs,
        offsets=settings.offsets,
        least_agreeing=settings.least_agreeing,
        enough=settings.enough,
        matching=matching_options(settings.matching),
        average=AverageOptions(**settings.average.model_dump()),
    )


def fine_options(settings: FineSettings) -> FineOptions:
    """Values of the fine stage."""
    values: dict[str, Any] = settings.model_dump()
    values["dense"] = JointOptions(**values["dense"])
    values["first_order"] = FirstOrderFineOptions(**values["first_order"])
    return FineOptions(**values)
