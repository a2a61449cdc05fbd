"""Baseline: the papers' tracker, Adam on the camera pose (H-21, H-22, G-2).

The dense tracker replaces it and needs a tenth of its renderings.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from toolkit.base.errors import SettingsError
from toolkit.base.exposure import IDENTITY
from toolkit.base.frame import Frame, NullRecorder, Recorder
from toolkit.base.geometry import se3
from toolkit.base.geometry.camera import Camera
from toolkit.base.native.constants import SILHOUETTE
from toolkit.base.stages import Stage
from toolkit.semantics.codes import SemanticCode
from toolkit.semantics.options import SemanticLossWeights
from toolkit.slam.tracking.moving import MovingTracker
from toolkit.slam.tracking.options import FirstOrderOptions
from toolkit.slam.tracking.proposals import Proposals
from toolkit.slam.tracking.result import Health, TrackingResult
from toolkit.splatting.alignment.backend import linearise
from toolkit.splatting.alignment.data import (
    INITIAL_SCALES,
    FrameLevel,
    LevelProblem,
    Linearisation,
    ResidualScales,
    rescaled,
)
from toolkit.splatting.alignment.health import HealthLimits, failure_reason
from toolkit.splatting.alignment.levels import finest_level, intensity_of, model_level
from toolkit.splatting.alignment.pose_adam import PoseAdam, pose_gradient
from toolkit.splatting.gaussians.cloud import GaussianCloud
from toolkit.splatting.losses.semantic import SemanticLoss
from toolkit.splatting.losses.tracking_loss import PRESETS, TrackingLoss, tracking_loss
from toolkit.splatting.rendering import RenderOutput, backend
from toolkit.splatting.rendering.output import FEATURES

# Adam's learning rates, which the papers do not print.
_TRANSLATION_RATE_M, _ROTATION_RATE_RAD = 0.002, 0.001

# Evaluation of the final pose: fixed-point iterations of the residual scales, maximum depth
# difference (fraction of depth) and minimum silhouette. The silhouette is that of the dense
# tracker. That of the loss (0.99) would leave only 12 to 16 % of a default map's pixels, in regions
# too small for a plane, and every frame would be lost.
_SCALE_ITERATIONS = 8
_MAX_DISTANCE = 0.05
_MIN_SILHOUETTE = 0.9


@dataclass(frozen=True)
class _Candidate:
    """A pose, the map rendered from it, and its loss."""

    T_camera_map: NDArray[np.float64]
    images: Tensor
    loss: float
    step: int


class FirstOrderTracker(MovingTracker):
    """Tracks frames against a map of Gaussians by gradient descent.

    Args:
        code: semantic code of the map's features, for the semantic term.

    Raises:
        SettingsError: the preset is unknown.
    """

    def __init__(
        self,
        options: FirstOrderOptions | None = None,
        limits: HealthLimits | None = None,
        backend_name: str = "auto",
        recorder: Recorder | None = None,
        code: SemanticCode | None = None,
    ) -> None:
        super().__init__(limits)
        self.options = options or FirstOrderOptions()
        if self.options.preset not in PRESETS:
            raise SettingsError(
                f"unknown tracking preset '{self.options.preset}'; choose one of "
                f"{', '.join(PRESETS)}"
            )
        self._backend = backend(backend_name)
        self._recorder = recorder or NullRecorder()
        self._semantic = None
        preset = PRESETS[self.options.preset]
        weight = preset.semantic if self.options.semantic is None else self.options.semantic
        if code is not None and weight > 0:
            # |S_pix - S| is the sum over the three colours, of which the code's loss is the mean.
            weights = SemanticLossWeights(
                weight=weight * (code.channels if code.is_colour else 1),
                min_silhouette=preset.min_silhouette,
                moves_geometry=True,
            )
            self._semantic = SemanticLoss(code, weights)
            self.wants_labels = True

    def track(
        self,
        frame: Frame,
        gaussians: GaussianCloud,
        proposals: Proposals | None = None,
    ) -> TrackingResult:
        """Track a frame and update the motion model, unless the frame is lost."""
        result = self.locate(frame, gaussians, self.motion.predict(frame.timestamp_s))
        if result.lost:
            self.motion.forget_velocity()
        else:
            self.motion.update(frame.timestamp_s, result.T_map_camera)
        return result

    def locate(
        self,
        frame: Frame,
        gaussians: GaussianCloud,
        T_map_camera: NDArray[np.float64],
        *,
        search: bool = True,
    ) -> TrackingResult:
        """Locate a frame near an initial pose; the tracker's state does not change."""
        device = gaussians.means.device
        rgb = torch.from_numpy(np.ascontiguousarray(frame.rgb.transpose(2, 0, 1))).to(device)
        depth_m = torch.from_numpy(frame.depth_m).to(device)
        weights = PRESETS[self.options.preset]
        features = labels = None
        if self._semantic is not None and frame.labels is not None:
            features = gaussians.features
            labels = torch.from_numpy(np.where(frame.depth_m > 0, frame.labels, 0)).to(device)
        T_camera_map = se3.inverse(T_map_camera)
        adam = PoseAdam(_TRANSLATION_RATE_M, _ROTATION_RATE_RAD)
        best: _Candidate | None = None
        renders = 0
        # The loss of a pose is computed from the rendering at that pose (SplaTAM assigns it to the
        # following step), so there is one more rendering than steps.
        for step in range(self.options.iterations + 1):
            with self._recorder.timed(Stage.TRACKING_RENDER):
                view = self._backend.forward(gaussians, frame.camera, T_camera_map, features, None)
            renders += 1
            loss = tracking_loss(view.images, rgb, depth_m, weights)
            if labels is not None:
                loss = self._with_semantics(loss, view.images, labels)
            if best is None or loss.per_pixel < best.loss:
                best = _Candidate(T_camera_map, view.images, loss.per_pixel, step)
            if step == self.options.iterations or loss.pixels == 0:
                break
            with self._recorder.timed(Stage.TRACKING_BACKWARD):
                gradients = view.backward(loss.gradient, colours=False)
            gradient = pose_gradient(gradients.T_camera_map.cpu().numpy(), T_camera_map)
            T_camera_map = se3.orthonormalise(se3.exp(adam.step(gradient)) @ T_camera_map)
        assert best is not None
        return self._result(frame, best, renders)

    def _with_semantics(self, loss: TrackingLoss, images: Tensor, labels: Tensor) -> TrackingLoss:
        """Add the semantic term (G-2)."""
        assert self._semantic is not None
        if loss.pixels == 0:
            return loss
        term = self._semantic(images[FEATURES].contiguous(), images[SILHOUETTE], labels, (0, 1))
        assert term.silhouette is not None
        loss.gradient[FEATURES] = term.features
        loss.gradient[SILHOUETTE] += term.silhouette
        value = loss.value + term.value * labels.numel()
        return TrackingLoss(value, value / loss.pixels, loss.gradient, loss.pixels)

    def _result(self, frame: Frame, best: _Candidate, renders: int) -> TrackingResult:
        linear, scales = _evaluate(frame, _view_level(best.images, frame.camera))
        measured = float((frame.depth_m > 0).sum())
        visible = linear.depth_pixels / max(measured, 1.0)
        information = linear.H[:6, :6]
        reason = failure_reason(self.limits, scales, visible, information, measured)
        return TrackingResult(
            T_map_camera=se3.inverse(best.T_camera_map),
            # A later pose had a higher loss: the loss no longer decreased.
            converged=best.step < renders - 1,
            iterations=renders - 1,
            renders=renders,
            intensity_residual=scales.intensity,
            depth_residual_m=scales.depth_m,
            visible_fraction=visible,
            information=information,
            health=Health.LOST if reason else Health.GOOD,
            reason=reason,
        )


def _evaluate(frame: Frame, view: FrameLevel) -> tuple[Linearisation, ResidualScales]:
    """Normal equations at the pose of a rendered view, and the residual scales."""
    model = model_level(view)
    level = finest_level(frame, view.depth_m.device)
    scales = INITIAL_SCALES
    for _ in range(_SCALE_ITERATIONS):
        problem = LevelProblem(model, level, np.eye(4), scales, IDENTITY, _MAX_DISTANCE)
        linear = linearise(problem)
        scales = rescaled(scales, linear)
    return linear, scales


def _view_level(images: Tensor, camera: Camera) -> FrameLevel:
    """Composited intensity, as used by the loss, and depth; 0 where the silhouette is small."""
    output = RenderOutput(images)
    solid = output.silhouette >= _MIN_SILHOUETTE
    zeros = torch.zeros_like(output.silhouette)
    return FrameLevel(
        camera,
        torch.where(solid, intensity_of(output.colour.cpu().numpy()).to(zeros), zeros),
        torch.where(solid, output.depth_m, zeros),
    )
