"""Lines about what is stated of a recording and contradicts its images."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from toolkit.datasets.agreement.given_poses import judge_given, sudden_steps
from toolkit.datasets.agreement.intrinsics import estimate_intrinsics
from toolkit.datasets.agreement.labels import label_finding
from toolkit.datasets.agreement.pairs import FramePair, aligned_pair, aligned_pairs
from toolkit.datasets.base import RecordedDataset
from toolkit.datasets.pairing import listed
from toolkit.datasets.pose_convention import judge_convention
from toolkit.datasets.samples import SmallFrames

_SAME_TIME_S = 1e-3
# Fewer frames have too few pairs that begin at different ones; their labels are compared all the
# same.
_MIN_FRAMES = 24


@dataclass(frozen=True)
class Contradictions:
    """What is stated of a recording with depth and contradicted by its images, a line each.

    Attributes:
        convention: about poses of another convention, or of other images; None if they are right.
        others: about labels, and about intrinsics, delay, unit and jumps of poses that are right.
    """

    convention: str | None = None
    others: tuple[str, ...] = ()


def contradictions(dataset: RecordedDataset) -> Contradictions:
    """Compare what is stated of a recording with its images."""
    if dataset.files(0).depth is None:
        return Contradictions()
    frames = SmallFrames(dataset)
    judged = judge_convention(frames)
    if judged is not None and (wrong := judged.verdict()):
        return Contradictions(wrong)
    return Contradictions(others=tuple(_others(dataset, frames)))


def _others(dataset: RecordedDataset, frames: SmallFrames) -> list[str]:
    """With wrong intrinsics, the images do not tell more."""
    enough = len(dataset) >= _MIN_FRAMES
    if not (enough or dataset.label_names):
        return []
    pairs = aligned_pairs(frames)
    labels = label_finding(pairs)
    lines = [labels] if labels else []
    if not enough:
        return lines
    intrinsics = estimate_intrinsics(pairs)
    wrong = None if intrinsics is None else intrinsics.finding(dataset.camera)
    return [*lines, *([wrong] if wrong else _pose_contradictions(dataset, frames, pairs))]


def _pose_contradictions(
    dataset: RecordedDataset, frames: SmallFrames, pairs: list[FramePair]
) -> list[str]:
    given, times_s = dataset.ground_truth, dataset.timestamps_s
    if given is None or len(given) < 2:
        return []
    found, lines = judge_given(pairs, times_s, given), []
    if found.delay_s:
        late = "late" if found.delay_s > 0 else "early"
        lines.append(
            f"the poses are {abs(found.delay_s):.3f} s {late} against the images; correct their "
            f"times, or use --dataset.pose-delay {found.delay_s:.3f}"
        )
    if found.depth_factor != 1.0:
        scale = dataset.recording.depth_scale
        lines.append(
            f"depth and poses are in different units: they agree if depth is multiplied by "
            f"{found.depth_factor:.3f} (depth_scale {scale / found.depth_factor:.5g} instead of "
            f"{scale:.5g}); correct one of them"
        )
    if lines:
        return lines
    jumps = []
    for step in sudden_steps(given):
        both_s = given.timestamps_s[step.index : step.index + 2]
        number = min(int(np.argmin(np.abs(times_s - both_s[0]))), len(times_s) - 2)
        if np.abs(times_s[number : number + 2] - both_s).max() > _SAME_TIME_S:
            continue  # no frames belong to both poses
        pair = aligned_pair(frames, number)
        if pair is not None and step.is_jump(pair):
            jumps.append(dataset.files(number + 1).name)
    if not jumps:
        return []
    return [
        f"{len(jumps)} pose(s) jump although the images move on evenly: {listed(jumps)}; correct "
        f"or remove them"
    ]
