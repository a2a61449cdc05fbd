"""The dense tracker from settings; `toolkit.baselines.factory` builds the tracker they name."""

from __future__ import annotations

from toolkit.frame import Recorder
from toolkit.settings.tracking import TrackingSettings
from toolkit.tracking.dense import DenseOptions, DenseTracker
from toolkit.tracking.health import HealthLimits


def build_dense_tracker(
    settings: TrackingSettings,
    backend_name: str = "auto",
    recorder: Recorder | None = None,
    centred: bool = True,
) -> DenseTracker:
    """Build the dense tracker.

    Args:
        centred: the map's colours belong to the Gaussians' centres, see `MapperOptions`.
    """
    options = DenseOptions(**settings.dense.model_dump())
    limits = HealthLimits(**settings.health.model_dump())
    return DenseTracker(options, limits, backend_name, recorder, centred)
