"""Fuse a TSDF mesh from renders of a map and colour it by class.

    python apps/11_tsdf_mesh_with_labels.py runs/demo mesh.ply

Depth and colour are rendered at every third pose of the run and fused with Open3D's
VoxelBlockGrid. Each vertex takes the class of the nearest Gaussian. The mesh has the class colours
of `semsplat render --what labels`. The class ids of its vertices are in mesh.labels.npy, since
Open3D's mesh files keep no attributes other than colours; the names of the classes are in
taxonomy.yaml of the run.
"""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np
from numpy.typing import NDArray

from toolkit.base.geometry.open3d_bridge import open3d
from toolkit.io.meshes import TriangleMesh
from toolkit.runs.maps.labelled import load_labelled_run
from toolkit.runs.maps.meshing import MeshOptions, surface_mesh
from toolkit.semantics.palette import Palette
from toolkit.tools.cli.errors import one_line_errors

OPTIONS = MeshOptions(voxel_m=0.02, max_depth_m=6.0, every=3)


def nearest(points_m: NDArray[np.float32], queries_m: NDArray[np.float32]) -> NDArray[np.int64]:
    """Return the index [Q] of the point [N, 3] nearest to each query [Q, 3]."""
    o3d = open3d()
    search = o3d.core.nns.NearestNeighborSearch(o3d.core.Tensor(points_m))
    search.knn_index()
    indices, _ = search.knn_search(o3d.core.Tensor(queries_m), 1)
    return np.asarray(indices.numpy()[:, 0])


def write_labelled_mesh(
    path: Path, mesh: TriangleMesh, labels: NDArray[np.int32], colours: NDArray[np.uint8]
) -> None:
    """Write a mesh in class colours, and the class ids of its vertices beside it."""
    o3d = open3d()
    surface = o3d.t.geometry.TriangleMesh(
        o3d.core.Tensor(mesh.vertices_m), o3d.core.Tensor(mesh.triangles)
    )
    surface.vertex["colors"] = o3d.core.Tensor(colours.astype(np.float32) / 255.0)
    o3d.t.io.write_triangle_mesh(str(path), surface)
    np.save(path.with_suffix(".labels.npy"), labels)


def main(run_folder: Path, out: Path) -> int:
    """Write the labelled mesh of a run."""
    labelled = load_labelled_run(run_folder)
    gaussians = labelled.run.gaussians
    mesh = surface_mesh(labelled.run, gaussians, OPTIONS)
    labels = labelled.map.labels.label[nearest(gaussians.means.numpy(), mesh.vertices_m)]
    write_labelled_mesh(out, mesh, labels, Palette(labelled.map.taxonomy).classes[labels])
    print(f"wrote {out} ({mesh}, {len(np.unique(labels))} classes)")
    return 0


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit("usage: python apps/11_tsdf_mesh_with_labels.py RUN MESH.ply")
    sys.exit(one_line_errors(lambda: main(*map(Path, sys.argv[1:]))))
