"""Render the map of a run from new viewpoints, without a window.

    python apps/03_render.py runs/demo views

The camera stands at the first pose of the run and turns once around its vertical axis. Each view
gives two PNG files, colour and depth.
"""

import math
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import torch

import toolkit
from toolkit.base.geometry import se3
from toolkit.io.images import write_png
from toolkit.io.visualisation import DepthSpan, colour_image, depth_image, with_depth_scale
from toolkit.splatting.rendering.viewpoints import Viewpoint
from toolkit.tools.cli.errors import one_line_errors

# One depth range for all views, so that a surface keeps its colour while the camera turns.
SPAN = DepthSpan(near_m=0.0, far_m=6.0)


def main(run_folder: Path, out: Path, views: int = 12) -> int:
    """Render the views."""
    run = toolkit.load_run(run_folder)
    T_map_first = run.trajectory.T_world_camera[0]
    out.mkdir(parents=True, exist_ok=True)
    for number in range(views):
        turned = Viewpoint((0.0, 0.0, 0.0), yaw_rad=2.0 * math.pi * number / views)
        T_camera_map = se3.inverse(T_map_first @ turned.T_map_camera)
        with torch.no_grad():
            view = toolkit.render(run.gaussians, run.camera, T_camera_map)
        # Depth is undefined where no Gaussian covers a pixel.
        depth_m = torch.where(view.silhouette > 0.5, view.depth_m, torch.zeros(()))
        depth = with_depth_scale(depth_image(depth_m.numpy(), SPAN), SPAN)
        write_png(out / f"colour_{number:02d}.png", colour_image(view.colour.numpy()))
        write_png(out / f"depth_{number:02d}.png", depth)
    print(f"rendered {views} views of {run.gaussians} to {out}")
    return 0


if __name__ == "__main__":
    if len(sys.argv) not in (3, 4):
        sys.exit("usage: python apps/03_render.py RUN OUT_FOLDER [VIEWS]")
    views = int(sys.argv[3]) if len(sys.argv) == 4 else 12
    sys.exit(one_line_errors(lambda: main(Path(sys.argv[1]), Path(sys.argv[2]), views)))
