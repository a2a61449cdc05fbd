"""`semsplat check-data`: read a data set and say what is wrong with it."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Sequence

from tqdm import tqdm

from toolkit.cli.arguments import parse_arguments
from toolkit.cli.programs import CheckDataOptions
from toolkit.datasets.checks import check_dataset


def main(argv: Sequence[str]) -> int:
    """Check a data set and print what was found.

    Returns:
        0 if nothing is wrong, 1 otherwise.

    Raises:
        ToolkitError: the data set cannot be opened at all.
    """
    options = parse_arguments(CheckDataOptions, argv, "check-data")
    report = check_dataset(options.kind, options.path, options.image_size, _with_progress)
    for line in report.summary:
        print(line)
    for line in report.notes:
        print(f"note: {line}")
    for line in report.faults:
        print(f"wrong: {line}")
    print("nothing is wrong" if report.good else f"{len(report.faults)} thing(s) are wrong")
    return 0 if report.good else 1


def _with_progress(indices: Iterable[int]) -> Iterable[int]:
    return tqdm(indices, unit="frame", file=sys.stderr, disable=not sys.stderr.isatty())
