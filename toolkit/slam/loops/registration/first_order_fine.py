"""Baseline: the paper's fine registration, Adam on the pose of the source submap (G-6).

Its loss compares colour, semantic features and image descriptors of rendered views.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from toolkit.base.geometry import se3
from toolkit.base.geometry.camera import Camera
from toolkit.semantics.features.sources import ViewDescriber
from toolkit.slam.loops.registration.fine import DENSE, FineRegistration, SourceView, TargetView
from toolkit.slam.loops.registration.options import RegistrationOptions
from toolkit.slam.loops.registration.views import ViewRenderer
from toolkit.slam.mapping.view_features import ViewFeatures
from toolkit.slam.submaps.submap import Submap
from toolkit.splatting.alignment.joint import Estimate, Pair, align
from toolkit.splatting.alignment.pose_adam import PoseAdam, pose_gradient
from toolkit.splatting.gaussians.cloud import GaussianCloud
from toolkit.splatting.rendering import RenderOutput, render

Array = NDArray[np.float64]
# Adam's rounds: each one starts at the best pose so far with lower learning rates, and ends after a
# number of iterations without a relative decrease of the loss.
_ITERATIONS = 150
_TRANSLATION_RATE_M, _ROTATION_RATE_RAD = 0.005, 0.003
_ROUNDS, _RATE_DECAY = 3, 0.2
_PATIENCE, _MIN_GAIN = 8, 0.001
# Minimum silhouette in both maps of the pixels compared.
_MIN_SILHOUETTE = 0.9
# Views with fewer common pixels are ignored.
_MIN_PIXELS = 50
# Fixed-point iterations of the residual scales.
_SCALE_ITERATIONS = 8


class FirstOrderFineRegistration(FineRegistration):
    """Registers two submaps with the paper's loss and optimiser; see Registrar.

    Args:
        describer: computes the view descriptors of the feature term; None disables the term.
    """

    method = "fine (first-order)"

    def __init__(
        self,
        options: RegistrationOptions | None = None,
        renderer: ViewRenderer | None = None,
        describer: ViewDescriber | None = None,
    ) -> None:
        super().__init__(options, renderer)
        self.view_features = None
        if describer is not None:
            self.view_features = ViewFeatures(describer, self.renderer.semantics)

    def _estimate(
        self, target: Submap, source: Submap, sources: list[SourceView], start: Array
    ) -> tuple[Estimate, list[TargetView]]:
        """Adam, then the residual scales and the information at its solution."""
        cameras = [seen.view.camera for seen in sources]
        T_source_camera = [seen.T_source_camera for seen in sources]
        found = descend(
            (target.gaussians, source.gaussians),
            (cameras, T_source_camera),
            start,
            self.options,
            self.renderer.backend_name,
            self.view_features,
        )
        self.renderer.renders += found.renders
        targets = self._target_views(target, sources, found.T_target_source)
        pairs = self._pairs(sources, targets, far=False)
        estimate = self._evaluate(pairs, found.T_target_source)
        return replace(estimate, iterations=found.iterations, converged=found.converged), targets

    def _evaluate(self, pairs: list[Pair], T_target_source: Array) -> Estimate:
        """Compute the residual scales and the information at a fixed pose."""
        options = replace(DENSE, iterations=1, exposure=False)
        estimate = Estimate(T_target_source)
        for _ in range(_SCALE_ITERATIONS):
            moved = align(pairs, estimate, options, finest_only=True)
            estimate = replace(moved, T_target_source=T_target_source)
        return estimate


@dataclass(frozen=True)
class Descent:
    """Result of gradient descent: the pose with the lowest loss."""

    T_target_source: Array
    loss: float
    iterations: int
    renders: int
    converged: bool


def descend(
    gaussians: tuple[GaussianCloud, GaussianCloud],
    views: tuple[list[Camera], list[Array]],
    start: Array,
    options: RegistrationOptions,
    backend_name: str = "auto",
    view_features: ViewFeatures | None = None,
) -> Descent:
    """Minimise G-6 over T_target_source; both maps are constant.

    Args:
        gaussians: of the target and of the source.
        views: cameras, and their poses T_source_camera [4, 4].
        start: initial T_target_source [4, 4].
        view_features: computes the descriptors of the feature term; None disables the term.
    """
    target, source = gaussians[0].detached(), gaussians[1].detached()
    cameras, T_source_camera = views
    with torch.no_grad():
        source_views = [
            render(
                source, camera, se3.inverse(T), features=source.features, backend_name=backend_name
            )
            for camera, T in zip(cameras, T_source_camera, strict=True)
        ]
    objective = _Objective(
        target, cameras, T_source_camera, source_views, options, backend_name, view_features
    )
    best, best_T, steps, evaluations = float("inf"), start.copy(), 0, 0
    for round_ in range(_ROUNDS):
        decay = _RATE_DECAY**round_
        adam = PoseAdam(_TRANSLATION_RATE_M * decay, _ROTATION_RATE_RAD * decay)
        T, without_gain, threshold = best_T, 0, float("inf")
        while without_gain <= _PATIENCE:
            # The loss is evaluated after each step and at the start.
            loss, gradient = objective(T)
            evaluations += 1
            gained = loss < threshold * (1.0 - _MIN_GAIN)
            without_gain = 0 if gained else without_gain + 1
            threshold = loss if gained else threshold
            if loss < best:
                best, best_T = loss, T
            if steps == _ITERATIONS or not np.isfinite(loss):
                break
            T = se3.orthonormalise(T @ se3.exp(adam.step(gradient)))
            steps += 1
    converged = bool(steps < _ITERATIONS and np.isfinite(best))
    return Descent(best_T, best, steps, len(cameras) * (evaluations + 1), converged)


class _Objective:
    """G-6 and its derivative with respect to x in T_target_source exp(x)."""

    def __init__(  # noqa: PLR0913 - called once, with everything that the loss depends on
        self,
        target: GaussianCloud,
        cameras: list[Camera],
        T_source_camera: list[Array],
        source_views: list[RenderOutput],
        options: RegistrationOptions,
        backend_name: str,
        view_features: ViewFeatures | None,
    ) -> None:
        self._target, self._cameras, self._poses = target, cameras, T_source_camera
        self._source_views, self._options = source_views, options
        self._backend_name = backend_name
        self._view_features = view_features if options.feature > 0 else None
        self._images: list[Tensor] = []
        self._descriptors: list[Tensor] = []
        if self._view_features is not None:
            with torch.no_grad():
                self._images = [self._view_features.images(output) for output in source_views]
                self._descriptors = [self._view_features.describe(i) for i in self._images]

    def __call__(self, T_target_source: Array) -> tuple[float, Array]:
        """Mean loss of the overlapping views, infinite if there are none; and derivative [6]."""
        total, gradient, count = 0.0, np.zeros(6), 0
        for number, (camera, T_source_camera) in enumerate(
            zip(self._cameras, self._poses, strict=True)
        ):
            T_camera_target = se3.inverse(T_target_source @ T_source_camera)
            pose = torch.from_numpy(T_camera_target).requires_grad_()
            target_view = render(
                self._target,
                camera,
                pose,
                features=self._target.features,
                backend_name=self._backend_name,
            )
            loss = self._loss(number, target_view)
            if loss is None:
                continue
            (matrix_gradient,) = torch.autograd.grad(loss, pose)
            left = pose_gradient(matrix_gradient[:3].numpy(), T_camera_target)
            # (T exp(x) T_source_camera)^-1 = exp(-Ad(T_source_camera^-1) x) T_camera_target.
            gradient -= se3.adjoint(se3.inverse(T_source_camera)).T @ left
            total += float(loss.detach())
            count += 1
        if count == 0:
            return float("inf"), gradient
        return total / count, gradient / count

    def _loss(self, number: int, target: RenderOutput) -> Tensor | None:
        """Loss of one view over the pixels with a surface in both maps; None if too few."""
        source, options = self._source_views[number], self._options
        mask = (target.silhouette.detach() > _MIN_SILHOUETTE) & (
            source.silhouette > _MIN_SILHOUETTE
        )
        if int(mask.sum()) < _MIN_PIXELS:
            return None
        loss = (target.colour - source.colour)[mask].abs().mean()
        if target.features.shape[-1] > 0:
            # G-IV.A.3: the weight of the semantic term, lambda_sem, is 1.
            loss = loss + (target.features - source.features)[mask].abs().mean()
        if self._view_features is not None:
            # Outside the mask, use the source's image for both, so that they do not differ.
            images = self._view_features.images(target)
            descriptor = self._view_features.describe(
                torch.where(mask, images, self._images[number])
            )
            difference = descriptor - self._descriptors[number]
            loss = loss + options.feature * (difference**2).sum()
        return loss
