"""Convert a map to an Open3D point cloud and back.

    python apps/10_map_to_point_cloud.py runs/demo/map.ply cloud.ply map_again.ply

The point cloud has the centres of the Gaussians and their colours, so that Open3D or CloudCompare
can crop, filter or register it. Radius, opacity and class id of each Gaussian are attributes of
the points. The second step reads the cloud and writes a splat file. Points of other programs lack
these attributes: their radius is then half the distance to the nearest neighbour, their opacity
0.9.
"""

import sys
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np
import torch

from toolkit.base.errors import FormatError
from toolkit.base.geometry.open3d_bridge import open3d
from toolkit.io.splats import read_splats, write_splat_ply
from toolkit.splatting.gaussians.cloud import GaussianCloud
from toolkit.tools.cli.errors import one_line_errors

DEFAULT_OPACITY = 0.9


def point_cloud_from_map(splat_file: Path) -> Any:
    """Return an `open3d.t.geometry.PointCloud` with one point for each Gaussian."""
    o3d = open3d()
    splats = read_splats(splat_file)
    cloud = o3d.t.geometry.PointCloud(o3d.core.Tensor(splats.means))
    # Point cloud files have 8-bit colours.
    colours = np.rint(255.0 * splats.colours.clip(0.0, 1.0)).astype(np.uint8)
    cloud.point["colors"] = o3d.core.Tensor(colours)
    cloud.point["radius"] = o3d.core.Tensor(np.exp(splats.log_radii)[:, None])
    opacity = 1.0 / (1.0 + np.exp(-splats.opacity_logits))
    cloud.point["opacity"] = o3d.core.Tensor(opacity[:, None])
    if splats.labels is not None:
        cloud.point["label"] = o3d.core.Tensor(splats.labels.label[:, None])
    return cloud


def gaussians_from_point_cloud(cloud: Any) -> GaussianCloud:
    """Return isotropic Gaussians at the points of an `open3d.t.geometry.PointCloud`."""
    point = cloud.point
    means = point["positions"].numpy().astype(np.float32)
    colours = np.full((len(means), 3), 0.5, np.float32)
    if "colors" in point:
        colours = point["colors"].numpy().astype(np.float32)
        if point["colors"].dtype == open3d().core.uint8:
            colours /= 255.0
    if "radius" in point:
        radii_m = point["radius"].numpy()[:, 0]
    else:
        distances_m = cloud.to_legacy().compute_nearest_neighbor_distance()
        radii_m = 0.5 * np.maximum(distances_m, 1e-4)
    opacities = np.full(len(means), DEFAULT_OPACITY)
    if "opacity" in point:
        opacities = point["opacity"].numpy()[:, 0]
    values = (means, radii_m, opacities, colours)
    means_t, radii_t, opacities_t, colours_t = (
        torch.from_numpy(np.ascontiguousarray(v, np.float32)) for v in values
    )
    return GaussianCloud.from_values(means_t, radii_t, opacities_t, colours_t)


def main(splat_file: Path, cloud_file: Path, back_file: Path) -> int:
    """Write the point cloud, read it again and write the splat file."""
    io = open3d().t.io
    io.write_point_cloud(str(cloud_file), point_cloud_from_map(splat_file))
    cloud = io.read_point_cloud(str(cloud_file))
    if "positions" not in cloud.point:
        raise FormatError(f"{cloud_file} contains no points; give the name of a .ply file")
    gaussians = gaussians_from_point_cloud(cloud)
    write_splat_ply(back_file, gaussians)
    print(f"wrote {cloud_file} and {back_file} ({gaussians})")
    return 0


if __name__ == "__main__":
    if len(sys.argv) != 4:
        sys.exit("usage: python apps/10_map_to_point_cloud.py MAP.ply CLOUD.ply MAP_AGAIN.ply")
    sys.exit(one_line_errors(lambda: main(*map(Path, sys.argv[1:]))))
