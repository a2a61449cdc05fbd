"""Baseline: the paper's fine registration, Adam on the motion of the source submap (G-6).

Its loss compares colour, semantic features and image descriptors of rendered views.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from toolkit.alignment.joint import Estimate, Pair, align
from toolkit.alignment.pose_adam import PoseAdam, pose_gradient
from toolkit.baselines.view_features import ViewFeatures
from toolkit.features.sources import ViewDescriber
from toolkit.gaussians.cloud import GaussianCloud
from toolkit.geometry import se3
from toolkit.geometry.camera import Camera
from toolkit.registration.fine import FineRegistration, SourceView, TargetView
from toolkit.registration.options import FineOptions, FirstOrderFineOptions
from toolkit.registration.views import ViewRenderer
from toolkit.rendering import RenderOutput, render
from toolkit.submaps.submap import Submap

Array = NDArray[np.float64]

# Views with fewer common pixels are ignored.
_MIN_PIXELS = 50
# Fixed-point iterations of the residual scales.
_SCALE_ITERATIONS = 8


class FirstOrderFineRegistration(FineRegistration):
    """Registers two submaps by the paper's loss and optimiser; see Registrar.

    Args:
        describer: describes views for the feature term; None leaves the term out.
    """

    method = "fine (first-order)"

    def __init__(
        self,
        options: FineOptions | None = None,
        renderer: ViewRenderer | None = None,
        describer: ViewDescriber | None = None,
    ) -> None:
        super().__init__(options, renderer)
        self.view_features = None
        if describer is not None:
            self.view_features = ViewFeatures(describer, self.renderer.semantics)

    def _estimated(
        self, target: Submap, source: Submap, sources: list[SourceView], start: Array
    ) -> tuple[Estimate, list[TargetView]]:
        """Adam, then the residual scales and the information at its solution."""
        cameras = [seen.view.camera for seen in sources]
        T_source_camera = [seen.T_source_camera for seen in sources]
        found = descend(
            (target.gaussians, source.gaussians),
            (cameras, T_source_camera),
            start,
            self.options.first_order,
            self.renderer.backend_name,
            self.view_features,
        )
        self.renderer.renders += found.renders
        targets = self._drawn(target, sources, found.T_target_source)
        judged = self._judged(self._pairs(sources, targets, far=False), found.T_target_source)
        return replace(judged, iterations=found.iterations, converged=found.converged), targets

    def _judged(self, pairs: list[Pair], T_target_source: Array) -> Estimate:
        """Residual scales and information at a fixed motion."""
        still = replace(self.options.dense, iterations=1, exposure=False)
        estimate = Estimate(T_target_source)
        for _ in range(_SCALE_ITERATIONS):
            moved = align(pairs, estimate, still, finest_only=True)
            estimate = replace(moved, T_target_source=T_target_source)
        return estimate


@dataclass(frozen=True)
class Descent:
    """Where the descent ended: the motion of least loss, judged after its step."""

    T_target_source: Array
    loss: float
    iterations: int
    renders: int
    converged: bool


def descend(
    gaussians: tuple[GaussianCloud, GaussianCloud],
    views: tuple[list[Camera], list[Array]],
    start: Array,
    options: FirstOrderFineOptions,
    backend_name: str = "auto",
    view_features: ViewFeatures | None = None,
) -> Descent:
    """Minimise G-6 over one motion, both maps frozen.

    Args:
        gaussians: of the target and of the source.
        views: cameras, and their poses T_source_camera [4, 4].
        start: T_target_source [4, 4].
        view_features: describes the views for the feature term; None leaves the term out.
    """
    target, source = gaussians[0].detached(), gaussians[1].detached()
    cameras, T_source_camera = views
    with torch.no_grad():
        shown = [
            render(
                source, camera, se3.inverse(T), features=source.features, backend_name=backend_name
            )
            for camera, T in zip(cameras, T_source_camera, strict=True)
        ]
    objective = _Objective(
        target, cameras, T_source_camera, shown, options, backend_name, view_features
    )
    best, best_T, steps, judged = float("inf"), start.copy(), 0, 0
    for round_ in range(options.rounds):
        share = options.rate_decay**round_
        adam = PoseAdam(options.translation_rate * share, options.rotation_rate * share)
        T, since, threshold = best_T, 0, float("inf")
        while since <= options.patience:
            # A motion is judged after its step, so there is one drawing more than steps.
            loss, gradient = objective(T)
            judged += 1
            since = 0 if loss < threshold * (1.0 - options.min_gain) else since + 1
            threshold = loss if since == 0 else threshold
            if loss < best:
                best, best_T = loss, T
            if steps == options.iterations or not np.isfinite(loss):
                break
            T = se3.orthonormalise(T @ se3.exp(adam.step(gradient)))
            steps += 1
    at_rest = bool(steps < options.iterations and np.isfinite(best))
    return Descent(best_T, best, steps, len(cameras) * (judged + 1), at_rest)


class _Objective:
    """G-6 and its derivative by x in T_target_source exp(x)."""

    def __init__(  # noqa: PLR0913 - one call, and all of it is the objective
        self,
        target: GaussianCloud,
        cameras: list[Camera],
        T_source_camera: list[Array],
        shown: list[RenderOutput],
        options: FirstOrderFineOptions,
        backend_name: str,
        view_features: ViewFeatures | None,
    ) -> None:
        self._target, self._cameras, self._poses = target, cameras, T_source_camera
        self._shown, self._options = shown, options
        self._backend_name = backend_name
        self._view_features = view_features if options.feature > 0 else None
        self._pictures: list[Tensor] = []
        self._descriptors: list[Tensor] = []
        if self._view_features is not None:
            with torch.no_grad():
                self._pictures = [self._view_features.pictures(output) for output in shown]
                self._descriptors = [self._view_features.describe(p) for p in self._pictures]

    def __call__(self, T_target_source: Array) -> tuple[float, Array]:
        """Mean loss of the views that overlap, infinite where none does; derivative [6]."""
        total, gradient, counted = 0.0, np.zeros(6), 0
        for number, (camera, T_source_camera) in enumerate(
            zip(self._cameras, self._poses, strict=True)
        ):
            T_camera_target = se3.inverse(T_target_source @ T_source_camera)
            pose = torch.from_numpy(T_camera_target).requires_grad_()
            drawn = render(
                self._target,
                camera,
                pose,
                features=self._target.features,
                backend_name=self._backend_name,
            )
            loss = self._loss(number, drawn)
            if loss is None:
                continue
            (by_matrix,) = torch.autograd.grad(loss, pose)
            left = pose_gradient(by_matrix[:3].numpy(), T_camera_target)
            # (T exp(x) T_source_camera)^-1 = exp(-Ad(T_source_camera^-1) x) T_camera_target.
            gradient -= se3.adjoint(se3.inverse(T_source_camera)).T @ left
            total += float(loss.detach())
            counted += 1
        if counted == 0:
            return float("inf"), gradient
        return total / counted, gradient / counted

    def _loss(self, number: int, drawn: RenderOutput) -> Tensor | None:
        """Of one view, a mean over the pixels where both maps are solid."""
        shown, options = self._shown[number], self._options
        mask = (drawn.silhouette.detach() > options.min_silhouette) & (
            shown.silhouette > options.min_silhouette
        )
        if int(mask.sum()) < _MIN_PIXELS:
            return None
        loss = (drawn.colour - shown.colour)[mask].abs().mean()
        if options.semantic > 0 and drawn.features.shape[-1] > 0:
            loss = loss + options.semantic * (drawn.features - shown.features)[mask].abs().mean()
        if self._view_features is not None:
            # Where either map is missing, the pictures are equal: the encoder sees no difference.
            pictures = self._view_features.pictures(drawn)
            described = self._view_features.describe(
                torch.where(mask, pictures, self._pictures[number])
            )
            error = described - self._descriptors[number]
            loss = loss + options.feature * (error**2).sum()
        return loss
