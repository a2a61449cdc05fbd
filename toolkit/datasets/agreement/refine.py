"""Recordings with the intrinsics that their depth and colour agree with."""

from __future__ import annotations

from dataclasses import replace

from toolkit.base.geometry.camera import Camera
from toolkit.datasets.agreement.intrinsics import IntrinsicsEstimate, estimate_intrinsics
from toolkit.datasets.agreement.pairs import aligned_pairs
from toolkit.datasets.base import RecordedDataset, Recording
from toolkit.datasets.samples import SmallFrames

# Pairs of frames are aligned again with intrinsics that are far from the stated ones.
_ROUNDS = 3


def with_refined_intrinsics(recording: Recording, max_frames: int | None = None) -> Recording:
    """Replace intrinsics that contradict depth and colour; a note of the recording says so.

    Args:
        recording: with depth.
        max_frames: maximum number of frames from the start, or None for all.
    """
    refined = recording
    for _ in range(_ROUNDS):
        frames = SmallFrames(RecordedDataset(refined, max_frames=max_frames))
        found = estimate_intrinsics(aligned_pairs(frames))
        if found is None or not found.noted.any():
            break
        refined = _applied(found, refined)
    return with_intrinsics(recording, refined.camera, refined.distortion)


def with_intrinsics(
    recording: Recording, camera: Camera, distortion: tuple[float, ...] | None
) -> Recording:
    """Replace the stated intrinsics by refined ones; a note of the recording says so."""
    refined = replace(recording, camera=camera, distortion=distortion)
    return replace(refined, notes=(*recording.notes, _note(recording, refined)))


def _applied(found: IntrinsicsEstimate, recording: Recording) -> Recording:
    """A recording with estimated intrinsics.

    A correction of the distortion adds to the stated one; that is exact only for small ones, which
    is why there are several rounds.
    """
    distortion = recording.distortion
    if found.noted[3]:
        k1, *others = distortion or (0.0,) * 5
        distortion = (k1 + float(found.values[3]), *others)
    return replace(recording, camera=found.applied_to(recording.camera), distortion=distortion)


def _note(stated: Recording, refined: Recording) -> str:
    if refined.camera == stated.camera:
        return "the stated intrinsics agree with depth and colour, and are used"
    (k1, *_) = refined.distortion or (0.0,)
    return (
        f"the intrinsics are refined: {_in_words(refined.camera)} k1={k1:.3f} "
        f"(stated: {_in_words(stated.camera)})"
    )


def _in_words(camera: Camera) -> str:
    return f"fx={camera.fx:.1f} fy={camera.fy:.1f} cx={camera.cx:.1f} cy={camera.cy:.1f}"
