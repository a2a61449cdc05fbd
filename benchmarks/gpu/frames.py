"""Whole frames on a GPU and on the CPU: tracking, mapping, the papers' preset, recordings."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch

from benchmarks.gpu.report import UNTIMED, Plan, Stopwatch, medians_ms, row, table
from benchmarks.gpu.scene import camera_of, pose_of, trajectory, walk
from toolkit.base.exposure import Exposure
from toolkit.base.frame import Frame
from toolkit.base.geometry import se3
from toolkit.base.geometry.trajectory import Trajectory
from toolkit.base.native import available_instruction_sets
from toolkit.base.stages import Stage
from toolkit.datasets.registry import open_dataset
from toolkit.runs.evaluation.images import psnr_db
from toolkit.runs.evaluation.trajectory import absolute_trajectory_error
from toolkit.semantics.codes import SemanticCode, binary_code, one_hot_code
from toolkit.semantics.decoder import NetworkDecoder
from toolkit.semantics.options import SemanticLossWeights
from toolkit.semantics.taxonomy import Taxonomy
from toolkit.slam.front_end import FrontEnd
from toolkit.slam.mapping.mapper import Mapper
from toolkit.slam.mapping.options import ConsensusOptions, KeyframePolicy, MapperOptions
from toolkit.slam.mapping.semantic_mapping import SemanticMapping
from toolkit.slam.system import Slam
from toolkit.slam.tracking.dense import DenseTracker
from toolkit.slam.tracking.first_order_tracker import FirstOrderTracker
from toolkit.slam.tracking.options import FirstOrderOptions
from toolkit.splatting.alignment import reference
from toolkit.splatting.alignment.data import INITIAL_SCALES, FrameLevel, LevelProblem, ModelLevel
from toolkit.splatting.alignment.levels import finest_level, model_level
from toolkit.splatting.gaussians.cloud import GaussianCloud
from toolkit.splatting.losses.semantic import SemanticLoss
from toolkit.splatting.rendering import backend

# Siblings at each level: 26 channels one-hot, as many as Replica's tree has.
WIDTHS = (2, 4, 5, 7, 8)
INTERVAL = 5
_BOUND = 2e-3  # of the sums of a step; a pixel at a threshold may go either way


def tree(widths: Sequence[int], name: str = "class ") -> dict[str, Any]:
    """A taxonomy whose first child alone goes on, so that it has few classes for its channels."""
    children: dict[str, Any] = {f"{name}{number}": None for number in range(widths[0])}
    if len(widths) > 1:
        children[f"{name}0"] = tree(widths[1:], f"{name}0.")
    return children


TAXONOMY = Taxonomy(tree(WIDTHS))


@functools.cache
def walked(plan: Plan) -> list[Frame]:
    """The frames of the walk."""
    camera = camera_of(*plan.size)
    frames: list[Frame] = walk(backend("cuda"), camera, plan.frames, plan.device, len(TAXONOMY))
    return frames


def places(plan: Plan) -> list[tuple[str, str]]:
    """Devices and renderers to compare: the plan's, and the CPU where its kernels were built."""
    native = [("cpu", "native")] if available_instruction_sets() else []
    return [(plan.device, "cuda"), *native]


@dataclass(frozen=True)
class Walked:
    """What became of some frames.

    Attributes:
        tracking_ms, mapping_ms: medians, of a frame and of a keyframe.
        share: keyframes a frame, after the first.
        lost: frames without a pose.
        ate_cm: root mean square error of the aligned path. psnr_db: mean, of the final map.
    """

    tracking_ms: float
    mapping_ms: float
    share: float
    lost: int
    ate_cm: float
    psnr_db: float
    gaussians: GaussianCloud

    @property
    def rates(self) -> list[float]:
        """Milliseconds of tracking and frames a second; the same with mapping."""
        together = self.tracking_ms + self.share * self.mapping_ms
        return [self.tracking_ms, 1e3 / self.tracking_ms, self.mapping_ms, 1e3 / together]


def run(
    slam: Slam, watch: Stopwatch, frames: list[Frame], truth: Trajectory, device: str
) -> Walked:
    """Track and map frames, refine the map, and measure it."""
    for frame in frames:
        slam.process_frame(frame)
    result = slam.finish()
    gaussians = result.gaussians.to(device)
    by_index = {frame.index: frame for frame in frames}
    poses = result.trajectory.T_world_camera
    places = zip(result.frame_indices, poses, result.exposures, strict=True)
    found = []
    for index, T, exposure in places:
        frame = by_index[index]
        colour = slam.mapper.render(gaussians, frame.camera, T).output.colour
        shown = exposure.undo(colour).clamp(0.0, 1.0).cpu().numpy()
        found.append(psnr_db(shown, frame.rgb))
    ate = absolute_trajectory_error(result.trajectory, truth)
    return Walked(
        watch.median_ms(Stage.TRACKING),
        watch.median_ms(Stage.MAPPING),
        (len(result.keyframe_indices) - 1) / (len(frames) - 1),
        len(result.lost_frames),
        100.0 * ate.rmse_m,
        float(np.mean(found)),
        gaussians,
    )


def system(
    place: tuple[str, str],
    options: MapperOptions,
    semantics: SemanticMapping | None = None,
    levels: int = 4,
    first_order: FirstOrderOptions | None = None,
) -> tuple[Slam, Stopwatch]:
    """Tracker and mapper of one place, and the watch that times them."""
    device, backend_name = place
    watch = Stopwatch(device, "tracking", "mapping")
    tracker = (
        DenseTracker(backend_name=backend_name, levels=levels)
        if first_order is None
        else FirstOrderTracker(first_order, backend_name=backend_name)
    )
    options = replace(options, centred=first_order is None)
    mapper = Mapper(options, None, backend_name, watch, semantics, device)
    return Slam(FrontEnd(tracker), mapper, recorder=watch), watch


def _quick(options: MapperOptions, plan: Plan) -> MapperOptions:
    if plan.timed:
        return options
    few = ConsensusOptions(rounds=0)
    options = replace(options, iterations=1, first_iterations=1, final_iterations=1, consensus=few)
    # Ellipsoids would take 72 steps at least; their kernels have checks of their own.
    return replace(options, final_shape="spheres")


def _cells(times: Sequence[float], plan: Plan) -> list[object]:
    """Times, or that they are none."""
    return list(times) if plan.timed else [UNTIMED] * len(times)


_FRAME_COLUMNS = (
    *("track ms", "tracked a s", "map a keyframe ms", "tracked and mapped a s"),
    *("lost", "ATE cm", "PSNR dB"),
)


def _frame_cells(found: Walked, plan: Plan) -> list[object]:
    return [*_cells(found.rates, plan), found.lost, found.ate_cm, found.psnr_db]


def frame_table(plan: Plan) -> None:
    """A walk tracked and mapped, every fifth frame by 30 steps, without and with semantics."""
    frames = walked(plan)
    keyframes = KeyframePolicy(interval=INTERVAL, min_overlap=0.0)
    options = _quick(MapperOptions(iterations=30, keyframes=keyframes), plan)
    size = f"{plan.size[0]}x{plan.size[1]}"
    table("Whole frames", "device", "image", "semantic channels", *_FRAME_COLUMNS)
    codes: list[SemanticCode | None] = [None, one_hot_code(TAXONOMY)]
    for place in places(plan):
        for code in codes if plan.timed else codes[1:]:
            loss = None if code is None else SemanticLoss(code, SemanticLossWeights())
            semantics = SemanticMapping(loss)
            levels = 4 if plan.timed else 2
            slam, watch = system(place, options, semantics, levels)
            found = run(slam, watch, frames, trajectory(plan.frames), place[0])
            name = f"{place[0]} ({place[1]})"
            row(name, size, semantics.channels, *_frame_cells(found, plan))


def papers_table(plan: Plan) -> None:
    """The papers' way: 40 first-order tracking steps and 60 mapping steps a frame, on the GPU.

    Rendering is of the map that this left, colour and depth or with its semantic channels.
    """
    count = min(plan.frames, 4)
    frames = walked(plan)[:count]
    every_frame = KeyframePolicy(interval=1)
    options = MapperOptions(iterations=60, first_iterations=60, keyframes=every_frame)
    options = _quick(options, plan)
    columns = ("semantics", "channels", "track s a frame", "map s a frame", "rendered a s")
    table("The papers' preset", *columns)
    tracking = FirstOrderOptions(iterations=40 if plan.timed else 1)
    codes: dict[str, SemanticCode | None] = {
        "none": None,
        "binary": binary_code(TAXONOMY),
        "one-hot": one_hot_code(TAXONOMY),
    }
    for name, code in codes.items() if plan.timed else [("one-hot", codes["one-hot"])]:
        semantics = SemanticMapping(None if code is None else _papers_loss(code))
        slam, watch = system((plan.device, "cuda"), options, semantics, first_order=tracking)
        found = run(slam, watch, frames, trajectory(count), plan.device)
        seconds = [found.tracking_ms / 1e3, found.mapping_ms / 1e3]
        rate = [_rendered_a_second(found.gaussians, code is not None, plan)]
        row(name, semantics.channels, *_cells([*seconds, *rate], plan))


def _papers_loss(code: SemanticCode) -> SemanticLoss:
    """Both terms on every pixel at every step, felt by the geometry."""
    weights = SemanticLossWeights(every=1, inter_pixels=0, moves_geometry=True)
    generator = torch.Generator().manual_seed(0)
    network = NetworkDecoder(code.channels, len(code.taxonomy), generator=generator)
    return SemanticLoss(code, weights, network)


def _rendered_a_second(gaussians: GaussianCloud, semantic: bool, plan: Plan) -> float:
    if not plan.timed:
        return float("nan")
    camera, features = camera_of(*plan.size), gaussians.features if semantic else None
    T_camera_map = se3.inverse(pose_of(0))

    def draw() -> object:
        return backend("cuda").forward(gaussians, camera, T_camera_map, features, None)

    return 1e3 / medians_ms({"draw": draw}, plan.repeats)["draw"]


def recording_table(plan: Plan, recordings: Sequence[tuple[str, str]]) -> None:
    """Recordings from disk by their layout and folder: the same path and map as on the CPU?"""
    table("Recordings", "folder", "device", "frames", *_FRAME_COLUMNS)
    for kind, path in recordings:
        dataset = open_dataset(kind, path, max_frames=plan.frames)
        frames = [replace(dataset[i], labels=None) for i in range(len(dataset))]
        truth = dataset.ground_truth
        if truth is None:
            raise SystemExit(f"gpu.py: {path} has no true path to compare with")
        for place in places(plan):
            slam, watch = system(place, _quick(MapperOptions(iterations=30), plan))
            found = run(slam, watch, frames, truth, place[0])
            name = f"{place[0]} ({place[1]})"
            row(dataset.name, name, len(frames), *_frame_cells(found, plan))


def check_alignment(plan: Plan) -> bool:
    """The sums of a Gauss-Newton step against float64 in numpy; whether they are within bounds."""
    from toolkit.splatting.alignment.cuda.sums import linearise

    camera = camera_of(*((320, 180) if plan.timed else (24, 16)))
    frames = walk(backend("cuda"), camera, 2, plan.device, 2)
    view, frame = (finest_level(frame, torch.device("cpu")) for frame in frames)
    model, pose, exposure, gate = model_level(view), pose_of(1), Exposure(1.02, -0.01), 0.1
    sigmas = INITIAL_SCALES.intensity, INITIAL_SCALES.depth_m
    scalars = (exposure.gain, exposure.bias, *sigmas, gate, 1.0)
    sums = reference.accumulate(
        (model.texture.numpy(), model.surface.numpy()),
        (frame.intensity.numpy(), frame.depth_m.numpy()),
        (camera, camera),
        pose,
        scalars,
    )
    there = ModelLevel(camera, model.texture.to(plan.device), model.surface.to(plan.device))
    frame_there = FrameLevel(camera, frame.intensity.to(plan.device), frame.depth_m.to(plan.device))
    problem = LevelProblem(there, frame_there, pose, INITIAL_SCALES, exposure, gate)
    linear = linearise(problem)
    actual = np.concatenate([linear.H[np.triu_indices(8)], linear.g])
    error = float(np.linalg.norm(actual - sums[:44]) / np.linalg.norm(sums[:44]))
    good = error <= _BOUND
    table("The sums of a tracking step against float64", "image", "error", "bound", "")
    row(f"{camera.width}x{camera.height}", error, _BOUND, "ok" if good else "WRONG")
    return good
