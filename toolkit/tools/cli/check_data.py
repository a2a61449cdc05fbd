"""`semsplat check-data`: read a dataset and report its defects."""

from __future__ import annotations

from collections.abc import Iterable

from tqdm import tqdm

from toolkit.datasets.base import RecordedDataset
from toolkit.datasets.checks import check_recording
from toolkit.datasets.options import DatasetOptions
from toolkit.datasets.registry import describe
from toolkit.datasets.samples import spread_frames
from toolkit.runs.image_side import find_side
from toolkit.tools.cli.programs import CheckDataOptions


def main(options: CheckDataOptions) -> int:
    """Check a dataset and print a report.

    Returns:
        0 if no defects were found, 1 otherwise.

    Raises:
        ToolkitError: the dataset cannot be opened.
    """
    recording = describe(options.kind, options.path, options.topics)
    report = check_recording(recording, options.image_size, _with_progress)
    for line in report.summary:
        print(line)
    dataset = RecordedDataset(recording, options.image_size)
    up = find_side(dataset, spread_frames(dataset), DatasetOptions())
    for line in (*report.notes, *up.notes, *up.findings):
        print(f"note: {line}")
    for line in report.faults:
        print(f"error: {line}")
    print("no errors found" if report.good else f"{len(report.faults)} error(s) found")
    return 0 if report.good else 1


def _with_progress(indices: Iterable[int]) -> Iterable[int]:
    return tqdm(indices, unit="frame", disable=None)
