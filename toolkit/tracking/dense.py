"""The default tracker: dense Gauss-Newton against the rendered map (mission section 7).

Render once where the camera is expected, align the frame to that view coarse to fine, and
render again only where the result lies far from the view that it was measured against.
Where the frame then fits badly, Open3D's odometry proposes another start.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from toolkit.alignment.backend import align, linearise
from toolkit.alignment.data import (
    INITIAL_SCALES,
    Alignment,
    FrameLevel,
    GaussNewtonOptions,
    ModelLevel,
    ResidualScales,
)
from toolkit.alignment.exposure import estimate_exposure
from toolkit.alignment.health import failure_reason
from toolkit.alignment.levels import model_level, pyramid, view_level
from toolkit.alignment.options import HealthLimits
from toolkit.errors import DependencyError
from toolkit.exposure import IDENTITY, Exposure
from toolkit.frame import Frame, NullRecorder, Recorder
from toolkit.gaussians.cloud import GaussianCloud
from toolkit.geometry import se3
from toolkit.rendering import RenderOptions, backend, render_surface
from toolkit.tracking.health import (
    has_depth,
    misfit_reason,
    reference_scales,
    relaxed_scales,
)
from toolkit.tracking.moving import MovingTracker
from toolkit.tracking.odometry import frame_to_model
from toolkit.tracking.options import DenseOptions
from toolkit.tracking.prepared import FramesAhead, PreparedFrame
from toolkit.tracking.result import Health, TrackingResult

_log = logging.getLogger(__name__)


# Minimum number of residuals.
_MIN_PIXELS = 50

# A frame fits badly when its residual scales, multiplied, exceed so many times those of the
# last frame. Ordinary frames of the real sequences stay below 1.8; of the wrong poses that
# jumps led to, nearly all lie above, up to 3000.
_BAD_FIT = 2.0

# Odometry works on this pyramid level: a start need not be precise.
_ODOMETRY_LEVEL = 1

# Steps below these end a level: a thousandth of a pixel at usual focal lengths.
_SMALL_TRANSLATION_M = 2e-5
_SMALL_ROTATION_RAD = 1e-5


@dataclass(frozen=True)
class _View:
    """The map as drawn at a pose, fine to coarse."""

    T_map_view: NDArray[np.float64]
    levels: list[ModelLevel]


@dataclass(frozen=True)
class _Task:
    """One frame to be placed in a map."""

    ready: PreparedFrame
    gaussians: GaussianCloud

    @property
    def frame(self) -> Frame:
        """As it came."""
        return self.ready.frame

    @property
    def levels(self) -> list[FrameLevel]:
        """The frame's own, from fine to coarse."""
        return self.ready.levels


class DenseTracker(MovingTracker):
    """Tracks frames against a map of Gaussians by second-order optimisation."""

    def __init__(
        self,
        options: DenseOptions | None = None,
        limits: HealthLimits | None = None,
        backend_name: str = "auto",
        recorder: Recorder | None = None,
    ) -> None:
        super().__init__(limits)
        self.options = options or DenseOptions()
        self._ahead = FramesAhead(self.options.levels)
        self._backend = backend(backend_name)
        self._recorder = recorder or NullRecorder()
        self._scales = INITIAL_SCALES
        self._fit = INITIAL_SCALES
        self._exposure = IDENTITY

    def prepare(self, frame: Frame, device: torch.device) -> None:
        """Bring a frame's pyramid to a GPU while earlier frames are tracked there.

        On a CPU tracking wants all cores for itself: a whole run took 3 % longer.
        """
        if device.type != "cpu":
            self._ahead.prepare(frame, device)

    def state(self) -> dict[str, NDArray]:
        """Arrays from which `restore` continues identically."""
        scales, fit = ([s.intensity, s.depth_m] for s in (self._scales, self._fit))
        exposure = [self._exposure.gain, self._exposure.bias]
        own = {"scales": scales, "fit": fit, "exposure": exposure}
        return super().state() | {name: np.array(values) for name, values in own.items()}

    def restore(self, state: dict[str, NDArray]) -> None:
        """Take over an earlier `state`."""
        super().restore(state)
        self._scales = ResidualScales(*(float(s) for s in state["scales"]))
        # Earlier checkpoints have no "fit".
        self._fit = ResidualScales(*(float(s) for s in state.get("fit", state["scales"])))
        self._exposure = Exposure(*(float(value) for value in state["exposure"]))

    def track(self, frame: Frame, gaussians: GaussianCloud) -> TrackingResult:
        """Pose of a frame against the map; the motion model follows unless it is lost."""
        starts = [self.motion.predict(frame.timestamp_s)]
        last = self.motion.last()
        if last is not None:
            starts.append(last)
        result = self.locate(frame, gaussians, *starts)
        found = ResidualScales(result.intensity_residual, result.depth_residual_m)
        reference = reference_scales(self._scales, self._fit)
        misfit = "" if result.lost else misfit_reason(self.limits, found, reference)
        if misfit:
            result = replace(result, health=Health.LOST, reason=misfit)
        if result.lost:
            self.motion.forget_velocity()
            if has_depth(frame):
                self._scales = relaxed_scales(self._scales)
        else:
            self.motion.update(frame.timestamp_s, result.T_map_camera)
            self._scales = self._fit = found
            self._exposure = result.exposure
        return result

    def locate(
        self, frame: Frame, gaussians: GaussianCloud, *starts: NDArray[np.float64]
    ) -> TrackingResult:
        """Pose of a frame near one of the starts; the tracker's own state stays as it is.

        Args:
            starts: T_map_camera [4, 4] each; the map is drawn at the first, and the one that
                fits best on the coarsest level is where alignment begins.

        Raises:
            DependencyError: `start` is "both" and Open3D cannot be loaded.
        """
        task = _Task(self._ahead.of(frame, gaussians.means.device), gaussians)
        view = self._draw(task, starts[0])
        start = self._best_start(task, view, starts)
        result = self._aligned(task, view, start)
        if self.options.start == "both" or (
            self.options.start == "auto" and (result.lost or self._misfit(result) > _BAD_FIT)
        ):
            return self._better_by_odometry(task, view, start, result)
        return result

    def _draw(self, task: _Task, T_map_view: NDArray[np.float64]) -> _View:
        camera, thin = task.frame.camera, self.options.min_silhouette
        T_view_map = se3.inverse(T_map_view)
        with self._recorder.timed("tracking render"):
            options = RenderOptions(thin)
            surface = render_surface(self._backend, task.gaussians, camera, T_view_map, options)
            levels = pyramid(view_level(surface, thin), self.options.levels)
            return _View(T_map_view.copy(), [model_level(level) for level in levels])

    def _best_start(
        self, task: _Task, view: _View, starts: tuple[NDArray[np.float64], ...]
    ) -> NDArray[np.float64]:
        """The start with the least cost against a view."""
        if len(starts) == 1:
            return starts[0]
        T_view_map = se3.inverse(view.T_map_view)
        model, frame = view.levels[-1], task.levels[-1]
        gate = self.options.max_distance * 2 ** (self.options.levels - 1)
        costs = [
            linearise(model, frame, T_view_map @ T, self._scales, self._exposure, gate).cost
            for T in starts
        ]
        return starts[int(np.argmin(costs))]

    def _misfit(self, result: TrackingResult) -> float:
        """Residual scales of both kinds, multiplied, in units of the last frame's."""
        scales = self._scales.intensity * self._scales.depth_m
        return result.intensity_residual * result.depth_residual_m / scales

    def _better_by_odometry(
        self, task: _Task, view: _View, start: NDArray[np.float64], first: TrackingResult
    ) -> TrackingResult:
        """The better of a result and of what alignment makes of odometry's answer."""
        level = min(_ODOMETRY_LEVEL, self.options.levels - 1)
        T_view_start = se3.inverse(view.T_map_view) @ start
        try:
            with self._recorder.timed("tracking odometry"):
                T_view_camera = frame_to_model(view.levels[level], task.levels[level], T_view_start)
        except DependencyError as error:
            if self.options.start == "both":
                raise
            _log.info("frame %d fits badly, and odometry cannot help: %s", task.frame.index, error)
            return first
        if T_view_camera is None:
            return first
        found = view.T_map_view @ T_view_camera
        second = self._aligned(task, self._draw(task, found), found)
        fits_better = (second.lost, self._misfit(second)) < (first.lost, self._misfit(first))
        return replace(
            second if fits_better else first,
            renders=first.renders + second.renders,
            iterations=first.iterations + second.iterations,
        )

    def _aligned(self, task: _Task, view: _View, start: NDArray[np.float64]) -> TrackingResult:
        """Alignment from a start, first against a view of the map near it."""
        T_view_camera = se3.inverse(view.T_map_view) @ start
        found = Alignment(T_view_camera, self._scales, self._exposure)
        renders, levels, rules = 1, len(view.levels), self._rules
        while True:
            with self._recorder.timed("tracking align"):
                found = align(view.levels[:levels], task.levels[:levels], found, rules)
            near = not self._far(found.T_view_camera, task.ready.reach_m)
            if (near and found.converged) or renders == self.options.renders:
                return self._result(task, view, found, renders)
            view = self._draw(task, view.T_map_view @ found.T_view_camera)
            found = replace(found, T_view_camera=np.eye(4))
            # A second view of the same frame needs the finest level only.
            renders, levels = renders + 1, 1

    @property
    def _rules(self) -> GaussNewtonOptions:
        options = self.options
        return GaussNewtonOptions(
            iterations=options.iterations,
            max_distance=options.max_distance,
            photometric_weight=options.photometric_weight,
            exposure=self._exposure if options.exposure else None,
            min_pixels=_MIN_PIXELS,
            min_translation_m=_SMALL_TRANSLATION_M,
            min_rotation_rad=_SMALL_ROTATION_RAD,
        )

    def _far(self, T_view_camera: NDArray[np.float64], reach_m: float) -> bool:
        """Whether a camera lies too far from where the map was drawn."""
        moved = np.linalg.norm(T_view_camera[:3, 3]) / reach_m
        turned = se3.rotation_angle_rad(T_view_camera[:3, :3])
        return bool(moved + turned > self.options.rerender_distance)

    def _estimated_exposure(self, task: _Task, view: _View, found: Alignment) -> Exposure:
        """Exposure of the frame that is stored with a keyframe."""
        if not self.options.exposure or found.last is None:
            return found.exposure
        levels = list(zip(view.levels, task.levels, strict=True))
        gate = self.options.max_distance
        return estimate_exposure(levels, found.T_view_camera, found.scales, found.exposure, gate)

    def _result(self, task: _Task, view: _View, found: Alignment, renders: int) -> TrackingResult:
        measured, linear = float(task.ready.measured), found.last
        visible = linear.depth_pixels / max(measured, 1.0) if linear else 0.0
        # Perturbations were on the view's side; the view stands at the pose itself now.
        information = linear.H[:6, :6] if linear else np.zeros((6, 6))
        reason = failure_reason(self.limits, found.scales, visible, information, measured)
        # Alignment that gives up at once hands back a product of this tracker's own poses, and
        # their rounding errors threefold: a few hundred such frames and no pose is rigid.
        return TrackingResult(
            T_map_camera=se3.orthonormalise(view.T_map_view @ found.T_view_camera),
            converged=found.converged,
            iterations=found.iterations,
            renders=renders,
            intensity_residual=found.scales.intensity,
            depth_residual_m=found.scales.depth_m,
            visible_fraction=visible,
            information=information,
            health=Health.LOST if reason else Health.GOOD,
            reason=reason,
            exposure=self._estimated_exposure(task, view, found),
        )
