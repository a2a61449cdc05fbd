"""Evaluate a finished run: trajectory error and image quality.

    python apps/04_evaluate.py runs/demo

Prints the metrics and the position error of the worst frame. Needs the dataset with ground truth.
"""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np

import toolkit
from toolkit.base.errors import DatasetError
from toolkit.runs.evaluation.metrics import flattened
from toolkit.runs.evaluation.trajectory import absolute_trajectory_error
from toolkit.tools.cli.errors import one_line_errors


def main(run_folder: Path) -> int:
    """Print the metrics of a run."""
    run = toolkit.load_run(run_folder)
    truth = run.open_dataset().ground_truth
    if truth is None:
        raise DatasetError(f"the dataset of {run_folder} has no ground-truth trajectory")
    for name, value in flattened(toolkit.evaluate(run, max_views=20)).items():
        if value is not None:
            print(f"{name:<44}{value:.3f}" if isinstance(value, float) else f"{name:<44}{value}")
    errors_m = absolute_trajectory_error(run.trajectory, truth).errors_m
    worst = int(np.argmax(errors_m))
    print(f"largest position error: {100 * errors_m[worst]:.2f} cm, tracked frame {worst}")
    return 0


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit("usage: python apps/04_evaluate.py RUN")
    sys.exit(one_line_errors(lambda: main(Path(sys.argv[1]))))
