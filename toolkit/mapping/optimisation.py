"""One optimisation step of a map on one keyframe (H-24)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from toolkit.alignment.pose_adam import PoseAdam, pose_gradient
from toolkit.frame import Recorder
from toolkit.geometry import se3
from toolkit.keyframe import Keyframe
from toolkit.losses.depth_gradient import weigh_depth
from toolkit.losses.features import FeatureLoss
from toolkit.losses.photometric import rgbd_loss
from toolkit.mapping.depth_adjustment import adjust_depth
from toolkit.mapping.observations import KeyframeImages
from toolkit.mapping.options import MapperOptions
from toolkit.mapping.semantic_mapping import SemanticMapping
from toolkit.mapping.sparse_adam import LearningRates, SparseAdam
from toolkit.native.constants import BASE_CHANNELS
from toolkit.rendering import RenderOptions, render_surface
from toolkit.rendering.backend import Backend
from toolkit.rendering.output import COLOUR
from toolkit.rendering.texture import resample_at_centres
from toolkit.stages import Stage
from toolkit.submaps.submap import Submap

# Learning rates of keyframe poses in bundle adjustment.
_POSE_RATE_M, _POSE_RATE_RAD = 1e-4, 5e-5
_GEOMETRY_AND_COLOUR = ("means", "log_radii", "opacity_logits", "colours")


@dataclass(frozen=True)
class Objective:
    """What a step optimises, and how fast.

    Attributes:
        adjust_poses: optimise the poses of keyframes too, except the first keyframe's.
        feature: additional loss of image features, or None.
        rate_factor: factor of the learning rates of the Gaussians.
    """

    adjust_poses: bool = False
    feature: FeatureLoss | None = None
    rate_factor: float = 1.0


class MapOptimisation:
    """Optimises submaps, one keyframe at a time.

    Args:
        observations: cache of keyframe images on the map's device.
    """

    def __init__(
        self,
        options: MapperOptions,
        semantics: SemanticMapping,
        backend: Backend,
        observations: KeyframeImages,
        recorder: Recorder,
    ) -> None:
        self._options, self._semantics = options, semantics
        self._backend, self._observations, self._recorder = backend, observations, recorder
        rates = LearningRates()
        self._adam = SparseAdam(replace(rates, features=rates.features * semantics.unit))

    def step(
        self,
        submap: Submap,
        keyframe: Keyframe,
        progress: tuple[int, int],
        objective: Objective,
    ) -> float:
        """Take one step on one keyframe; return the loss of its images, without that of labels.

        Args:
            progress: number of this step and total number of steps of the call.
        """
        T_camera_map = se3.inverse(keyframe.T_map_camera)
        observed = self._observations.of(keyframe)
        rgb, depth_m, labels = keyframe.observed(observed)
        if not self._semantics.is_due(progress[0]):
            labels = None
        with self._recorder.timed(Stage.MAP_FORWARD):
            options = RenderOptions(features=labels is not None)
            view = render_surface(
                self._backend, submap.gaussians, keyframe.camera, T_camera_map, options
            )
        with self._recorder.timed(Stage.MAP_LOSS):
            images, moving = view.forward_pass.images, observed.transient
            # Equal colours: pixels and windows beside a moving object are compared without it.
            rgb = _replaced(rgb, images[COLOUR], moving)
            if view.centred_colours:
                rgb = _replaced(resample_at_centres(rgb, view), images[COLOUR], moving)
            gradient = images.new_empty(len(images) - 3, *images.shape[1:])
            loss, _ = rgbd_loss(view, rgb, depth_m, self._options.loss, gradient[:BASE_CHANNELS])
            if moving is not None:
                gradient[COLOUR].masked_fill_(moving, 0.0)
            if observed.inferred is not None:
                weigh_depth(gradient, images, observed.inferred, self._options.inferred_depth)
            adjustment = self._options.depth_adjustment
            if keyframe.prior_m is not None and adjustment.use:
                adjust_depth(keyframe, gradient, images, adjustment.regularisation)
            if objective.feature is not None:
                feature_loss, colour_gradient = objective.feature.gradient(images[COLOUR], rgb)
                gradient[COLOUR] += colour_gradient
                loss += feature_loss
        with self._recorder.timed(Stage.MAP_SEMANTIC_LOSS):
            _, gradient, detached = self._semantics.add_gradient(view, labels, progress, gradient)
        with self._recorder.timed(Stage.MAP_BACKWARD):
            gradients = view.forward_pass.backward(gradient, detached=detached)
        with self._recorder.timed(Stage.MAP_UPDATE):
            with_features = len(gradient) > BASE_CHANNELS
            names = (*_GEOMETRY_AND_COLOUR, *(("features",) if with_features else ()))
            named = {name: getattr(gradients, name) for name in names}
            self._adam.step(
                submap.optimiser, submap.gaussians, named, gradients.ids, objective.rate_factor
            )
            if objective.adjust_poses and keyframe is not submap.keyframes[0]:
                self._adjust_pose(keyframe, gradients.T_camera_map.cpu().numpy())
        return loss

    def _adjust_pose(self, keyframe: Keyframe, matrix_gradient: NDArray[np.float64]) -> None:
        """Take one step on a keyframe's pose.

        Args:
            matrix_gradient: [3, 4] derivative of the loss with respect to T_camera_map.
        """
        adam = PoseAdam(
            _POSE_RATE_M,
            _POSE_RATE_RAD,
            keyframe.pose_moments,
        )
        keyframe.pose_moments = adam.moments
        T_camera_map = se3.inverse(keyframe.T_map_camera)
        step = adam.step(pose_gradient(matrix_gradient, T_camera_map))
        keyframe.T_map_camera = se3.orthonormalise(se3.inverse(se3.exp(step) @ T_camera_map))


def _replaced(rgb: Tensor, other: Tensor, mask: Tensor | None) -> Tensor:
    """The colours [3, H, W] with those of another image within a mask [H, W]."""
    return rgb if mask is None else torch.where(mask, other, rgb)
