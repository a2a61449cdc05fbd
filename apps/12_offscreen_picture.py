"""Draw a point cloud and a mesh side by side into a PNG, without a display.

    python apps/12_offscreen_picture.py cloud.ply mesh.ply picture.png

Both are drawn by Open3D's OffscreenRenderer from the same viewpoint: the first camera of the map
moved back, so that more of the scene is visible. The renderer needs a Vulkan or OpenGL driver; on
a machine without GPU, a software driver (apt-get install libvulkan1 mesa-vulkan-drivers).
"""

import sys
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np
from numpy.typing import NDArray

from toolkit.base.errors import DependencyError, FormatError
from toolkit.base.geometry.open3d_bridge import open3d
from toolkit.io.images import write_png
from toolkit.tools.cli.errors import one_line_errors

WIDTH, HEIGHT = 480, 360
FIELD_OF_VIEW_DEG = 70.0
BACK_M = 0.5
POINT_SIZE_PX = 6.0


def draw(geometry: Any) -> NDArray[np.uint8]:
    """Return the picture [H, W, 3] of a legacy Open3D geometry in its own colours."""
    rendering = open3d().visualization.rendering
    try:
        renderer = rendering.OffscreenRenderer(WIDTH, HEIGHT)
    except RuntimeError as error:
        raise DependencyError(
            f"Open3D cannot render off screen ({error}); run: "
            "apt-get install -y libvulkan1 mesa-vulkan-drivers"
        ) from error
    material = rendering.MaterialRecord()
    material.shader = "defaultUnlit"  # vertex colours, without lights
    material.point_size = POINT_SIZE_PX
    renderer.scene.view.set_post_processing(False)  # tone mapping would change the colours
    renderer.scene.set_background([1.0, 1.0, 1.0, 1.0])
    renderer.scene.add_geometry("geometry", geometry, material)
    # The camera looks along +z with y down, as in the map.
    centre, eye, up = [0.0, 0.0, 1.0], [0.0, 0.0, -BACK_M], [0.0, -1.0, 0.0]
    renderer.setup_camera(FIELD_OF_VIEW_DEG, centre, eye, up)
    return np.asarray(renderer.render_to_image())


def main(cloud_file: Path, mesh_file: Path, out: Path) -> int:
    """Draw both files beside each other."""
    io = open3d().io
    cloud = io.read_point_cloud(str(cloud_file))
    mesh = io.read_triangle_mesh(str(mesh_file))
    if not cloud.has_points() or not mesh.has_triangles():
        raise FormatError(f"{cloud_file} must contain points and {mesh_file} triangles")
    write_png(out, np.concatenate([draw(cloud), draw(mesh)], axis=1))
    print(f"wrote {out}")
    return 0


if __name__ == "__main__":
    if len(sys.argv) != 4:
        sys.exit("usage: python apps/12_offscreen_picture.py CLOUD.ply MESH.ply PICTURE.png")
    sys.exit(one_line_errors(lambda: main(*map(Path, sys.argv[1:]))))
