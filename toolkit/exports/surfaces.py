"""Export scenes: meshes with a node per class, splats as glTF or USD, labelled point clouds."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from sklearn.neighbors import NearestNeighbors

from toolkit.base.geometry import se3
from toolkit.exports.selection import SelectedGaussians, ground_of
from toolkit.io.gltf import MeshPart, write_gltf
from toolkit.io.labelled_points import LabelledPoints, write_labelled_points
from toolkit.io.meshes import TriangleMesh
from toolkit.io.splat_placement import SplatScene
from toolkit.io.splats import export_splat_scene
from toolkit.runs.maps.meshing import MeshOptions, part_mesh, surface_mesh
from toolkit.scene.graph.boxes import Ground
from toolkit.semantics.taxonomy import VOID

# glTF has y up and z forward; without a known floor, the first camera is assumed to be level.
_GLTF_FROM_CAMERA = np.diag([1.0, -1.0, -1.0, 1.0])


def export_labelled_points(path: Path, selection: SelectedGaussians) -> int:
    """Write the centres of opaque Gaussians with colours, classes and confidences.

    Returns:
        The number of points.

    Raises:
        ToolkitError: there are none, a package is missing, or the file cannot be written.
    """
    opaque = selection.opaque()
    points = LabelledPoints(opaque.given_m, opaque.rgb, opaque.labels, opaque.classes)
    write_labelled_points(path, points)
    return len(points)


def export_gltf(
    path: Path, selection: SelectedGaussians, options: MeshOptions, floor: Sequence[str] = ()
) -> TriangleMesh:
    """Fuse a mesh and write it as glTF: one node per class, named like the class, y up.

    Returns:
        The mesh, in the frame of the map.

    Raises:
        ToolkitError: there is no surface, or the file cannot be written.
    """
    fuse = part_mesh if selection.partial else surface_mesh
    mesh = fuse(selection.run, selection.gaussians, options)
    T_gltf_map = _T_scene_map(selection, floor)
    extras = {"T_gltf_map": T_gltf_map.tolist(), "metric": selection.run.metric}
    write_gltf(path, _parts(mesh, selection), T_gltf_map, extras)
    return mesh


def export_scene_splats(
    path: Path, selection: SelectedGaussians, comments: Sequence[str], floor: Sequence[str] = ()
) -> None:
    """Write the Gaussians as glTF or USD, placed like the mesh of `export_gltf`, with class tree.

    Raises:
        ToolkitError: a package is missing, or the file cannot be written.
    """
    scene = SplatScene(
        T_scene_map=_T_scene_map(selection, floor),
        metric=selection.run.metric,
        comments=tuple(comments),
        taxonomy=selection.class_tree,
    )
    export_splat_scene(path, selection.gaussians, selection.columns, scene)


def _T_scene_map(selection: SelectedGaussians, floor: Sequence[str]) -> NDArray[np.float64]:
    """The transformation [4, 4] from the map to the axes of glTF, with the run's origin."""
    return gltf_from_map(ground_of(selection.run, floor)) @ selection.run.T_given_map


def gltf_from_map(ground: Ground | None) -> NDArray[np.float64]:
    """Return the rotation [4, 4] from the axes of the map to those of glTF: y is up."""
    if ground is None:
        return _GLTF_FROM_CAMERA
    x, y, up = ground.axes.T
    R = np.stack([x, up, -y])  # right-handed: x cross up = -y
    return se3.from_rotation_translation(R, np.zeros(3))


def _parts(mesh: TriangleMesh, selection: SelectedGaussians) -> list[MeshPart]:
    if selection.labels is None:
        return [MeshPart("surface", mesh)]
    taxonomy = selection.labelled().taxonomy
    ids = triangle_classes(mesh, selection)
    parts = []
    for class_id in np.unique(ids):
        used, triangles = np.unique(mesh.triangles[ids == class_id], return_inverse=True)
        part = TriangleMesh(
            mesh.vertices_m[used],
            mesh.colours[used],
            triangles.reshape(-1, 3).astype(np.int32),
        )
        if class_id == VOID:
            parts.append(MeshPart("void", part, {"class_id": VOID, "path": []}))
            continue
        name, path = taxonomy.classes[class_id - 1], list(taxonomy.leaf(int(class_id)).path)
        parts.append(MeshPart(name, part, {"class_id": int(class_id), "path": path}))
    return parts


def triangle_classes(mesh: TriangleMesh, selection: SelectedGaussians) -> NDArray[np.int32]:
    """Return the class ids [T] of triangles: that of the Gaussian nearest to their centre."""
    opaque = selection.opaque()
    assert opaque.labels is not None
    search = NearestNeighbors(n_neighbors=1).fit(opaque.means_m)
    centres_m = mesh.vertices_m[mesh.triangles].mean(axis=1)
    nearest = search.kneighbors(centres_m, return_distance=False)[:, 0]
    return np.asarray(opaque.labels.label[nearest])
