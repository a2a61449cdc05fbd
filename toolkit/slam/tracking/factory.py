"""Build the tracker of an option: ours, or the baseline of H-10."""

from __future__ import annotations

from toolkit.base.frame import Recorder
from toolkit.semantics.codes import SemanticCode
from toolkit.slam.tracking.dense import DenseTracker
from toolkit.slam.tracking.first_order_tracker import FirstOrderTracker
from toolkit.slam.tracking.options import TrackingOptions
from toolkit.slam.tracking.tracker import Tracker
from toolkit.splatting.alignment.health import NO_LIMITS, HealthLimits


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
    limits = HealthLimits() if options.detect_lost else NO_LIMITS
    if options.kind == "first-order":
        return FirstOrderTracker(options.first_order, limits, backend_name, recorder, code)
    return DenseTracker(options.dense, limits, backend_name, recorder)
