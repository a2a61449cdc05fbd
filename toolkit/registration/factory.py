"""Registration from settings; `toolkit.baselines.factory` builds the registrar they name."""

from __future__ import annotations

from typing import Any

from toolkit.alignment.joint import JointOptions
from toolkit.alignment.matching import MatchingOptions
from toolkit.mapping.semantic_mapping import SemanticMapping
from toolkit.registration.coarse import CoarseOptions
from toolkit.registration.fine import FineOptions, FirstOrderFineOptions
from toolkit.registration.motion_average import AverageOptions
from toolkit.registration.views import ViewDrawer
from toolkit.settings.registration import (
    CoarseSettings,
    FineSettings,
    MatchingSettings,
    PlacementSettings,
    RegistrationSettings,
)
from toolkit.tracking.placement import KeyframePlacement, PlacementOptions


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
    values["limits"] = settings.limits
    return MatchingOptions(**values)


def coarse_options(settings: CoarseSettings) -> CoarseOptions:
    """Values of the coarse stage."""
    return CoarseOptions(
        pairs=settings.pairs,
        offsets=settings.offsets,
        min_agreeing=settings.min_agreeing,
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
