"""Worked example: draw a look around from inside a splat file, without any window.

    python apps/render_views.py runs/demo/map.ply look_around

A camera stands where the map began and turns once around; each view becomes two PNGs,
colour and depth.
"""

import math
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import torch

from toolkit.cli.errors import one_line_errors
from toolkit.geometry import se3
from toolkit.geometry.camera import Camera
from toolkit.io.images import write_png
from toolkit.io.pictures import DepthSpan, colour_picture, depth_picture, with_depth_scale
from toolkit.rendering import render
from toolkit.rendering.viewpoints import Viewpoint
from toolkit.runs.folder import read_cloud

VIEWS = 12
CAMERA = Camera(fx=300.0, fy=300.0, cx=199.5, cy=149.5, width=400, height=300)
# One span for all views: a surface keeps its colour while the camera turns.
SPAN = DepthSpan(near_m=0.0, far_m=6.0)


def main(splat_file: Path, out: Path) -> int:
    """Draw the views."""
    gaussians = read_cloud(splat_file)
    out.mkdir(parents=True, exist_ok=True)
    for number in range(VIEWS):
        place = Viewpoint((0.0, 0.0, 0.0), yaw_rad=2.0 * math.pi * number / VIEWS)
        with torch.no_grad():
            drawn = render(gaussians, CAMERA, se3.inverse(place.T_map_camera))
        # Where nothing covers a pixel its depth says nothing.
        depth_m = torch.where(drawn.silhouette > 0.5, drawn.depth_m, torch.zeros(()))
        depth = with_depth_scale(depth_picture(depth_m.numpy(), SPAN), SPAN)
        write_png(out / f"colour_{number:02d}.png", colour_picture(drawn.colour.numpy()))
        write_png(out / f"depth_{number:02d}.png", depth)
    print(f"drew {VIEWS} views of {gaussians} into {out}")
    return 0


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit("usage: python apps/render_views.py MAP.ply OUT_FOLDER")
    sys.exit(one_line_errors(lambda: main(Path(sys.argv[1]), Path(sys.argv[2]))))
