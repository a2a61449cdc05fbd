"""The default tracker: dense Gauss-Newton against the rendered map (mission section 7).

Render once where the camera is expected, align the frame to that view coarse to fine, and
render again only where the result lies far from the view that it was measured against.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from toolkit.frame import Frame, NullRecorder, Recorder
from toolkit.gaussians.cloud import GaussianCloud
from toolkit.geometry import se3
from toolkit.geometry.camera import Camera
from toolkit.rendering import DrawOptions, backend, draw_surface
from toolkit.tracking.alignment import (
    FrameLevel,
    Linearisation,
    ModelLevel,
    Scales,
    intensity_of,
    linearise,
    model_level,
    pyramid,
    view_of,
)
from toolkit.tracking.health import HealthLimits, verdict
from toolkit.tracking.motion import ConstantVelocity
from toolkit.tracking.result import TrackingResult


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
    """

    levels: int = 4
    iterations: int = 12
    renders: int = 3
    rerender_distance: float = 0.02
    least_silhouette: float = 0.9
    max_distance: float = 0.05
    exposure: bool = True
    photometric_weight: float = 1.0


# Start and bounds of the residual scales, which every step re-estimates.
_START = Scales(intensity=0.05, depth_m=0.01)
_LEAST = Scales(intensity=0.002, depth_m=0.0001)
_MOST = Scales(intensity=0.2, depth_m=0.05)

# Share of the pixels that hold gain and bias where they were in the last frame.
_EXPOSURE_PRIOR = 0.02

# Changes of exposure smaller than both are not told from the map's own smoothness.
_CONTRAST_LOSS, _BRIGHTNESS_LOSS = 0.06, 0.02

# Fewer residuals than this fix no pose.
_FEWEST_PIXELS = 50

# Steps below these end a level: a thousandth of a pixel at usual focal lengths.
_SMALL_TRANSLATION_M = 2e-5
_SMALL_ROTATION_RAD = 1e-5


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
        self._scales = _START
        self._exposure = (1.0, 0.0)

    wants_labels = False

    def first_pose(self, frame: Frame) -> NDArray[np.float64]:
        """The map's frame is the first camera's."""
        self.motion.update(frame.timestamp_s, np.eye(4))
        return np.eye(4)

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
        if result.lost:
            self.motion.forget_velocity()
        else:
            self.motion.update(frame.timestamp_s, result.T_map_camera)
            self._scales = Scales(result.intensity_residual, result.depth_residual_m)
            self._exposure = (result.gain, result.bias)
        return result

    def locate(
        self, frame: Frame, gaussians: GaussianCloud, *starts: NDArray[np.float64]
    ) -> TrackingResult:
        """Pose of a frame near one of the starts; the tracker's own state stays as it is.

        Args:
            starts: T_map_camera [4, 4] each; the map is drawn at the first, and the one that
                fits best on the coarsest level is where alignment begins.
        """
        levels = pyramid(
            FrameLevel(frame.camera, intensity_of(frame.rgb), torch.from_numpy(frame.depth_m)),
            self.options.levels,
        )
        estimate = _Estimate(starts[0].copy(), self._scales, *self._exposure)
        renders = 0
        while renders < self.options.renders:
            T_map_view = estimate.T_map_camera.copy()
            with self._recorder.timed("tracking render"):
                view = self._draw_levels(gaussians, frame.camera, T_map_view)
            if renders == 0:
                estimate.T_map_camera = self._best_start(view[-1], levels[-1], starts, estimate)
            renders += 1
            with self._recorder.timed("tracking align"):
                self._align(view, levels, T_map_view, estimate, coarse=renders == 1)
            near = not self._moved_far(T_map_view, estimate.T_map_camera, frame)
            if near and estimate.converged:
                break
        return self._result(estimate, renders, levels[0])

    def _draw_levels(
        self, gaussians: GaussianCloud, camera: Camera, T_map_view: NDArray[np.float64]
    ) -> list[ModelLevel]:
        thin = self.options.least_silhouette
        T_view_map = se3.inverse(T_map_view)
        surface = draw_surface(self._backend, gaussians, camera, T_view_map, DrawOptions(thin))
        view = view_of(surface, camera, thin)
        return [model_level(level) for level in pyramid(view, self.options.levels)]

    def _best_start(
        self,
        view: ModelLevel,
        frame: FrameLevel,
        starts: tuple[NDArray[np.float64], ...],
        estimate: _Estimate,
    ) -> NDArray[np.float64]:
        """The start with the least cost against the view drawn at the first one."""
        if len(starts) == 1:
            return starts[0].copy()
        T_view_map = se3.inverse(starts[0])
        gate = self.options.max_distance * 2 ** (self.options.levels - 1)
        exposure = (estimate.gain, estimate.bias)
        costs = [
            linearise(view, frame, T_view_map @ T, estimate.scales, exposure, gate).cost
            for T in starts
        ]
        return starts[int(np.argmin(costs))].copy()

    def _align(
        self,
        view: list[ModelLevel],
        frame: list[FrameLevel],
        T_map_view: NDArray[np.float64],
        estimate: _Estimate,
        coarse: bool,
    ) -> None:
        """Coarse to fine; a second view of the same frame needs the finest level only."""
        T_view_map = se3.inverse(T_map_view)
        for level in range(len(view) - 1 if coarse else 0, -1, -1):
            gate = self.options.max_distance * 2**level
            estimate.converged = False
            for _ in range(self.options.iterations):
                linear = linearise(
                    view[level],
                    frame[level],
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
                estimate.T_map_camera = T_map_view @ se3.orthonormalise(T_view_camera)
                estimate.gain += step[6]
                estimate.bias += step[7]
                estimate.scales = _rescaled(estimate.scales, linear, self.options)
                small = np.linalg.norm(step[:3]) < _SMALL_TRANSLATION_M * 4**level
                small &= np.linalg.norm(step[3:6]) < _SMALL_ROTATION_RAD * 4**level
                if small:
                    estimate.converged = True
                    break

    def _weighted(self, scales: Scales) -> Scales:
        return Scales(scales.intensity / np.sqrt(self.options.photometric_weight), scales.depth_m)

    def _step(
        self, linear: Linearisation, estimate: _Estimate, exposure: bool
    ) -> NDArray[np.float64] | None:
        """Gauss-Newton step [8], or None where the equations cannot be solved."""
        if linear.depth_pixels + linear.intensity_pixels < _FEWEST_PIXELS:
            return None
        H, g = linear.H.copy(), linear.g.copy()
        if exposure:
            # Exposure changes little between frames. Left free, gain 0 would explain any
            # misalignment: on steps of 5 to 17 degrees it took the pose away by 70 cm.
            prior = _EXPOSURE_PRIOR * linear.intensity_pixels / estimate.scales.intensity**2
            H[6, 6] += prior
            H[7, 7] += prior
            g[6] += prior * (estimate.gain - self._exposure[0])
            g[7] += prior * (estimate.bias - self._exposure[1])
        else:
            H[6:, :] = 0.0
            H[:, 6:] = 0.0
            H[6, 6] = H[7, 7] = 1.0
            g[6:] = 0.0
        H[np.diag_indices(8)] *= 1.0 + 1e-6
        try:
            step = np.asarray(-np.linalg.solve(H, g), dtype=np.float64)
        except np.linalg.LinAlgError:
            return None
        return step if np.isfinite(step).all() else None

    def _moved_far(
        self, T_map_view: NDArray[np.float64], T_map_camera: NDArray[np.float64], frame: Frame
    ) -> bool:
        motion = se3.inverse(T_map_view) @ T_map_camera
        valid = frame.depth_m[frame.depth_m > 0]
        reach = float(np.median(valid)) if valid.size else 1.0
        distance = np.linalg.norm(motion[:3, 3]) / reach + se3.rotation_angle_rad(motion[:3, :3])
        return bool(distance > self.options.rerender_distance)

    def _result(self, estimate: _Estimate, renders: int, finest: FrameLevel) -> TrackingResult:
        measured = float((finest.depth_m > 0).sum())
        linear = estimate.last
        visible = linear.depth_pixels / max(measured, 1.0) if linear else 0.0
        # Perturbations were on the view's side; the view stands at the pose itself now.
        information = linear.H[:6, :6] if linear else np.zeros((6, 6))
        gain, bias = _believable_exposure(estimate.gain, estimate.bias)
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
            gain=gain,
            bias=bias,
        )


def _believable_exposure(gain: float, bias: float) -> tuple[float, float]:
    """Gain and bias, or none where they could be the map's own loss of contrast.

    A map is a little smoother than the camera's image, so a fit finds gain below and bias
    above their true values; believed, they would grow from keyframe to keyframe (by 30 % of
    the brightness over 300 frames of a room).
    """
    at_mid_grey = 0.5 * gain + bias - 0.5
    if abs(gain - 1.0) < _CONTRAST_LOSS and abs(at_mid_grey) < _BRIGHTNESS_LOSS:
        return 1.0, 0.0
    return gain, bias


def _rescaled(scales: Scales, linear: Linearisation, options: DenseOptions) -> Scales:
    """Scales of Student's t from the last residuals: one step of its fixed point."""
    intensity = scales.intensity * np.sqrt(linear.intensity_variance / options.photometric_weight)
    depth = scales.depth_m * np.sqrt(linear.depth_variance)
    return Scales(
        float(np.clip(intensity, _LEAST.intensity, _MOST.intensity))
        if linear.intensity_pixels
        else scales.intensity,
        float(np.clip(depth, _LEAST.depth_m, _MOST.depth_m))
        if linear.depth_pixels
        else scales.depth_m,
    )
