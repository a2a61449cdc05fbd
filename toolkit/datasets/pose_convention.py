"""The convention of given poses, judged by the images.

Poses may have other camera axes than ours (right, down, forward), be inverted (world to camera),
left-handed, in another unit, or have quaternions in another order. The numbers look the same. But
points of one frame, moved by right poses, have the depth and the colour of another frame there;
this is compared for every convention.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from toolkit.base.frame import Frame
from toolkit.base.geometry import se3
from toolkit.base.geometry.trajectory import Trajectory
from toolkit.datasets.samples import GAPS, SmallFrames

Array = NDArray[np.float64]

# Frames of the longest gap may show other parts of the scene. From so many frames on, those are
# compared that other checks read as well, which are not at the end of the recording.
_GAPS, _LONG = GAPS[:-1], 60
_POINTS = 200
# Depths agree within this share, which is beyond a sensor's noise.
_DEPTH_TOLERANCE = 0.05
_SCALES = 10.0 ** np.arange(-3.6, 3.7, 0.2)
_FINE = 10.0 ** np.linspace(-0.1, 0.1, 21)
_UNITS = {1e-3: "millimetres", 1e-2: "centimetres", 1e-1: "decimetres", 1e3: "kilometres"}
_ROBOT = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


@dataclass(frozen=True, eq=False)
class PoseConvention:
    """How given poses are to be read.

    Attributes:
        axes: [3, 3] signed permutation; its columns are right, down and forward in the axes of
            the given cameras. Its determinant is -1 for left-handed coordinates.
        inverted: whether poses are from world to camera.
        scale: metres per unit.
        scalar_first: whether quaternions w x y z were read as x y z w.
    """

    axes: Array
    inverted: bool = False
    scale: float = 1.0
    scalar_first: bool = False

    @property
    def is_ours(self) -> bool:
        """Whether poses can be used as they are."""
        plain = not self.inverted and not self.scalar_first and self.scale == 1.0
        return plain and np.array_equal(self.axes, np.eye(3))

    def __str__(self) -> str:
        words = []
        if self.scalar_first:
            words.append("the order of the quaternions is w x y z instead of x y z w")
        if self.inverted:
            words.append("the poses are from world to camera (inverted)")
        if not np.array_equal(self.axes, np.eye(3)):
            words.append(f"the axes of the cameras are {_axes_in_words(self.axes)}")
        if self.scale != 1.0:
            unit = _UNITS.get(self.scale, f"units of {self.scale:.3g} m")
            words.append(f"positions are in {unit}")
        return " and ".join(words)

    def applied(self, trajectory: Trajectory) -> Trajectory:
        """Poses in our convention; the world of left-handed ones is mirrored."""
        poses = np.array(trajectory.T_world_camera)
        if self.scalar_first:
            poses = np.array([_scalar_moved(pose) for pose in poses])
        if self.inverted:
            poses = np.array([se3.inverse(pose) for pose in poses])
        poses[:, :3, :3] = poses[:, :3, :3] @ self.axes
        poses[:, :3, 3] *= self.scale
        if np.linalg.det(self.axes) < 0:
            poses[:, :3] = self.axes.T @ poses[:, :3]
        return Trajectory(trajectory.timestamps_s, poses)


def motions(
    conventions: Sequence[PoseConvention], T_world_first: Array, T_world_second: Array
) -> Array:
    """T_second_first [H, 4, 4] of two given poses by conventions.

    Their quaternions are in the usual order, also for `scalar_first`.
    """
    axes, scales, inverted = (
        np.array([getattr(c, name) for c in conventions]) for name in ("axes", "scale", "inverted")
    )
    usual = se3.inverse(T_world_second) @ T_world_first
    other = T_world_second @ se3.inverse(T_world_first)
    T_second_first = np.where(inverted[:, None, None], other, usual)
    T_second_first[:, :3] = np.swapaxes(axes, 1, 2) @ T_second_first[:, :3]
    T_second_first[:, :3, :3] = T_second_first[:, :3, :3] @ axes
    T_second_first[:, :3, 3] *= scales[:, None]
    return T_second_first


OURS = PoseConvention(np.eye(3))


@dataclass(frozen=True)
class ConventionReport:
    """What the images say about given poses.

    Attributes:
        found: the convention that agrees with the images; None if none does.
        given, best, still: [0, 1] agreement of the poses as they are, of the best convention, and
            of a camera that does not move.
    """

    found: PoseConvention | None
    given: float
    best: float
    still: float

    def verdict(self) -> str | None:
        """A line about the contradiction, or None without one."""
        if self.found is None:
            return (
                "the given poses contradict depth and colour, whatever their axes, direction or "
                "unit; check that they belong to these images and are in their order"
            )
        if self.found.is_ours:
            return None
        return f"the given poses contradict depth and colour, which agree if {self.found}"


# On four real recordings and five rooms, right poses agree as well as every other convention up to
# 1 %, wrong ones by at most 0.9 of the best.
_AS_GOOD = 0.92
# The best convention gains this share of what a camera without motion lacks to full agreement.
# Right ones gain 0.42 to 0.75; poses of other images, or in another order, at most 0.28.
# Images that look the same without motion tell no convention.
_MIN_GAIN, _LEAST_GAIN = 0.35, 0.02
# Frames that agree by so much without any motion show the same scene.
_COMPARABLE = 0.15
# Poses by which the second frame sees less than this share of the points count as if it saw that.
_MIN_SEEN = 0.5
# A unit that agrees as well as the best scale up to this share is taken for the right one.
_SAME_AGREEMENT = 0.985


def judge_convention(frames: SmallFrames) -> ConventionReport | None:
    """Compare the poses of a recording with its depth and colour.

    Returns:
        None without poses, depth or pairs of frames that show the same scene.
    """
    pairs = [pair for pair in _pairs(frames) if pair is not None]
    if not pairs:
        return None
    conventions = list(all_conventions())
    scaled = [replace(OURS, scale=float(s)) for s in _SCALES]
    likely = _agreement(pairs, [OURS, *conventions, *scaled])
    given, still = float(likely[0]), _still_agreement(pairs)
    if given >= _AS_GOOD * max(float(likely.max()), still):
        return ConventionReport(OURS, given, float(likely.max()), still)
    every = [*conventions, *scaled]
    every += [replace(c, scale=unit) for c in conventions for unit in _UNITS]
    every += [replace(c, scale=float(s)) for c in conventions if _is_usual(c) for s in _SCALES]
    scores = _agreement(pairs, every)
    found, best = every[int(scores.argmax())], float(scores.max())
    if found.scale != 1.0:
        found, best = _with_fine_scale(pairs, found)
    usual = [c for c in conventions if _is_usual(c)]
    scores = _agreement([pair.with_scalar_moved() for pair in pairs], usual)
    # Quaternions in the wrong order may resemble another convention in small motions.
    if _SAME_AGREEMENT * scores.max() > best:
        found, best = replace(usual[int(scores.argmax())], scalar_first=True), float(scores.max())
    if best - still >= max(_MIN_GAIN * (1.0 - still), _LEAST_GAIN):
        return ConventionReport(found, given, best, still)
    # A camera that moves forward leaves parts behind, which are no contradiction.
    seen = float(_agreement(pairs, [OURS], of_seen=True)[0])
    if still >= _COMPARABLE and seen < _AS_GOOD * still:
        return ConventionReport(None, given, best, still)
    return None


@dataclass(frozen=True)
class _Pair:
    """Points of one frame, and another one that may see them.

    Attributes:
        points: [N, 3] in the first camera. intensities: [N].
        frame: the other one. image: its intensities [H, W].
        T_world_first, T_world_second: given poses.
    """

    points: Array
    intensities: Array
    frame: Frame
    image: Array
    T_world_first: Array
    T_world_second: Array

    def with_scalar_moved(self) -> _Pair:
        """The pair with the quaternions of its poses in another order, see `_scalar_moved`."""
        first, second = _scalar_moved(self.T_world_first), _scalar_moved(self.T_world_second)
        return replace(self, T_world_first=first, T_world_second=second)


def _scalar_moved(T: Array) -> Array:
    """The pose [4, 4] that a quaternion w x y z describes, of one that was read as x y z w."""
    w, x, y, z = se3.quaternion_xyzw(T[:3, :3])
    R = se3.rotation_from_quaternion_xyzw(np.array([x, y, z, w]))
    return se3.from_rotation_translation(R, T[:3, 3])


def _pairs(frames: SmallFrames) -> Iterator[_Pair | None]:
    # An origin must not be subtracted from poses that may be inverted.
    truth = frames.dataset.recording.ground_truth
    if truth is None or frames.dataset.files(0).depth is None:
        return
    for anchor in frames.anchors(GAPS[-1] if len(frames) >= _LONG else _GAPS[-1]):
        first = _posed(frames, truth, anchor)
        if first is None:
            continue
        for gap in _GAPS:
            second = _posed(frames, truth, anchor + gap)
            if second is not None:
                yield _pair(*first, *second)


def _posed(frames: SmallFrames, truth: Trajectory, index: int) -> tuple[Frame, Array] | None:
    frame = frames.get(index)
    T_world_camera = None if frame is None else truth.at(frame.timestamp_s)
    return None if frame is None or T_world_camera is None else (frame, T_world_camera)


def _pair(first: Frame, T_world_first: Array, second: Frame, T_world_second: Array) -> _Pair | None:
    rows, columns = np.nonzero(first.depth_m)
    if not rows.size or not second.depth_m.any():
        return None
    chosen = np.linspace(0, rows.size - 1, min(rows.size, _POINTS)).astype(int)
    rows, columns = rows[chosen], columns[chosen]
    camera, z = first.camera, first.depth_m[rows, columns].astype(np.float64)
    x, y = (columns - camera.cx) / camera.fx * z, (rows - camera.cy) / camera.fy * z
    return _Pair(
        np.stack([x, y, z], axis=1),
        _intensities(first)[rows, columns],
        second,
        _intensities(second),
        T_world_first,
        T_world_second,
    )


def _intensities(frame: Frame) -> Array:
    grey = frame.rgb.mean(axis=2).astype(np.float32)
    return cv2.GaussianBlur(grey, (0, 0), 1.0).astype(np.float64)


def _agreement(
    pairs: Iterable[_Pair], conventions: list[PoseConvention], of_seen: bool = False
) -> Array:
    """Agreement [H] of conventions with the images, mean over pairs; see `_pair_agreement`."""
    scores = []
    for pair in pairs:
        T_second_first = motions(conventions, pair.T_world_first, pair.T_world_second)
        R, t = T_second_first[:, :3, :3], T_second_first[:, :3, 3]
        scores.append(_pair_agreement(pair, R, t, of_seen))
    return np.mean(scores, axis=0)


def _still_agreement(pairs: Iterable[_Pair]) -> float:
    R, t = np.eye(3)[None], np.zeros((1, 3))
    return float(np.mean([_pair_agreement(pair, R, t)[0] for pair in pairs]))


def _pair_agreement(pair: _Pair, R: Array, t: Array, of_seen: bool = False) -> Array:
    """Agreement [H] of motions: share of points with the right depth, times their correlation.

    Args:
        of_seen: the share of those that the second frame should see, if these are not too few.
    """
    x, y, z = np.moveaxis(R @ pair.points.T + t[:, :, None], 1, 0)
    camera = pair.frame.camera
    before = z > 1e-9
    z = np.where(before, z, 1.0)
    u = np.clip(camera.fx * x / z + camera.cx, -1e6, 1e6)
    v = np.clip(camera.fy * y / z + camera.cy, -1e6, 1e6)
    columns, rows = np.rint(u).astype(int), np.rint(v).astype(int)
    inside = before & (columns >= 0) & (columns < camera.width) & (rows >= 0)
    inside &= rows < camera.height
    columns, rows = np.where(inside, columns, 0), np.where(inside, rows, 0)
    depth_m = pair.frame.depth_m[rows, columns]
    inside &= depth_m > 0
    possible = np.maximum(inside.mean(axis=1), _MIN_SEEN) if of_seen else 1.0
    agrees = inside & (np.abs(z - depth_m) < _DEPTH_TOLERANCE * depth_m)
    share = agrees.mean(axis=1) / possible
    correlation = _correlation(pair.intensities, pair.image[rows, columns], agrees)
    return share * np.maximum(correlation, 0.0)


def _correlation(first: Array, second: Array, mask: NDArray[np.bool_]) -> Array:
    """Normalised correlation [H] of values [N] and [H, N] where `mask` [H, N]."""
    count = np.maximum(mask.sum(axis=1, keepdims=True), 1)
    a = np.where(mask, first - (first * mask).sum(axis=1, keepdims=True) / count, 0.0)
    b = np.where(mask, second - (second * mask).sum(axis=1, keepdims=True) / count, 0.0)
    norm = np.sqrt((a**2).sum(axis=1) * (b**2).sum(axis=1))
    return (a * b).sum(axis=1) / np.maximum(norm, 1e-12)


def _with_fine_scale(pairs: list[_Pair], found: PoseConvention) -> tuple[PoseConvention, float]:
    candidates = [replace(found, scale=float(found.scale * s)) for s in _FINE]
    candidates += [replace(found, scale=unit) for unit in (*_UNITS, 1.0)]
    scores = _agreement(pairs, candidates)
    best = float(scores.max())
    # The units come last.
    chosen = int(np.flatnonzero(scores >= _SAME_AGREEMENT * best)[-1])
    is_unit = chosen >= len(_FINE)
    return candidates[chosen if is_unit else int(scores.argmax())], best


def _is_usual(convention: PoseConvention) -> bool:
    """Whether a convention may occur with any scale: ours, that of OpenGL, or of robots."""
    usual = (np.eye(3), np.diag([1.0, -1.0, -1.0]), _ROBOT)
    return any(np.array_equal(convention.axes, axes) for axes in usual)


def all_conventions() -> Iterator[PoseConvention]:
    """Every convention in metres; ours is among the first."""
    for inverted in (False, True):
        for axes in _all_axes():
            yield PoseConvention(axes, inverted)


def _all_axes() -> Iterator[Array]:
    """The 48 signed permutations."""
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            yield np.eye(3)[:, order] * signs


def _axes_in_words(axes: Array) -> str:
    directions = (("right", "left"), ("down", "up"), ("forward", "backward"))
    words = []
    for name, row in zip("xyz", axes, strict=True):
        ours = int(np.abs(row).argmax())
        words.append(f"{name} {directions[ours][int(row[ours] < 0)]}")
    known = {
        (1.0, -1.0, -1.0): " (OpenGL, Blender, ARKit)",
        (1.0, -1.0, 1.0): " (left-handed, as in Unity)",
    }
    name = known.get(tuple(np.diag(axes)), "") if np.array_equal(np.abs(axes), np.eye(3)) else ""
    handed = " (left-handed)" if not name and np.linalg.det(axes) < 0 else ""
    return ", ".join(words) + name + handed
