"""The default tracker: dense Gauss-Newton against the rendered map (mission section 7).

Render once where the camera is expected, align the frame to that view coarse to fine, and
render again only where the result lies far from the view that it was measured against.
Where the frame then fits badly, Open3D's odometry proposes another start.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from toolkit.errors import DependencyError
from toolkit.frame import Frame, NullRecorder, Recorder
from toolkit.gaussians.cloud import GaussianCloud
from toolkit.geometry import se3
from toolkit.rendering import DrawOptions, backend, draw_surface
from toolkit.tracking import exposure
from toolkit.tracking.alignment import (
    START_SCALES,
    FrameLevel,
    Linearisation,
    ModelLevel,
    Scales,
    finest_level,
    linearise,
    model_level,
    pyramid,
    rescaled,
    view_of,
)
from toolkit.tracking.health import (
    HealthLimits,
    forgetting,
    gone_astray,
    may_start_map,
    verdict,
)
from toolkit.tracking.motion import ConstantVelocity
from toolkit.tracking.odometry import frame_to_model
from toolkit.tracking.result import Health, TrackingResult
from toolkit.tracking.tones import told_exposure

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class DenseOptions:
    """Values of the dense tracker.

    Attributes:
        levels: pyramid levels; the coarsest image should keep at least 30 pixels a side.
        iterations: most Gauss-Newton steps a level.
        renders: most views drawn a frame.
        rerender_distance: draw again when the pose moved by more than this share of the
            median depth (translation) or this angle in radians.
        least_silhouette: rendered pixels thinner than this are not trusted.
        max_distance: gate on depth differences at the finest level, as a share of depth;
            doubled at every coarser level.
        exposure: estimate gain and bias of every frame.
        photometric_weight: weight of the photometric term against the geometric one.
        start: where alignment begins. "velocity": where constant velocity or standing still
            put the camera. "auto": where a frame then fits badly, once more where Open3D's
            odometry puts it, if Open3D is installed. "both": so for every frame. The better
            fit is kept.
    """

    levels: int = 4
    iterations: int = 12
    renders: int = 3
    rerender_distance: float = 0.02
    least_silhouette: float = 0.9
    max_distance: float = 0.05
    exposure: bool = True
    photometric_weight: float = 1.0
    start: Literal["velocity", "auto", "both"] = "auto"


# Fewer residuals than this fix no pose.
_FEWEST_PIXELS = 50

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
    """One frame to be placed: the map, and the frame's own levels from fine to coarse."""

    frame: Frame
    gaussians: GaussianCloud
    levels: list[FrameLevel]


@dataclass
class _Estimate:
    """The state of one frame's alignment."""

    T_map_camera: NDArray[np.float64]
    scales: Scales
    gain: float = 1.0
    bias: float = 0.0
    iterations: int = 0
    converged: bool = False
    last: Linearisation | None = None


class DenseTracker:
    """Tracks frames against a map of Gaussians by second-order optimisation."""

    def __init__(
        self,
        options: DenseOptions | None = None,
        limits: HealthLimits | None = None,
        backend_name: str = "auto",
        recorder: Recorder | None = None,
    ) -> None:
        self.options = options or DenseOptions()
        self.limits = limits or HealthLimits()
        self.motion = ConstantVelocity()
        self._backend = backend(backend_name)
        self._recorder = recorder or NullRecorder()
        self._scales = START_SCALES
        self._exposure = (1.0, 0.0)

    wants_labels = False

    def first_pose(self, frame: Frame) -> NDArray[np.float64] | None:
        """The map's frame is the first camera's; None where there is nothing to map."""
        if not may_start_map(self.limits, frame):
            return None
        self.motion.update(frame.timestamp_s, np.eye(4))
        return np.eye(4)

    def go_on_from(self, timestamp_s: float, T_map_camera: NDArray[np.float64]) -> None:
        """Take a place as the newest one, without a motion."""
        self.motion = ConstantVelocity()
        self.motion.update(timestamp_s, T_map_camera)

    def change_frame(self, T_new_old: NDArray[np.float64]) -> None:
        """Go on in another frame of the map."""
        self.motion.change_frame(T_new_old)

    def state(self) -> dict[str, NDArray]:
        """Arrays from which `restore` continues identically."""
        scales = np.array([self._scales.intensity, self._scales.depth_m])
        return {**self.motion.state(), "scales": scales, "exposure": np.array(self._exposure)}

    def restore(self, state: dict[str, NDArray]) -> None:
        """Take over an earlier `state`."""
        self.motion = ConstantVelocity.from_state(state)
        self._scales = Scales(*(float(s) for s in state["scales"]))
        gain, bias = state["exposure"]
        self._exposure = (float(gain), float(bias))

    def track(self, frame: Frame, gaussians: GaussianCloud) -> TrackingResult:
        """Pose of a frame against the map; the motion model follows unless it is lost."""
        starts = [self.motion.predict(frame.timestamp_s)]
        last = self.motion.last()
        if last is not None:
            starts.append(last)
        result = self.locate(frame, gaussians, *starts)
        found = Scales(result.intensity_residual, result.depth_residual_m)
        astray = "" if result.lost else gone_astray(self.limits, found, self._scales)
        if astray:
            result = replace(result, health=Health.LOST, reason=astray)
        if result.lost:
            self.motion.forget_velocity()
            self._scales = forgetting(self._scales)
        else:
            self.motion.update(frame.timestamp_s, result.T_map_camera)
            self._scales = found
            self._exposure = (result.gain, result.bias)
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
        finest = finest_level(frame, gaussians.means.device)
        task = _Task(frame, gaussians, pyramid(finest, self.options.levels))
        view = self._draw(task, starts[0])
        start = self._best_start(task, view, starts)
        result = self._aligned(task, view, start)
        if self.options.start == "both" or (
            self.options.start == "auto" and (result.lost or self._misfit(result) > _BAD_FIT)
        ):
            return self._better_by_odometry(task, view, start, result)
        return result

    def _draw(self, task: _Task, T_map_view: NDArray[np.float64]) -> _View:
        camera, thin = task.frame.camera, self.options.least_silhouette
        T_view_map = se3.inverse(T_map_view)
        with self._recorder.timed("tracking render"):
            options = DrawOptions(thin)
            surface = draw_surface(self._backend, task.gaussians, camera, T_view_map, options)
            levels = pyramid(view_of(surface, camera, thin), self.options.levels)
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
        estimate = _Estimate(start.copy(), self._scales, *self._exposure)
        renders = 1
        while True:
            with self._recorder.timed("tracking align"):
                self._align(task, view, estimate, coarse=renders == 1)
            near = not self._moved_far(view.T_map_view, estimate.T_map_camera, task.frame)
            if (near and estimate.converged) or renders == self.options.renders:
                told = self._told(task, view, estimate)
                return self._result(estimate, renders, task.levels[0], told)
            view = self._draw(task, estimate.T_map_camera)
            renders += 1

    def _align(self, task: _Task, view: _View, estimate: _Estimate, coarse: bool) -> None:
        """Coarse to fine; a second view of the same frame needs the finest level only."""
        if task.levels[0].depth_m.is_cuda:
            self._align_on_gpu(task, view, estimate, coarse)
            return
        T_view_map = se3.inverse(view.T_map_view)
        for level in range(len(view.levels) - 1 if coarse else 0, -1, -1):
            gate = self.options.max_distance * 2**level
            estimate.converged = False
            for _ in range(self.options.iterations):
                linear = linearise(
                    view.levels[level],
                    task.levels[level],
                    T_view_map @ estimate.T_map_camera,
                    self._weighted(estimate.scales),
                    (estimate.gain, estimate.bias),
                    gate,
                )
                estimate.last = linear
                estimate.iterations += 1
                # A coarse view may be far off: it fits the pose at the last exposure.
                step = self._step(linear, estimate, self.options.exposure and level == 0)
                if step is None:
                    return
                T_view_camera = se3.exp(step[:6]) @ (T_view_map @ estimate.T_map_camera)
                estimate.T_map_camera = view.T_map_view @ se3.orthonormalise(T_view_camera)
                estimate.gain += step[6]
                estimate.bias += step[7]
                estimate.scales = rescaled(estimate.scales, linear, self.options.photometric_weight)
                small = np.linalg.norm(step[:3]) < _SMALL_TRANSLATION_M * 4**level
                small &= np.linalg.norm(step[3:6]) < _SMALL_ROTATION_RAD * 4**level
                if small:
                    estimate.converged = True
                    break

    def _align_on_gpu(self, task: _Task, view: _View, estimate: _Estimate, coarse: bool) -> None:
        """The same steps, none of which asks the host."""
        from toolkit.tracking.cuda.aligner import Alignment, Rules, align

        options, count = self.options, len(view.levels) if coarse else 1
        T_view_camera = se3.inverse(view.T_map_view) @ estimate.T_map_camera
        rules = Rules(
            iterations=options.iterations,
            max_distance=options.max_distance,
            photometric_weight=options.photometric_weight,
            exposure=self._exposure if options.exposure else None,
            fewest_pixels=_FEWEST_PIXELS,
            small_m=_SMALL_TRANSLATION_M,
            small_rad=_SMALL_ROTATION_RAD,
        )
        start = Alignment(T_view_camera, estimate.scales, estimate.gain, estimate.bias)
        found = align(view.levels[:count], task.levels[:count], start, rules)
        estimate.T_map_camera = view.T_map_view @ found.T_view_camera
        estimate.scales, estimate.last = found.scales, found.last or estimate.last
        estimate.gain, estimate.bias = found.gain, found.bias
        estimate.iterations += found.iterations
        estimate.converged = found.converged

    def _weighted(self, scales: Scales) -> Scales:
        return Scales(scales.intensity / np.sqrt(self.options.photometric_weight), scales.depth_m)

    def _step(
        self, linear: Linearisation, estimate: _Estimate, with_exposure: bool
    ) -> NDArray[np.float64] | None:
        """Gauss-Newton step [8], or None where the equations cannot be solved."""
        if linear.depth_pixels + linear.intensity_pixels < _FEWEST_PIXELS:
            return None
        H, g = linear.H.copy(), linear.g.copy()
        if with_exposure:
            pixels = linear.intensity_pixels / estimate.scales.intensity**2
            change = np.array([estimate.gain, estimate.bias]) - self._exposure
            exposure.hold(H, g, pixels, change)
        else:
            exposure.fix(H, g)
        H[np.diag_indices(8)] *= 1.0 + 1e-6
        try:
            step = np.asarray(-np.linalg.solve(H, g), dtype=np.float64)
        except np.linalg.LinAlgError:
            return None
        return step if np.isfinite(step).all() else None

    def _told(self, task: _Task, view: _View, estimate: _Estimate) -> tuple[float, float]:
        """Gain and bias of the frame for the map."""
        fitted = (estimate.gain, estimate.bias)
        if not self.options.exposure or estimate.last is None:
            return fitted
        levels = list(zip(view.levels, task.levels, strict=True))
        T_view_camera = se3.inverse(view.T_map_view) @ estimate.T_map_camera
        scales, gate = self._weighted(estimate.scales), self.options.max_distance
        return told_exposure(levels, T_view_camera, scales, fitted, gate)

    def _moved_far(
        self, T_map_view: NDArray[np.float64], T_map_camera: NDArray[np.float64], frame: Frame
    ) -> bool:
        motion = se3.inverse(T_map_view) @ T_map_camera
        valid = frame.depth_m[frame.depth_m > 0]
        reach = float(np.median(valid)) if valid.size else 1.0
        distance = np.linalg.norm(motion[:3, 3]) / reach + se3.rotation_angle_rad(motion[:3, :3])
        return bool(distance > self.options.rerender_distance)

    def _result(
        self,
        estimate: _Estimate,
        renders: int,
        finest: FrameLevel,
        told: tuple[float, float],
    ) -> TrackingResult:
        measured = float((finest.depth_m > 0).sum())
        linear = estimate.last
        visible = linear.depth_pixels / max(measured, 1.0) if linear else 0.0
        # Perturbations were on the view's side; the view stands at the pose itself now.
        information = linear.H[:6, :6] if linear else np.zeros((6, 6))
        health, reason = verdict(self.limits, estimate.scales, visible, information, measured)
        return TrackingResult(
            T_map_camera=estimate.T_map_camera,
            converged=estimate.converged,
            iterations=estimate.iterations,
            renders=renders,
            intensity_residual=estimate.scales.intensity,
            depth_residual_m=estimate.scales.depth_m,
            visible_fraction=visible,
            information=information,
            health=health,
            reason=reason,
            gain=told[0],
            bias=told[1],
        )
