"""Whether depth priors agree with the motion of the camera."""

from __future__ import annotations

import numpy as np

from toolkit.datasets.images_only import ImagesOnly
from toolkit.depth.depth_priors.kind_check import MAX_KEYFRAMES, KnownDepths, prior_doubt
from toolkit.depth.depth_priors.multi_view import SweptKeyframe
from toolkit.depth.depth_priors.options import DepthPriorOptions
from toolkit.depth.depth_priors.provider import DepthProvider
from toolkit.depth.monocular.motion import CameraMotion


def doubt_about_priors(
    motion: CameraMotion,
    images: ImagesOnly,
    provider: DepthProvider,
    options: DepthPriorOptions,
    option: str | None,
) -> str | None:
    """A line about priors that contradict the motion or their declaration; None if they agree.

    Args:
        motion: with keyframes.
        images: of the sequence.
        provider: of priors.
        options: of their use.
        option: as in `prior_doubt`.

    Raises:
        ToolkitError: a file is missing or unreadable, or the model fails.
    """
    views = _chosen(motion.views, options.size if provider.joint else None)
    priors = provider.predict([images[view.frame] for view in views]).priors
    known = [KnownDepths(view.points[:, :2], view.points[:, 2]) for view in views]
    return prior_doubt(priors, known, option)


def _chosen(views: list[SweptKeyframe], size: int | None) -> list[SweptKeyframe]:
    """Evenly spaced keyframes; for models that need neighbours, one set of those in the middle."""
    if size is not None:
        first = max(0, (len(views) - size) // 2)
        return views[first : first + size]
    count = min(MAX_KEYFRAMES, len(views))
    return [views[n] for n in np.linspace(0, len(views) - 1, count).round().astype(int)]
