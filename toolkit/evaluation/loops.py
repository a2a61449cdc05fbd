"""How well loops are found: precision, recall and F1 against true poses.

Two frames are a true loop where they are farther apart in time than the detector's own gap,
their camera centres are closer than tau, and their views overlap, for back to back nothing can
be recognised. A candidate is right if its two frames are a true loop. Most true loops are never
searched for, as the detector searches at every n-th keyframe alone; so the headline recall is
over the searched keyframes that have a true loop before them.

G cuts the sequence into intervals of 10 frames: two intervals are a true loop where every
admissible pair of their frames is close (here their views must overlap by as much on average),
and a candidate is right if its frames lie in such intervals. A camera that moves tau within an
interval has no loop by that rule, so these figures stand beside the headline.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from toolkit.evaluation.metrics import Metrics
from toolkit.geometry import se3
from toolkit.geometry.camera import Camera
from toolkit.geometry.frustum import in_view

Array = NDArray[np.float64]
Pairs = NDArray[np.bool_]
FramePair = tuple[int, int]

_NEAR_M = 0.1
_CONVENTION = (
    "a true loop: {what} beyond the gap ({frames} frames, {metres:g} m of path), closer than "
    "{tau:g} m{overlap}; precision over accepted candidates, recall over searched keyframes "
    "with a true loop before them"
)
_OVERLAP = ", and each frustum holds {percent:g} % of what the other view observed"
_G_INTERVAL = 10


@dataclass(frozen=True)
class LoopTruthOptions:
    """What is a true loop.

    Attributes:
        max_distance_m: of camera centres (G: tau_loop).
        min_overlap: of the two views, the smaller share of one's observed points in the
            other's frustum; 0 asks for position alone.
        min_gap_frames, min_gap_m: the detector's own gap, along the true path.
        interval: frames that are judged together, 1 for each by itself.
    """

    max_distance_m: float = 0.5
    min_overlap: float = 0.3
    min_gap_frames: int = 30
    min_gap_m: float = 0.5
    interval: int = 1


@dataclass(frozen=True)
class TrueViews:
    """Where the frames of a sequence were, and what they saw.

    Attributes:
        camera: of all frames.
        T_world_camera: [N, 4, 4] true poses by frame index; NaN where there is none.
        points_m: [N, P, 3] observed points in camera coordinates, NaN where missing
            (`toolkit.geometry.frustum.observed_points`).
        far_m: [N] z-depths where the frusta end (`far_depth_m`).

    Raises:
        ValueError: lengths differ.
    """

    camera: Camera
    T_world_camera: Array
    points_m: NDArray
    far_m: Array

    def __post_init__(self) -> None:
        if not len(self.T_world_camera) == len(self.points_m) == len(self.far_m):
            raise ValueError(
                f"poses, points and far ends must be of the same frames, got "
                f"{len(self.T_world_camera)}, {len(self.points_m)} and {len(self.far_m)}"
            )

    def __len__(self) -> int:
        return len(self.far_m)

    def overlaps(self, frame: int, others: NDArray[np.integer]) -> Array:
        """Overlap [M] in [0, 1] of one view with M others, the smaller of both directions."""
        T_frame_others = se3.inverse(self.T_world_camera[frame]) @ self.T_world_camera[others]
        mine, theirs = self.points_m[frame], self.points_m[others]
        seen_there = in_view(
            self.camera,
            _moved(se3.inverse(T_frame_others), mine[None]),
            _NEAR_M,
            self.far_m[others][:, None],
        )
        seen_here = in_view(self.camera, _moved(T_frame_others, theirs), _NEAR_M, self.far_m[frame])
        return np.minimum(_share(seen_there, mine[None]), _share(seen_here, theirs))


@dataclass(frozen=True)
class LoopScore:
    """Counts, and the figures made of them; None where there is nothing to divide by.

    Attributes:
        accepted: candidates that the detector accepted.
        right: of these, those that are a true loop.
        searched: keyframes searched at.
        with_loop: of these, those that have a true loop before them.
        found: of these, those with a right candidate.
        true_intervals: all pairs of intervals, or of frames, that are a true loop.
        found_intervals: of these, those with an accepted candidate.
    """

    accepted: int
    right: int
    searched: int
    with_loop: int
    found: int
    true_intervals: int
    found_intervals: int

    @property
    def precision(self) -> float | None:
        """Share of accepted candidates that are right."""
        return self.right / self.accepted if self.accepted else None

    @property
    def recall(self) -> float | None:
        """Share of searched keyframes with a true loop that found one."""
        return self.found / self.with_loop if self.with_loop else None

    @property
    def recall_of_all(self) -> float | None:
        """Share of all true pairs that were found, searched for or not (G: of intervals)."""
        return self.found_intervals / self.true_intervals if self.true_intervals else None

    @property
    def f1(self) -> float | None:
        """Harmonic mean of precision and recall; 0 where a loop is there and none accepted."""
        if self.recall is None:
            return None
        precision = self.precision or 0.0
        total = precision + self.recall
        return 2.0 * precision * self.recall / total if total else 0.0


def true_intervals(views: TrueViews, options: LoopTruthOptions | None = None) -> Pairs:
    """Which pairs of intervals [I, I] (later, earlier) are a true loop; see the module."""
    options = options or LoopTruthOptions()
    starts = range(0, len(views), options.interval)
    known: Pairs = np.asarray(np.isfinite(views.T_world_camera).all(axis=(1, 2)))
    travelled_m = _travelled_m(views.T_world_camera[:, :3, 3], known)
    truth = np.zeros((len(starts), len(starts)), bool)
    for row, start in enumerate(starts):
        sums = np.zeros((3, len(views)))
        for frame in range(start, min(start + options.interval, len(views))):
            if known[frame]:
                sums += _pairs_of(views, frame, travelled_m, options)
        pairs, close, overlap = np.add.reduceat(sums, starts, axis=1)
        truth[row] = (pairs > 0) & (close == pairs) & (overlap >= options.min_overlap * pairs)
    return truth


def _pairs_of(views: TrueViews, frame: int, travelled_m: Array, options: LoopTruthOptions) -> Array:
    """Which earlier frames are beyond the gap, which of them close, and these ones' overlap.

    Args:
        travelled_m: [N] along the true path, NaN where there is no pose.

    Returns:
        [3, N], the first two being 0 or 1.
    """
    positions_m = views.T_world_camera[:, :3, 3]
    with np.errstate(invalid="ignore"):
        beyond = travelled_m[frame] - travelled_m >= options.min_gap_m
        distance_m = np.linalg.norm(positions_m - positions_m[frame], axis=1)
        close = distance_m < options.max_distance_m
    beyond &= frame - np.arange(len(views)) >= options.min_gap_frames
    close &= beyond
    overlap = np.zeros(len(views))
    if options.min_overlap > 0 and close.any():
        overlap[close] = views.overlaps(frame, np.flatnonzero(close))
    return np.stack([beyond.astype(float), close.astype(float), overlap])


def score_loops(
    views: TrueViews,
    searched: Collection[int],
    accepted: Iterable[FramePair],
    options: LoopTruthOptions | None = None,
) -> LoopScore:
    """Score a detector.

    Args:
        searched: frame indices of the keyframes that loops were searched for.
        accepted: (query, match) frame indices of the accepted candidates, match < query.
        options: what is a true loop; its gap must be the detector's own.

    Raises:
        ValueError: a frame is outside the sequence.
    """
    options = options or LoopTruthOptions()
    pairs = sorted(set(accepted))
    queries = sorted(set(searched))
    _check_frames([*queries, *(frame for pair in pairs for frame in pair)], len(views))
    truth = true_intervals(views, options)
    right = [p for p in pairs if truth[p[0] // options.interval, p[1] // options.interval]]
    with_loop = {q for q in queries if truth[q // options.interval].any()}
    return LoopScore(
        accepted=len(pairs),
        right=len(right),
        searched=len(queries),
        with_loop=len(with_loop),
        found=len(with_loop & {query for query, _ in right}),
        true_intervals=int(truth.sum()),
        found_intervals=len({(q // options.interval, m // options.interval) for q, m in right}),
    )


def loop_metrics(
    views: TrueViews,
    searched: Collection[int],
    accepted: Iterable[FramePair],
    options: LoopTruthOptions | None = None,
) -> Metrics:
    """Figures in percent: the headline, and beside it G's and others.

    Args:
        views, searched, accepted, options: as `score_loops`.

    Returns:
        `loop_precision_percent` and so on; with `_position` for position alone, without
        overlap; with `_intervals` by G's intervals of 10 frames; with both as G has it.
    """
    options = options or LoopTruthOptions()
    pairs = list(accepted)
    alone = replace(options, min_overlap=0.0)
    metrics: Metrics = {
        "loops_searched": len(set(searched)),
        "loops_accepted": len(set(pairs)),
    }
    for suffix, asked in (
        ("", options),
        ("_position", alone),
        ("_intervals", replace(options, interval=_G_INTERVAL)),
        ("_intervals_position", replace(alone, interval=_G_INTERVAL)),
    ):
        score = score_loops(views, searched, pairs, asked)
        figures = {
            "precision": score.precision,
            "recall": score.recall,
            "f1": score.f1,
            "recall_of_all": score.recall_of_all,
        }
        metrics |= {
            f"loop_{name}{suffix}_percent": None if value is None else 100.0 * value
            for name, value in figures.items()
        }
        metrics[f"loops_searched_with_truth{suffix}"] = score.with_loop
        metrics[f"loop_convention{suffix}"] = _convention(asked)
    return metrics


def _convention(options: LoopTruthOptions) -> str:
    percent = 100.0 * options.min_overlap
    intervals = f"two intervals of {options.interval} frames, all pairs of them"
    return _CONVENTION.format(
        what="two frames" if options.interval == 1 else intervals,
        frames=options.min_gap_frames,
        metres=options.min_gap_m,
        tau=options.max_distance_m,
        overlap=_OVERLAP.format(percent=percent) if percent else "",
    )


def _travelled_m(positions_m: Array, known: NDArray[np.bool_]) -> Array:
    """Length of the path up to each frame [N]; over frames without a pose as the crow flies."""
    places = positions_m[known]
    steps = np.linalg.norm(np.diff(places, axis=0, prepend=places[:1]), axis=1)
    travelled = np.full(len(positions_m), np.nan)
    travelled[known] = np.cumsum(steps)
    return travelled


def _moved(T: Array, points_m: NDArray) -> Array:
    """Points [M or 1, P, 3] moved by M motions [M, 4, 4]."""
    return np.asarray(points_m @ np.swapaxes(T[:, :3, :3], 1, 2) + T[:, None, :3, 3])


def _share(seen: Pairs, points_m: NDArray) -> Array:
    """Share [M] of the measured points [M or 1, P, 3] that are seen [M, P]."""
    measured = np.isfinite(points_m[..., 2])
    return (seen & measured).sum(axis=1) / np.maximum(measured.sum(axis=1), 1)


def _check_frames(frames: Collection[int], count: int) -> None:
    if frames and not 0 <= min(frames) <= max(frames) < count:
        raise ValueError(f"frames must be within 0..{count - 1}, got {min(frames)}..{max(frames)}")
