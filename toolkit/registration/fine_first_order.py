"""The papers' fine registration: Adam on the motion, under colour, semantics and features (G-6)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from toolkit.gaussians.cloud import GaussianCloud
from toolkit.geometry import se3
from toolkit.geometry.camera import Camera
from toolkit.registration.view_features import ViewFeatures
from toolkit.rendering import RenderOutput, render
from toolkit.tracking.pose_adam import PoseAdam, pose_gradient

Array = NDArray[np.float64]

# A view with fewer common pixels does not count.
_FEWEST_PIXELS = 50


@dataclass(frozen=True)
class FirstOrderFineOptions:
    """Values of the papers' optimiser.

    Attributes:
        semantic, feature: weights of the two terms beside colour (G: 1.0 and 0.5).
        iterations: most Adam steps.
        translation_rate, rotation_rate: step sizes in metres and radians.
        patience: a round ends when so many steps brought nothing.
        least_gain: what counts as something, a share of the loss.
        rounds: each begins at the best motion so far, with rates shorter by `rate_decay`.
        least_silhouette: pixels count where both maps are more opaque.
    """

    semantic: float = 1.0
    feature: float = 0.5
    iterations: int = 150
    translation_rate: float = 0.005
    rotation_rate: float = 0.003
    patience: int = 8
    least_gain: float = 0.001
    rounds: int = 3
    rate_decay: float = 0.2
    least_silhouette: float = 0.9


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
            since = 0 if loss < threshold * (1.0 - options.least_gain) else since + 1
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
        mask = (drawn.silhouette.detach() > options.least_silhouette) & (
            shown.silhouette > options.least_silhouette
        )
        if int(mask.sum()) < _FEWEST_PIXELS:
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
