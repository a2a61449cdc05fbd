"""Runs of semsplat and of OpenSplat for `benchmarks.trainers`, with their CPU seconds."""

from __future__ import annotations

import os
import resource
import subprocess
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from benchmarks.programs import semsplat_command
from toolkit.base.frame import Frame
from toolkit.base.geometry import se3
from toolkit.io.images import write_png
from toolkit.io.labelled_points import LabelledPoints, write_labelled_points
from toolkit.io.posed_images import ColouredPoints, PosedImage, write_transforms
from toolkit.io.visualisation import colour_image
from toolkit.runs.maps.finished import FinishedRun

HOLD_OUT = 5
# Steps per keyframe of a map that is refined for longer.
REFINE_STEPS = 96
# Steps of the two short runs that estimate the time of a step.
_TRIALS = (2, 12)
_TAIL = 2000


def cpu_seconds(command: Sequence[str]) -> float:
    """Run a program to its end on one thread and return its CPU seconds, of user and system.

    Raises:
        SystemExit: it failed or cannot be started.
    """
    before = _children_s()
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=False, env=environment)
    except OSError as error:
        raise SystemExit(f"{command[0]} cannot be started: {error}") from error
    if done.returncode:
        output = done.stderr[-_TAIL:] or done.stdout[-_TAIL:]
        raise SystemExit(f"{' '.join(command)}\nexit status {done.returncode}\n{output}")
    return _children_s() - before


def _children_s() -> float:
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


def our_map(arguments: Sequence[str], shape: str, seed: int, out: Path) -> float:
    """Map a sequence into a run folder, and return the CPU seconds.

    Args:
        arguments: of `semsplat run`, which choose frames and poses.
        shape: of the finished map.
    """
    options = [*our_options(shape), "--seed", str(seed), "--out", str(out)]
    return cpu_seconds(semsplat_command("run", *arguments, *options))


def refined_map(run: Path, out: Path) -> float:
    """Refine the map of a run into another run folder, and return the CPU seconds."""
    options = ["--iterations", str(REFINE_STEPS), "--threads", "1"]
    return cpu_seconds(semsplat_command("refine", str(run), "--out", str(out), *options))


def our_options(shape: str) -> list[str]:
    """Options of `semsplat run` for a map without semantics, whose Gaussians end in a shape."""
    without = ["--segmenter.kind", "none"]
    return ["--hold-out", str(HOLD_OUT), *without, "--mapping.final-shape", shape]


def trainer_input(run: FinishedRun, folder: Path, points: int, seed: int) -> Path:
    """Write the keyframes of a run as a project of nerfstudio, and return its folder.

    Args:
        points: number of points of the depth images, from which training starts.
        seed: of the choice of points.
    """
    dataset = run.open_dataset()
    poses = {frame.index: frame.T_map_camera for frame in run.tracked if not frame.held_out}
    chosen = [index for index in run.keyframes if index in poses]
    (folder / "images").mkdir(parents=True)
    posed, clouds = [], []
    generator = np.random.default_rng(seed)
    for index in chosen:
        frame, name = dataset[index], f"images/frame_{index:06d}.png"
        write_png(folder / name, colour_image(frame.rgb))
        posed.append(PosedImage(name, poses[index]))
        clouds.append(sampled(frame, poses[index], -(-points // len(chosen)), generator))
    xyz = np.concatenate([cloud.points_m for cloud in clouds])
    rgb = np.concatenate([cloud.rgb for cloud in clouds])
    write_labelled_points(folder / "points.ply", LabelledPoints(xyz, rgb, None, {}))
    write_transforms(folder / "transforms.json", run.camera, posed, "points.ply")
    return folder


def sampled(
    frame: Frame, T_map_camera: np.ndarray, count: int, generator: np.random.Generator
) -> ColouredPoints:
    """Random pixels of a frame with depth as points in the map's frame, at most `count`."""
    rows, columns = np.nonzero(frame.depth_m > 0.0)
    kept = generator.permutation(len(rows))[:count]
    points = frame.camera.unproject(frame.depth_m)[rows[kept], columns[kept]]
    colours = colour_image(frame.rgb)[rows[kept], columns[kept]]
    return ColouredPoints(se3.transform_points(T_map_camera, points), colours)


class OpenSplat:
    """OpenSplat's program.

    Args:
        program: its path.
    """

    def __init__(self, program: Path) -> None:
        self._program = program
        self._costs: dict[Path, tuple[float, float]] = {}

    def command(self, project: Path, out: Path, steps: int, save_every: int | None) -> list[str]:
        """The command that trains a project for some steps and writes a splat file."""
        # The project's frame and full resolution from the first step on.
        options = ["--cpu", "--keep-crs", "--num-downscales", "0"]
        saved = [] if save_every is None else ["--save-every", str(save_every)]
        return [
            str(self._program),
            str(project),
            "-o",
            str(out),
            "-n",
            str(steps),
            *options,
            *saved,
        ]

    def train(self, project: Path, out: Path, steps: int, save_every: int | None = None) -> float:
        """Train a project and return the CPU seconds.

        Args:
            save_every: interval of the steps after which `STEM_STEP.ply` is written beside the
                file; never by default.

        Raises:
            SystemExit: the program failed or wrote no file.
        """
        seconds = cpu_seconds(self.command(project, out, steps, save_every))
        if not out.is_file():
            raise SystemExit(f"{self._program} did not write {out}")
        return seconds

    def steps(self, project: Path, trial: Path, cpu_s: float) -> int:
        """Number of steps, at least 1, that fit into CPU seconds, estimated from two short runs.

        Args:
            trial: file that the short runs write.
        """
        if project not in self._costs:
            few, more = (self.train(project, trial, steps) for steps in _TRIALS)
            step_s = (more - few) / (_TRIALS[1] - _TRIALS[0])
            self._costs[project] = few - _TRIALS[0] * step_s, step_s
        start_s, step_s = self._costs[project]
        return steps_within(cpu_s, start_s, step_s)


def steps_within(cpu_s: float, start_s: float, step_s: float) -> int:
    """Number of steps, at least 1, of a program that takes `start_s` and `step_s` for each.

    Raises:
        SystemExit: the steps take no measurable time.
    """
    if step_s <= 0.0:
        raise SystemExit("OpenSplat's steps take no measurable time; is it the right program?")
    return max(1, int((cpu_s - start_s) / step_s))
