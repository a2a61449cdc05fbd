"""Bundle adjustment with the compiled kernel, or with the reference where there is none."""

from __future__ import annotations

from toolkit.base.native.loading import kernels
from toolkit.depth.monocular.bundle_adjustment import native, reference
from toolkit.depth.monocular.bundle_adjustment.problem import (
    BundleOptions,
    BundleProblem,
    BundleResult,
)


def adjust(problem: BundleProblem, options: BundleOptions | None = None) -> BundleResult:
    """Minimise the reprojection errors of a problem over poses and inverse depths.

    Levenberg-Marquardt with Huber's cost; landmarks are eliminated. Unobservable directions, such
    as the scale where fewer than two poses are fixed, keep their initial values.
    """
    options = options or BundleOptions()
    module = kernels()
    if module is None:
        return reference.adjust(problem, options)
    return native.adjust(module, problem, options)
