"""One optimisation step of a map on one keyframe (H-24)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from toolkit.base.caching import LruCache
from toolkit.base.frame import Recorder
from toolkit.base.geometry import se3
from toolkit.base.keyframe import Keyframe, Observed
from toolkit.base.native.constants import BASE_CHANNELS
from toolkit.base.stages import Stage
from toolkit.slam.mapping.options import MapperOptions
from toolkit.slam.mapping.semantic_mapping import SemanticMapping
from toolkit.slam.mapping.sparse_adam import SparseAdam
from toolkit.slam.mapping.view_features import FeatureLoss
from toolkit.slam.submaps.submap import Submap
from toolkit.splatting.alignment.pose_adam import PoseAdam, pose_gradient
from toolkit.splatting.gaussians.cloud import GaussianCloud
from toolkit.splatting.losses.photometric import by_observed_depth, rgbd_loss, weigh_depth
from toolkit.splatting.rendering import RenderOptions, render_surface
from toolkit.splatting.rendering.backend import Backend, GaussianGradients
from toolkit.splatting.rendering.output import COLOUR
from toolkit.splatting.rendering.texture import resample_at_centres

# Maximum number of keyframes in the cache: more than a mapping window, a few megabytes each.
_MAX_KEYFRAMES = 32
# Learning rate of the scale, and of the shift relative to the median depth.
_RATE = 1e-3
# Weight of the absolute deviation of scale and shift (in units of the depth) from their initial
# values, relative to the depth loss (H-17: L_reg).
_REGULARISATION = 0.1
# Decay of Adam's moments, and its epsilon for gradients relative to the depth loss.
_DECAY, _DECAY_SQUARED, _EPSILON = 0.9, 0.99, 1e-8
# Learning rates of keyframe poses in bundle adjustment.
_POSE_RATE_M, _POSE_RATE_RAD = 1e-4, 5e-5


class KeyframeImages:
    """LRU cache of keyframe images; on a CPU it returns the keyframes' own images."""

    def __init__(self, device: torch.device) -> None:
        self._device = device
        self._cache: LruCache[Observed] = LruCache(_MAX_KEYFRAMES)

    def of(self, keyframe: Keyframe) -> Observed:
        """The images of a keyframe on the map's device."""
        if self._device.type == "cpu":
            return keyframe.images
        # Labels may have been corrected, and keyframes of other submaps may have the same index.
        sources = (keyframe.rgb, keyframe.depth_m, keyframe.class_ids)
        return self._cache.get(keyframe.index, lambda: keyframe.images.to(self._device), sources)


def adjust_depth(keyframe: Keyframe, gradient: Tensor, images: Tensor) -> None:
    """Take one step on the scale and the shift of a corrected depth prior (H-17).

    The state of a keyframe is log scale, shift relative to the median depth, two first and two
    second moments of their gradients, and the number of steps. The logarithm keeps the scale
    positive.

    Args:
        keyframe: its `prior_m` is the depth after the initial correction.
        gradient: [C, H, W] of the mapping loss by the rendered images, as a sum over pixels.
        images: [C, H, W] the rendered images.
    """
    prior_m = keyframe.prior_m
    assert prior_m is not None
    known = prior_m > 0
    if not bool(known.any()):
        return
    state = np.zeros(7) if keyframe.depth_moments is None else keyframe.depth_moments
    median_m = float(prior_m[known].median())
    by_depth = by_observed_depth(gradient, images).to(prior_m)
    log_scale, shift = state[0], state[1]
    scale = math.exp(log_scale)
    # Pixels without a compared depth have no gradient.
    count = max(int((by_depth != 0).sum()), 1)
    descent = np.array(
        [float((by_depth * prior_m).sum()) * scale, float(by_depth.sum()) * median_m]
    )
    deviation = np.array([np.sign(scale - 1.0) * scale, np.sign(shift) * median_m])
    descent = descent / count + _REGULARISATION * deviation
    steps = state[6] + 1
    first = _DECAY * state[2:4] + (1.0 - _DECAY) * descent
    second = _DECAY_SQUARED * state[4:6] + (1.0 - _DECAY_SQUARED) * descent**2
    unbiased = first / (1.0 - _DECAY**steps)
    change = unbiased / (np.sqrt(second / (1.0 - _DECAY_SQUARED**steps)) + _EPSILON)
    log_scale, shift = state[:2] - _RATE * change
    keyframe.depth_moments = np.array([log_scale, shift, *first, *second, steps])
    adjusted = math.exp(log_scale) * prior_m + shift * median_m
    keyframe.depth_m = adjusted.clamp(min=0.0) * known


@dataclass(frozen=True)
class Objective:
    """What a step optimises, and how fast.

    Attributes:
        adjust_poses: optimise the poses of keyframes too, except the first keyframe's.
        complete: add the loss of image features, and that of labels in every step, not only in
            those that are due.
        rate_factor: factor of the learning rates of the Gaussians.
    """

    adjust_poses: bool = False
    complete: bool = False
    rate_factor: float = 1.0


class MapOptimisation:
    """Optimises submaps, one keyframe at a time.

    Args:
        observations: cache of keyframe images on the map's device.
        feature_loss: of image features, which some objectives add.
    """

    def __init__(
        self,
        options: MapperOptions,
        semantics: SemanticMapping,
        backend: Backend,
        observations: KeyframeImages,
        recorder: Recorder,
        feature_loss: FeatureLoss | None = None,
    ) -> None:
        self._options, self._semantics = options, semantics
        self._feature_loss = feature_loss
        self._backend, self._observations, self._recorder = backend, observations, recorder
        self._adam = SparseAdam(feature_unit=semantics.unit)

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
        loss, gradients, with_features = self.gradients(
            submap.gaussians, keyframe, progress, objective.complete
        )
        with self._recorder.timed(Stage.MAP_UPDATE):
            named = gradients.by_name()
            if not with_features:
                del named["features"]
            self._adam.step(
                submap.optimiser, submap.gaussians, named, gradients.ids, objective.rate_factor
            )
            if objective.adjust_poses and keyframe is not submap.keyframes[0]:
                self._adjust_pose(keyframe, gradients.T_camera_map.cpu().numpy())
        return loss

    def gradients(
        self,
        gaussians: GaussianCloud,
        keyframe: Keyframe,
        progress: tuple[int, int],
        complete: bool = False,
    ) -> tuple[float, GaussianGradients, bool]:
        """Compute the mapping loss of a keyframe at its pose, and its derivatives.

        Args:
            gaussians: in the frame of the keyframe's pose.
            progress: see `step`.
            complete: see `Objective`.

        Returns:
            The loss of the images, without that of labels; the derivatives; and whether the
            feature channels have one.
        """
        feature = self._feature_loss if complete else None
        T_camera_map = se3.inverse(keyframe.T_map_camera)
        observed = self._observations.of(keyframe)
        rgb, depth_m, labels = keyframe.observed(observed)
        due = self._semantics.is_due(progress[0], complete)
        compared = labels if due else None
        by_classes = feature is not None and feature.wants_semantics and labels is not None
        with self._recorder.timed(Stage.MAP_FORWARD):
            options = RenderOptions(features=compared is not None or by_classes)
            view = render_surface(self._backend, gaussians, keyframe.camera, T_camera_map, options)
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
            if keyframe.prior_m is not None:
                adjust_depth(keyframe, gradient, images)
        with self._recorder.timed(Stage.MAP_SEMANTIC_LOSS):
            _, gradient, detached = self._semantics.add_gradient(view, compared, progress, gradient)
        if feature is not None:
            with self._recorder.timed(Stage.MAP_LOSS):
                feature_loss, by_images = feature.gradient(images[:-3], rgb, labels)
                loss += feature_loss
                if by_classes and len(gradient) == BASE_CHANNELS:
                    gradient = torch.cat([gradient, torch.zeros_like(view.features)])
                gradient += by_images[: len(gradient)]
        with self._recorder.timed(Stage.MAP_BACKWARD):
            gradients = view.forward_pass.backward(gradient, detached=detached)
        return loss, gradients, len(gradient) > BASE_CHANNELS

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
