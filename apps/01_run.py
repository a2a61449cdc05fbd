"""Track and map a recorded RGB-D sequence.

    python apps/01_run.py folder mine out

Writes `out/trajectory.txt` (TUM format) and `out/map.ply` (3DGS splats). The result is the same as
that of `semsplat run --dataset.kind folder --dataset.path mine`.
"""

import argparse
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from tqdm import tqdm

import toolkit
from toolkit.io.splats import write_splat_ply
from toolkit.io.trajectories import write_tum
from toolkit.tools.cli.errors import one_line_errors


def main(kind: str, path: Path, out: Path) -> int:
    """Process all frames, refine the map and write the results."""
    dataset = toolkit.open_dataset(kind, path)
    slam = toolkit.build_slam(dataset)
    for frame in tqdm(dataset, total=len(dataset), unit="frame"):
        slam.process_frame(frame)
    result = slam.finish()

    out.mkdir(parents=True, exist_ok=True)
    write_tum(out / "trajectory.txt", result.trajectory)
    write_splat_ply(out / "map.ply", result.gaussians)
    print(f"wrote {result.trajectory} and {result.gaussians} to {out}")
    return 0


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Track and map a recorded RGB-D sequence.")
    parser.add_argument("kind", help="layout; see docs/guides/datasets.md")
    parser.add_argument("path", type=Path, help="folder of the dataset")
    parser.add_argument("out", type=Path, help="folder for the results")
    arguments = parser.parse_args()
    sys.exit(one_line_errors(lambda: main(arguments.kind, arguments.path, arguments.out)))
