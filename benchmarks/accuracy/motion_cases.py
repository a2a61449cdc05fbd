"""Frames of recordings as they are shown to a method: left out, covered, blurred, at other times.

A case selects frames of one recording. Bad inputs mix frames that no single camera motion explains.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial

import cv2
import numpy as np
from numpy.typing import NDArray

from toolkit.base.frame import Frame
from toolkit.base.geometry.camera import Camera
from toolkit.base.geometry.trajectory import Trajectory
from toolkit.datasets.base import RecordedDataset, Recording
from toolkit.datasets.shutter.recording import estimate_readout, with_readout

Array = NDArray[np.float64]
Numbers = NDArray[np.int64]

STRIDES = (1, 2, 4, 8, 16, 24)
_DROPPED = 0.3
# Frames BURST_FIRST to BURST_FIRST + 14 of every 60 are dropped, but none of the last 20.
_BURST, _BURST_FIRST, _BURST_EVERY, _BURST_MARGIN = 15, 30, 60, 20
JUMPS = (50, 100, 200)
# For sequences that are too short for the others.
_SHORT_JUMP = 25
_COVERED = 10
_FROZEN, _INTERRUPTED = 10, 30
# The second ten of every thirty frames are blurred, by a Gaussian of this sigma in pixels.
_BLUR_SIGMA_PX, _BLUR_LENGTH = 2.0, 10
_WALL_FRAMES, _WALL_DEPTH_M, _WALL_BRIGHTNESS, _WALL_NOISE = 100, 1.0, 0.7, 0.01
_RATE_HZ = 30.0


@dataclass(frozen=True)
class Selection:
    """Which frames of a recording are shown, and how.

    Attributes:
        indices: [N] of the frames in the recording, not decreasing.
        timestamps_s: [N] when they are shown, increasing.
        covered: frames, by their position, that are black and without depth.
        blurred: frames whose colour is blurred.
        time_factor: duration of anything in relation to the recording.
    """

    indices: Numbers
    timestamps_s: Array
    covered: range = range(0)
    blurred: frozenset[int] = frozenset()
    time_factor: float = 1.0


Select = Callable[[Array, np.random.Generator], Selection]


def _strided(step: int, times_s: Array, _: np.random.Generator) -> Selection:
    """Every n-th frame."""
    return _kept(times_s, np.arange(len(times_s)) % step == 0)


def _dropped(times_s: Array, rng: np.random.Generator) -> Selection:
    """Without 30 % of the frames, chosen at random; the first one is kept."""
    kept = rng.random(len(times_s)) >= _DROPPED
    kept[0] = True
    return _kept(times_s, kept)


def _bursts(times_s: Array, _: np.random.Generator) -> Selection:
    """Without 15 consecutive frames of every 60."""
    kept = np.ones(len(times_s), bool)
    for first in range(_BURST_FIRST, len(times_s) - _BURST_MARGIN, _BURST_EVERY):
        kept[first : first + _BURST] = False
    return _kept(times_s, kept)


def _jump(length: int, times_s: Array, _: np.random.Generator) -> Selection:
    """Without consecutive frames in the middle."""
    kept = np.ones(len(times_s), bool)
    first = (len(times_s) - length) // 2
    kept[first : first + length] = False
    return _kept(times_s, kept)


def _covered(length: int, times_s: Array, rng: np.random.Generator) -> Selection:
    """Consecutive frames in the middle are black and without depth."""
    first = len(times_s) // 2
    return replace(_strided(1, times_s, rng), covered=range(first, first + length))


def _frozen(times_s: Array, _: np.random.Generator) -> Selection:
    """The frame in the middle is shown in place of the ten after it."""
    indices = np.arange(len(times_s))
    middle = len(times_s) // 2
    indices[middle : middle + _FROZEN + 1] = middle
    return Selection(indices, times_s)


def _blurred(times_s: Array, rng: np.random.Generator) -> Selection:
    """Ten frames of every thirty are blurred; depth is not."""
    blurred = {i for i in range(len(times_s)) if i // _BLUR_LENGTH % 3 == 1}
    return replace(_strided(1, times_s, rng), blurred=frozenset(blurred))


def _repeated(times_s: Array, _: np.random.Generator) -> Selection:
    """Every frame is shown twice, the second time halfway to the next frame."""
    gaps_s = np.diff(times_s)
    gaps_s = np.append(gaps_s, gaps_s[-1])
    indices = np.repeat(np.arange(len(times_s)), 2)
    return Selection(indices, np.stack([times_s, times_s + gaps_s / 2], axis=1).reshape(-1))


def _slower(factor: float, times_s: Array, rng: np.random.Generator) -> Selection:
    """All frames, with the time between them, and that of their readout, times a factor."""
    slower_s = times_s[0] + factor * (times_s - times_s[0])
    return replace(_strided(1, times_s, rng), timestamps_s=slower_s, time_factor=factor)


def _kept(times_s: Array, kept: NDArray[np.bool_]) -> Selection:
    return Selection(np.flatnonzero(kept), times_s[kept])


CASES: dict[str, Select] = {
    **{f"stride {step}": partial(_strided, step) for step in STRIDES},
    "30 % dropped": _dropped,
    "bursts dropped": _bursts,
    **{f"jump of {length}": partial(_jump, length) for length in (_SHORT_JUMP, *JUMPS)},
    "covered": partial(_covered, _COVERED),
    "blur": _blurred,
    "repeated": _repeated,
    "half speed": partial(_slower, 2.0),
    "double speed": partial(_slower, 0.5),
}
# Of bad inputs; the last two take a second of a synthetic room.
INTERRUPTIONS: dict[str, Select] = {
    "frozen": _frozen,
    "black": partial(_covered, _INTERRUPTED),
    "pause": partial(_jump, _INTERRUPTED),
}


def cases_of(frames: int) -> list[str]:
    """The cases for a sequence of this length: jumps leave out at most half of it."""
    jumps = [length for length in JUMPS if length <= frames // 2] or [_SHORT_JUMP]
    left_out = {f"jump of {length}" for length in (_SHORT_JUMP, *JUMPS) if length not in jumps}
    return [name for name in CASES if name not in left_out]


class CaseDataset(RecordedDataset):
    """The frames of a recording that a case shows.

    Attributes:
        truth: [4, 4] T_world_camera by index of the frame, where it is known.
        scenes: which scene each frame shows: the same one.

    Args:
        recording: description of all frames.
        image_size: (width, height) in pixels, or None for the native size.
        case: a key of CASES or of INTERRUPTIONS.
        seed: of the choice of frames.
        estimate_shutter: estimate the rolling shutter from these frames, as a run does.
    """

    def __init__(
        self,
        recording: Recording,
        image_size: tuple[int, int] | None,
        case: str,
        seed: int = 0,
        estimate_shutter: bool = False,
    ) -> None:
        times_s = np.array([files.timestamp_s for files in recording.files])
        selection = (CASES | INTERRUPTIONS)[case](times_s, np.random.default_rng(seed))
        found = _true_poses(recording, [recording.files[i].timestamp_s for i in selection.indices])
        times_s = selection.timestamps_s
        files = tuple(
            replace(recording.files[index], timestamp_s=float(time_s))
            for index, time_s in zip(selection.indices, times_s, strict=True)
        )
        shown = replace(
            recording,
            files=files,
            ground_truth=Trajectory(times_s[list(found)], np.array(list(found.values()))),
            readout_s=selection.time_factor * (recording.readout_s or 0.0),
        )
        if estimate_shutter:
            shown = with_readout(shown, estimate_readout(shown))
        super().__init__(shown, image_size)
        self.truth, self._selection = found, selection
        self.scenes = [0] * len(files)

    def __getitem__(self, index: int) -> Frame:
        """Load a frame and edit it as the case demands."""
        frame = super().__getitem__(index)
        if index in self._selection.covered:
            black, missing = np.zeros_like(frame.rgb), np.zeros_like(frame.depth_m)
            return replace(frame, rgb=black, depth_m=missing)
        if index in self._selection.blurred:
            return replace(frame, rgb=cv2.GaussianBlur(frame.rgb, (0, 0), _BLUR_SIGMA_PX))
        return frame


class MixedDataset:
    """Frames of several scenes as one sequence of 30 frames per second; a `Dataset`.

    All frames have the camera of the first one, like images in one folder.

    Attributes:
        scenes: which scene each frame shows; `WALL` for a blank wall.
        truth: [4, 4] T_world_camera by index of the frame, where it is known; each scene has its
            own world.

    Args:
        name: for reports.
        datasets: the scenes, of the same image size.
        shots: scene and index in its dataset of each frame; (WALL, number) for a blank wall.
    """

    WALL = -1
    ground_truth: Trajectory | None = None
    label_names: dict[int, str] | None = None

    def __init__(
        self, name: str, datasets: Sequence[RecordedDataset], shots: Sequence[tuple[int, int]]
    ) -> None:
        self.name, self.camera = name, datasets[0].camera
        self._datasets, self._shots = datasets, shots
        self.scenes = [scene for scene, _ in shots]
        self.truth: dict[int, Array] = {}
        for number, (scene, index) in enumerate(shots):
            if scene == self.WALL:
                continue
            time_s = datasets[scene].files(index).timestamp_s
            for pose in _true_poses(datasets[scene].recording, [time_s]).values():
                self.truth[number] = pose

    def __len__(self) -> int:
        return len(self._shots)

    def __iter__(self) -> Iterator[Frame]:
        return (self[index] for index in range(len(self)))

    def __getitem__(self, index: int) -> Frame:
        """Load a frame.

        Raises:
            IndexError: there is no such frame.
        """
        if not 0 <= index < len(self):
            raise IndexError(f"frame {index} of {len(self)} in {self.name}")
        scene, number = self._shots[index]
        if scene == self.WALL:
            return _wall(index, number, self.camera)
        frame = self._datasets[scene][number]
        return Frame(index, index / _RATE_HZ, frame.rgb, frame.depth_m, self.camera)


def unrelated_photos(datasets: Sequence[RecordedDataset], each: int = 8) -> MixedDataset:
    """Frames far from each other, of a different scene each time.

    Args:
        datasets: the scenes.
        each: number of frames of each scene, evenly spaced.
    """
    chosen = [np.linspace(0, len(dataset) - 1, each).astype(int) for dataset in datasets]
    shots = [
        (scene, int(chosen[scene][turn])) for turn in range(each) for scene in range(len(datasets))
    ]
    return MixedDataset("unrelated photos", datasets, shots)


def with_blank_wall(dataset: RecordedDataset) -> MixedDataset:
    """A recording, interrupted in the middle by 100 frames of a blank wall at 1 m."""
    middle = len(dataset) // 2
    before = [(0, index) for index in range(middle)]
    wall = [(MixedDataset.WALL, number) for number in range(_WALL_FRAMES)]
    after = [(0, index) for index in range(middle, len(dataset))]
    return MixedDataset("blank wall", [dataset], [*before, *wall, *after])


def one_after_another(first: RecordedDataset, second: RecordedDataset) -> MixedDataset:
    """The first half of one recording, followed by the first half of another."""
    shots = [(0, index) for index in range(len(first) // 2)]
    shots += [(1, index) for index in range(len(second) // 2)]
    return MixedDataset("two recordings", [first, second], shots)


class _MirroredDataset(RecordedDataset):
    """The mirror images (left-right) of a recording, with the poses that they determine."""

    def __init__(self, dataset: RecordedDataset) -> None:
        truth = dataset.recording.ground_truth
        assert truth is not None, f"{dataset.name} has no ground truth"
        flip = np.diag([-1.0, 1.0, 1.0, 1.0])
        mirrored = Trajectory(truth.timestamps_s, flip @ truth.T_world_camera @ flip)
        super().__init__(replace(dataset.recording, ground_truth=mirrored), dataset.camera.size)

    def __getitem__(self, index: int) -> Frame:
        """Load a frame and mirror colour and depth."""
        frame = super().__getitem__(index)
        rgb, depth_m = (image[:, ::-1].copy() for image in (frame.rgb, frame.depth_m))
        return replace(frame, rgb=rgb, depth_m=depth_m)


def mirrored_later(dataset: RecordedDataset) -> MixedDataset:
    """A recording whose second half is mirrored (left-right), colour and depth."""
    middle = len(dataset) // 2
    shots = [(int(index >= middle), index) for index in range(len(dataset))]
    return MixedDataset("mirrored later", [dataset, _MirroredDataset(dataset)], shots)


def _wall(index: int, number: int, camera: Camera) -> Frame:
    """A uniform, fronto-parallel wall; colour and depth have 1 % of noise."""
    rng = np.random.default_rng(number)
    shape = (camera.height, camera.width)
    rgb = _WALL_BRIGHTNESS + _WALL_NOISE * rng.standard_normal((*shape, 3), np.float32)
    depth_m = _WALL_DEPTH_M * (1.0 + _WALL_NOISE * rng.standard_normal(shape, np.float32))
    return Frame(
        index, index / _RATE_HZ, rgb.astype(np.float32), depth_m.astype(np.float32), camera
    )


def _true_poses(recording: Recording, times_s: Sequence[float]) -> dict[int, Array]:
    """True poses [4, 4] by position in `times_s`, of the times that have one."""
    assert recording.ground_truth is not None, f"{recording.name} has no ground truth"
    poses = [recording.ground_truth.at(time_s) for time_s in times_s]
    return {number: pose for number, pose in enumerate(poses) if pose is not None}
