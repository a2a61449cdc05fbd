"""Trackers from settings."""

from __future__ import annotations

from toolkit.frame import Recorder
from toolkit.semantics.codes import SemanticCode
from toolkit.settings.tracking import TrackingSettings
from toolkit.tracking.dense import DenseOptions, DenseTracker
from toolkit.tracking.first_order import FirstOrderOptions, FirstOrderTracker
from toolkit.tracking.health import HealthLimits
from toolkit.tracking.tracker import Tracker


def build_tracker(
    settings: TrackingSettings,
    backend_name: str = "auto",
    recorder: Recorder | None = None,
    code: SemanticCode | None = None,
    centred: bool = True,
) -> Tracker:
    """The tracker that the settings name.

    Args:
        code: of the map's features. centred: how mapping fits colours, see `MapperOptions`.
    """
    limits = HealthLimits(**settings.health.model_dump())
    if settings.kind == "first-order":
        slow = FirstOrderOptions(**settings.first_order.model_dump())
        return FirstOrderTracker(slow, limits, backend_name, recorder, code)
    options = DenseOptions(**settings.dense.model_dump())
    return DenseTracker(options, limits, backend_name, recorder, centred)
