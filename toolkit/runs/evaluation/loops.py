"""Precision, recall and F1 of loop detection against ground-truth poses.

Two frames form a true loop if they are separated by at least the minimum gap of the detector,
their camera centres are closer than tau, and their views overlap: views in opposite directions
cannot be recognised. A candidate is correct if its two frames form a true loop. The detector only
searches at every n-th keyframe, so the main recall is computed over the searched keyframes that
have an earlier true loop.

G divides the sequence into intervals of 10 frames. Two intervals form a true loop if all pairs of
their frames beyond the gap are close (here, the mean overlap of their views must also reach the
minimum), and a candidate is correct if its frames lie in such intervals. Intervals in which the
camera moves by tau cannot form a loop by this rule, so these metrics are reported in addition.

Comparing all frames takes time and memory with the square of their number. In long sequences, only
some frames are compared (`run_loops`); recall is then over some of the searched
keyframes, and there are no metrics over all pairs or intervals.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toolkit.base.geometry import se3
from toolkit.base.geometry.camera import Camera
from toolkit.base.geometry.frustum import in_view, near_plane_m
from toolkit.runs.evaluation.metrics import Metrics

Array = NDArray[np.float64]
Pairs = NDArray[np.bool_]
FramePair = tuple[int, int]

_CONVENTION = (
    "a true loop: {what} beyond the gap ({frames} frames, {metres:g} m of path), closer than "
    "{tau:g} m{overlap}; precision over accepted candidates, recall over searched keyframes "
    "with a true loop before them"
)
_OVERLAP = ", and each frustum holds {percent:g} % of what the other view observed"
_G_INTERVAL = 10


@dataclass(frozen=True)
class LoopTruthOptions:
    """Definition of a true loop.

    Attributes:
        max_distance_m: maximum distance of the camera centres (G: tau_loop).
        min_overlap: minimum overlap of the views: the smaller of the two fractions of observed
            points of one view inside the frustum of the other; 0 to ignore overlap.
        min_gap_frames, min_gap_m: minimum gap of the detector, in frames and along the true path.
        interval: number of frames per interval; 1 to compare single frames.
    """

    max_distance_m: float = 0.5
    min_overlap: float = 0.3
    min_gap_frames: int = 30
    min_gap_m: float = 0.5
    interval: int = 1


@dataclass(frozen=True)
class TrueViews:
    """Ground-truth poses and observed points of the frames of a sequence.

    Attributes:
        camera: intrinsics of all frames.
        T_world_camera: [N, 4, 4] ground-truth poses by frame index; NaN where missing.
        points_m: [N, P, 3] observed points in camera coordinates, NaN where missing
            (`toolkit.base.geometry.frustum.observed_points`).
        far_m: [N] z-depths of the far planes of the frusta (`far_depth_m`).
        timestamps_s: [N] times of the frames; only pose errors of edges need them.
        rows: [N] row of each frame in `points_m` and `far_m`, which contain some frames only; -1
            for the others, which have no pose. None if they contain all frames.

    Raises:
        ValueError: lengths differ.
    """

    camera: Camera
    T_world_camera: Array
    points_m: NDArray
    far_m: Array
    timestamps_s: Array | None = None
    rows: NDArray[np.int64] | None = None

    def __post_init__(self) -> None:
        count = len(self) if self.rows is None else int((self.rows >= 0).sum())
        if not count == len(self.points_m) == len(self.far_m):
            raise ValueError(
                f"poses, points and far depths must be of the same frames, got "
                f"{count}, {len(self.points_m)} and {len(self.far_m)}"
            )

    def __len__(self) -> int:
        return len(self.T_world_camera)

    def observed(self, frames: Any) -> tuple[NDArray, Array]:
        """Points [..., P, 3] and far planes [...] of frames [...] that are contained."""
        rows = frames if self.rows is None else self.rows[frames]
        return self.points_m[rows], self.far_m[rows]

    def overlaps(self, frame: int, others: NDArray[np.integer]) -> Array:
        """Return the overlap [M] in [0, 1] of one view with M others.

        It is the smaller of the fractions of points of one view visible in the other.
        """
        T_frame_others = se3.inverse(self.T_world_camera[frame]) @ self.T_world_camera[others]
        frame_points, frame_far_m = self.observed(frame)
        other_points, others_far_m = self.observed(others)
        in_others = in_view(
            self.camera,
            _transformed(se3.inverse(T_frame_others), frame_points[None]),
            near_plane_m(others_far_m)[:, None],
            others_far_m[:, None],
        )
        far_m = float(frame_far_m)
        near_m = near_plane_m(far_m)
        in_frame = in_view(self.camera, _transformed(T_frame_others, other_points), near_m, far_m)
        return np.minimum(
            _visible_fraction(in_others, frame_points[None]),
            _visible_fraction(in_frame, other_points),
        )


@dataclass(frozen=True)
class LoopScore:
    """Counts and the metrics derived from them; None where the denominator is zero.

    Attributes:
        accepted: number of candidates accepted by the detector.
        correct: number of accepted candidates that are true loops.
        with_loop: number of searched keyframes with an earlier true loop.
        found: number of these with a correct candidate.
        true_intervals: number of pairs of intervals, or of frames, that form a true loop.
        found_intervals: number of these with an accepted candidate.
    """

    accepted: int
    correct: int
    with_loop: int
    found: int
    true_intervals: int
    found_intervals: int

    @property
    def precision(self) -> float | None:
        """Fraction of the accepted candidates that are correct."""
        return self.correct / self.accepted if self.accepted else None

    @property
    def recall(self) -> float | None:
        """Fraction of the searched keyframes with a true loop for which a loop was found."""
        return self.found / self.with_loop if self.with_loop else None

    @property
    def recall_of_all(self) -> float | None:
        """Fraction of all true pairs that were found, searched or not (G: pairs of intervals)."""
        return self.found_intervals / self.true_intervals if self.true_intervals else None

    @property
    def f1(self) -> float | None:
        """Harmonic mean of precision and recall; 0 if no loop was accepted although one exists."""
        if self.recall is None:
            return None
        precision = self.precision or 0.0
        total = precision + self.recall
        return 2.0 * precision * self.recall / total if total else 0.0


def true_intervals(views: TrueViews, options: LoopTruthOptions | None = None) -> Pairs:
    """Return a mask [I, I] of the pairs of intervals (later, earlier) that form a true loop.

    The module's docstring defines true loops.
    """
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


def _pairs_of(
    views: TrueViews,
    frame: int,
    travelled_m: Array,
    options: LoopTruthOptions,
    among: NDArray[np.bool_] | None = None,
) -> Array:
    """Compare a frame with all earlier frames.

    Args:
        travelled_m: [N] distance along the true path, NaN for frames without a pose.
        among: [N] frames to compare with; all by default.

    Returns:
        [3, N]: whether a frame is beyond the gap (0 or 1), whether it is also close (0 or 1),
        and its overlap if it is close.
    """
    positions_m = views.T_world_camera[:, :3, 3]
    with np.errstate(invalid="ignore"):
        beyond = travelled_m[frame] - travelled_m >= options.min_gap_m
        distance_m = np.linalg.norm(positions_m - positions_m[frame], axis=1)
        close = distance_m < options.max_distance_m
    beyond &= frame - np.arange(len(views)) >= options.min_gap_frames
    close &= beyond
    if among is not None:
        close &= among
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
    """Count correct and missed loops of a detector.

    Args:
        searched: frame indices of the keyframes at which loops were searched.
        accepted: (query, match) frame indices of the accepted candidates, match < query.
        options: definition of a true loop; its gap must be that of the detector.

    Raises:
        ValueError: a frame is outside the sequence.
    """
    options = options or LoopTruthOptions()
    pairs = sorted(set(accepted))
    queries = sorted(set(searched))
    _check_frames([*queries, *(frame for pair in pairs for frame in pair)], len(views))
    if views.rows is not None:
        return _score_of_some(views, queries, pairs, options)
    truth = true_intervals(views, options)
    correct = [p for p in pairs if truth[p[0] // options.interval, p[1] // options.interval]]
    with_loop = {q for q in queries if truth[q // options.interval].any()}
    return LoopScore(
        accepted=len(pairs),
        correct=len(correct),
        with_loop=len(with_loop),
        found=len(with_loop & {query for query, _ in correct}),
        true_intervals=int(truth.sum()),
        found_intervals=len({(q // options.interval, m // options.interval) for q, m in correct}),
    )


class TrueMatches:
    """The true loops of single frames, without comparing all pairs of frames."""

    def __init__(self, views: TrueViews, options: LoopTruthOptions | None = None) -> None:
        self._views, self._options = views, options or LoopTruthOptions()
        self._known: Pairs = np.asarray(np.isfinite(views.T_world_camera).all(axis=(1, 2)))
        self._travelled_m = _travelled_m(views.T_world_camera[:, :3, 3], self._known)

    def of(self, frame: int, among: Pairs | None = None) -> Pairs:
        """Mask [N] of the earlier frames that form a true loop with one.

        Args:
            among: [N] frames to compare with; all by default.
        """
        if not self._known[frame]:
            return np.zeros(len(self._views), bool)
        among = self._known if among is None else self._known & among
        _, close, overlap = _pairs_of(self._views, frame, self._travelled_m, self._options, among)
        return np.asarray((close > 0) & (overlap >= self._options.min_overlap))

    def contain(self, pair: FramePair) -> bool:
        """Whether a later and an earlier frame form a true loop."""
        query, match = pair
        return bool(self.of(query, np.arange(len(self._views)) == match)[match])


def _score_of_some(
    views: TrueViews, queries: list[int], pairs: list[FramePair], options: LoopTruthOptions
) -> LoopScore:
    """As `score_loops`, for views of some frames, which contain all frames of the pairs."""
    truth = TrueMatches(views, options)
    correct = [pair for pair in pairs if truth.contain(pair)]
    with_loop = {query for query in queries if truth.of(query).any()}
    found = len(with_loop & {query for query, _ in correct})
    return LoopScore(len(pairs), len(correct), len(with_loop), found, 0, 0)


def loop_metrics(
    views: TrueViews,
    searched: Collection[int],
    accepted: Iterable[FramePair],
    options: LoopTruthOptions | None = None,
) -> Metrics:
    """Compute loop metrics in percent, by our definition of a true loop and by variants of G's.

    Args:
        views, searched, accepted, options: as in `score_loops`.

    Returns:
        The number of accepted pairs, and a group of metrics for each of `loop_definitions`, except
        those of intervals if the views are of some frames only.
    """
    pairs = list(accepted)
    metrics: Metrics = {"accepted": len(set(pairs))}
    for name, definition in loop_definitions(options).items():
        if views.rows is not None and definition.interval > 1:
            continue
        score = score_loops(views, searched, pairs, definition)
        values = {
            "precision": score.precision,
            "recall": score.recall,
            "f1": score.f1,
            "recall_of_all": score.recall_of_all,
        }
        metrics[name] = {
            f"{key}_percent": None if value is None else 100.0 * value
            for key, value in values.items()
        }
        metrics[name]["searched_with_truth"] = score.with_loop
    return metrics


def loop_definitions(options: LoopTruthOptions | None = None) -> dict[str, LoopTruthOptions]:
    """Definitions of a true loop by name.

    "position" has no criterion of overlap, "intervals" compares intervals of 10 frames, and
    "intervals_position" is G's definition.
    """
    overlap = options or LoopTruthOptions()
    position = replace(overlap, min_overlap=0.0)
    return {
        "overlap": overlap,
        "position": position,
        "intervals": replace(overlap, interval=_G_INTERVAL),
        "intervals_position": replace(position, interval=_G_INTERVAL),
    }


def loop_convention(options: LoopTruthOptions) -> str:
    """Describe a definition of a true loop."""
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
    """Return the path length up to each frame [N], NaN without a pose.

    Gaps of frames without a pose are bridged by straight lines.
    """
    known_m = positions_m[known]
    steps = np.linalg.norm(np.diff(known_m, axis=0, prepend=known_m[:1]), axis=1)
    travelled = np.full(len(positions_m), np.nan)
    travelled[known] = np.cumsum(steps)
    return travelled


def _transformed(T: Array, points_m: NDArray) -> Array:
    """Transform points [M or 1, P, 3] by M transformations [M, 4, 4]."""
    return np.asarray(points_m @ np.swapaxes(T[:, :3, :3], 1, 2) + T[:, None, :3, 3])


def _visible_fraction(visible: Pairs, points_m: NDArray) -> Array:
    """Return the fraction [M] of the measured points [M or 1, P, 3] that are visible [M, P]."""
    measured = np.isfinite(points_m[..., 2])
    return (visible & measured).sum(axis=1) / np.maximum(measured.sum(axis=1), 1)


def _check_frames(frames: Collection[int], count: int) -> None:
    if frames and not 0 <= min(frames) <= max(frames) < count:
        raise ValueError(f"frames must be within 0..{count - 1}, got {min(frames)}..{max(frames)}")
