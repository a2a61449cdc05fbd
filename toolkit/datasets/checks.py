"""Check all frames of a dataset and report defects."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np

from toolkit.base.errors import ToolkitError
from toolkit.base.frame import Frame
from toolkit.datasets.agreement.findings import contradictions
from toolkit.datasets.base import RecordedDataset, Recording
from toolkit.datasets.carrier import without_carrier
from toolkit.datasets.depth_offset import OFFSET_FRAMES, estimate_depth_offset
from toolkit.datasets.depth_samples import with_usable_depth
from toolkit.datasets.findings import (
    depth_faults,
    depth_scale_finding,
    is_impossible_depth,
    length,
)
from toolkit.datasets.pairing import listed
from toolkit.datasets.samples import evenly_spaced, readable, spread_frames
from toolkit.datasets.shutter.recording import estimate_readout
from toolkit.datasets.times import unit_fault
from toolkit.io.process_streams import STDERR, diverted

# Minimum fraction of pixels with valid depth that tracking needs.
_MIN_VALID_FRACTION = 0.01
# Offsets of colour from depth are noted from this size, in pixels and in standard errors.
_NOTED_OFFSET_PX, _CERTAIN = 0.4, 3.0
# Pauses between frames are noted from this time in seconds, and this multiple of the usual one.
_PAUSE_S, _PAUSE_FRAMES = 1.0, 5.0
# Maximum number of unreadable frames that are listed; the rest are counted.
_NAMED_FAILURES = 5


@dataclass(frozen=True)
class CheckReport:
    """Result of a dataset check.

    Attributes:
        summary: a few lines that describe the dataset.
        faults: one line per defect; empty if there are none.
        notes: remarks about properties that are common in this format.
    """

    summary: tuple[str, ...]
    faults: tuple[str, ...]
    notes: tuple[str, ...]

    @property
    def good(self) -> bool:
        """Whether no defects were found."""
        return not self.faults


@dataclass
class _Findings:
    """Findings accumulated over the frames."""

    failures: list[str] = field(default_factory=list)
    empty: list[str] = field(default_factory=list)
    sparse: list[str] = field(default_factory=list)
    blank: list[str] = field(default_factory=list)
    damaged: list[str] = field(default_factory=list)
    medians_m: list[float] = field(default_factory=list)
    valid_fractions: list[float] = field(default_factory=list)
    label_ids: set[int] = field(default_factory=set)
    repeated_colour: set[str] = field(default_factory=set)
    repeated_depth: set[str] = field(default_factory=set)
    before: Frame | None = None


def check_recording(
    recording: Recording,
    image_size: tuple[int, int] | None = None,
    watch: Callable[[Iterable[int]], Iterable[int]] = iter,
) -> CheckReport:
    """Read every frame of a recording and report defects.

    Args:
        recording: from `registry.describe`.
        image_size: (width, height) in pixels to resize to, as in a run, or None.
        watch: wraps the iterable of frame indices to show progress.

    Raises:
        DatasetError: the recording has no frames.
    """
    recording = without_carrier(with_usable_depth(recording))
    dataset = RecordedDataset(recording, image_size)
    findings = _Findings()
    for index in watch(range(len(dataset))):
        _check_frame(dataset, index, findings)
    agreement = contradictions(dataset)
    faults = [
        *dataset.recording.flaws,
        *([recording.depth_fault] if recording.depth_fault else []),
        *_time_faults(dataset),
        *_frame_faults(findings),
        *_label_faults(findings, dataset.label_names),
        *depth_faults([*spread_frames(dataset)]),
        *([agreement.convention] if agreement.convention else agreement.others),
    ]
    scale = depth_scale_finding(findings.medians_m, dataset.recording.depth_scale)
    if scale and is_impossible_depth(findings.medians_m):
        faults.append(scale)
        scale = None
    notes = (
        *([scale] if scale else []),
        *dataset.recording.notes,
        *_time_notes(dataset),
        *_repeat_notes(findings),
        *_offset_notes(dataset),
    )
    summary = (*_summary(dataset, findings), *_shutter_lines(recording))
    return CheckReport(summary, tuple(faults), notes)


def _check_frame(dataset: RecordedDataset, index: int, findings: _Findings) -> None:
    files = dataset.files(index)
    try:
        frame = dataset[index]
    except ToolkitError as error:
        findings.failures.append(f"frame {index}: {error}")
        return
    if files.number is None and decoder_warning(files.rgb):
        findings.damaged.append(files.name)
    _check_repeats(frame, files.name, findings)
    if float(np.ptp(frame.rgb)) == 0.0:
        findings.blank.append(files.name)
    if files.depth is not None:
        _check_depth(frame, files.depth.name, findings)
    if frame.labels is not None:
        findings.label_ids.update(np.unique(frame.labels).tolist())


def _check_repeats(frame: Frame, name: str, findings: _Findings) -> None:
    before, findings.before = findings.before, frame
    if before is None:
        return
    if np.ptp(frame.rgb) > 0.0 and np.array_equal(before.rgb, frame.rgb):
        findings.repeated_colour.add(name)
    if frame.depth_m.any() and np.array_equal(before.depth_m, frame.depth_m):
        findings.repeated_depth.add(name)


def _check_depth(frame: Frame, name: str, findings: _Findings) -> None:
    valid = frame.depth_m[frame.depth_m > 0]
    fraction = valid.size / frame.depth_m.size
    findings.valid_fractions.append(fraction)
    if valid.size == 0:
        findings.empty.append(name)
    else:
        findings.medians_m.append(float(np.median(valid)))
        if fraction < _MIN_VALID_FRACTION:
            findings.sparse.append(name)


def _time_faults(dataset: RecordedDataset) -> list[str]:
    faults = []
    if len(dataset) == 1:
        faults.append("the dataset has only one frame; tracking needs at least two")
    backwards = np.flatnonzero(np.diff(dataset.timestamps_s) <= 0) + 1
    if backwards.size:
        names = [dataset.files(int(i)).name for i in backwards]
        faults.append(f"timestamps out of order at {listed(names)}; sort the list of images")
    if fault := unit_fault(dataset.timestamps_s):
        faults.append(fault)
    return faults


def _time_notes(dataset: RecordedDataset) -> list[str]:
    """Return a line about pauses in which the camera may have moved anywhere."""
    steps_s = np.diff(dataset.timestamps_s)
    if len(steps_s) < 2:
        return []
    usual_s = float(np.median(steps_s))
    pauses = np.flatnonzero(steps_s > max(_PAUSE_S, _PAUSE_FRAMES * usual_s)) + 1
    if not pauses.size:
        return []
    longest_s = float(steps_s.max())
    names = [dataset.files(int(i)).name for i in pauses]
    return [
        f"{pauses.size} pause(s) of up to {longest_s:.1f} s before {listed(names)}, frames are "
        f"usually {1e3 * usual_s:.0f} ms apart; a camera that moved meanwhile may be lost there"
    ]


def _frame_faults(findings: _Findings) -> list[str]:
    faults = findings.failures[:_NAMED_FAILURES]
    rest = len(findings.failures) - len(faults)
    if rest > 0:
        faults.append(f"{rest} more frame(s) cannot be read")
    for names, what in (
        (findings.damaged, "colour image(s) are corrupt (decoder warnings); copy them again"),
        (findings.blank, "colour image(s) are blank; remove these frames"),
        (findings.empty, "depth image(s) are empty (every pixel missing); remove these frames"),
        (
            findings.sparse,
            f"depth image(s) have depth in less than {_MIN_VALID_FRACTION:.0%} of their pixels; "
            f"check how depth was saved",
        ),
    ):
        if names:
            faults.append(f"{len(names)} {what}: {listed(names)}")
    return faults


def _label_faults(findings: _Findings, names: dict[int, str] | None) -> list[str]:
    if findings.label_ids == {0}:
        return ["all labels are void (0), so the map will have none; check how they were saved"]
    unknown = sorted(findings.label_ids - {0} - set(names or {}))
    if names is None or not unknown:
        return []
    return [
        f"labels contain class ids that are missing in classes.json: {listed([*map(str, unknown)])}"
    ]


def _repeat_notes(findings: _Findings) -> list[str]:
    colour, depth = findings.repeated_colour, findings.repeated_depth
    notes = []
    if colour | depth:
        notes.append(
            f"{len(colour)} colour and {len(depth)} depth image(s) are those of the frame before; "
            f"the times of these frames are wrong: {listed(sorted(colour | depth))}"
        )
    if depth and colour ^ depth:
        notes.append(
            f"in {len(colour ^ depth)} frame(s), only one of colour and depth is repeated; both "
            f"were taken at different times: {listed(sorted(colour ^ depth))}"
        )
    return notes


def _offset_notes(dataset: RecordedDataset) -> list[str]:
    found = estimate_depth_offset(
        readable(dataset.__getitem__, evenly_spaced(len(dataset), OFFSET_FRAMES))
    )
    size_px = float(np.hypot(found.x_px, found.y_px))
    if found.fault is not None or size_px < max(_NOTED_OFFSET_PX, _CERTAIN * found.sigma_px):
        return []
    return [f"colour is offset from depth by {found}; --dataset.depth-offset auto shifts the depth"]


def _shutter_lines(recording: Recording) -> list[str]:
    if recording.files[0].depth is None or recording.depth_fault:
        return []
    return [f"rolling shutter: {estimate_readout(recording)}"]


def _summary(dataset: RecordedDataset, findings: _Findings) -> tuple[str, ...]:
    camera, truth = dataset.camera, dataset.ground_truth
    duration_s = float(np.ptp(dataset.timestamps_s))
    lines = [
        f"{dataset.name}: {len(dataset)} frames over {duration_s:.1f} s, "
        f"{camera.width}x{camera.height}, f {camera.fx:.1f} {camera.fy:.1f}, "
        f"c {camera.cx:.1f} {camera.cy:.1f}",
        f"ground truth: {truth}" if truth is not None else "ground truth: none",
    ]
    if findings.medians_m:
        lines.append(
            f"depth: median {length(float(np.median(findings.medians_m)))}, "
            f"{np.mean(findings.valid_fractions):.0%} of the pixels"
        )
    elif dataset.files(0).depth is None:
        lines.append("depth: none; run with --depth none")
    if dataset.label_names:
        lines.append(
            f"labels: {len(findings.label_ids - {0})} of {len(dataset.label_names)} classes occur"
        )
    return tuple(lines)


def decoder_warning(path: Path) -> str:
    """Return the decoder's warnings about a file; empty if it is intact or not a JPEG.

    The stderr of the process is redirected meanwhile, so this must not be called while other
    threads write to it.
    """
    if path.suffix.lower() not in (".jpg", ".jpeg"):
        return ""
    with tempfile.TemporaryFile() as printed:
        with diverted([STDERR], printed.fileno()):
            cv2.imread(os.fsencode(path), cv2.IMREAD_COLOR)
        printed.seek(0)
        return printed.read().decode("utf-8", "replace").strip()
