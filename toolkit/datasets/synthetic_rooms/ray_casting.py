"""Rendering of colour, depth and labels of synthetic scenes with Open3D's ray casting."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from toolkit.base.geometry.camera import Camera
from toolkit.base.geometry.open3d_bridge import open3d
from toolkit.datasets.synthetic_rooms.atlas import paint_atlas
from toolkit.datasets.synthetic_rooms.finishes import Finish, coated, reflectance
from toolkit.datasets.synthetic_rooms.lighting import vertex_light
from toolkit.datasets.synthetic_rooms.parts import Part
from toolkit.datasets.synthetic_rooms.reflections import Reflection
from toolkit.datasets.synthetic_rooms.vocabulary import CLASS_IDS

# Models the lens and demosaicking of a real camera. Images have the local contrast of real ones
# (4.3 grey levels between neighbouring pixels at 320x240, as in 7-Scenes) and no aliasing.
LENS_BLUR_PIXELS = 0.6
_MISS = np.uint32(0xFFFFFFFF)
# Distance of the origins of reflected rays from their surface.
_CLEARANCE_M = 1e-4


@dataclass(frozen=True)
class RayCastView:
    """Images of an ideal camera.

    Attributes:
        rgb: [H, W, 3] float32 in [0, 1], averaged over each pixel.
        depth_m: [H, W] float32 z-depth at pixel centres, 0 where no surface is hit.
        labels: [H, W] int32 class ids at pixel centres, 0 where no surface is hit.
        cosine: [H, W] float32 cosine of the angle between ray and normal at pixel centres.
        walker: [H, W] bool, pixels that show a walker at least in part; None without one.
        reflection: what the surfaces reflect; None in rooms without gloss.
        objects: [H, W] int32 numbers of the objects at pixel centres, 0 where there is none.
    """

    rgb: NDArray[np.float32]
    depth_m: NDArray[np.float32]
    labels: NDArray[np.int32]
    cosine: NDArray[np.float32]
    walker: NDArray[np.bool_] | None = None
    reflection: Reflection | None = None
    objects: NDArray[np.int32] | None = None


class Scene:
    """Textured, lit and labelled surfaces for rendering.

    Args:
        parts: all surfaces in the world, metres, z up.
        lamps_m: [L, 3] ceiling lamps, metres.
        texel_m: edge of a texture element, metres.
        class_ids: class ids by name.
        polish: reflectance of lacquered surfaces at normal incidence, in a glossy scene, where each
            part reflects as its finish does; by default, all surfaces are matt. What a reflection
            shows is matt, so mirrors do not show reflections in other mirrors.
    """

    def __init__(
        self,
        parts: list[Part],
        lamps_m: NDArray[np.float64],
        texel_m: float,
        class_ids: Mapping[str, int] = CLASS_IDS,
        polish: float | None = None,
    ) -> None:
        patches = [patch for part in parts for patch in part.patches]
        owners = [part for part in parts for _ in part.patches]
        counts = [patch.points.shape[0] * patch.points.shape[1] for patch in patches]
        starts = np.concatenate([[0], np.cumsum(counts)[:-1]])
        triangles = [patch.triangles() for patch in patches]
        self.vertices_m = np.concatenate([p.points.reshape(-1, 3) for p in patches])
        self.triangles = np.concatenate(
            [corners + start for corners, start in zip(triangles, starts, strict=True)]
        )
        sizes = [len(corners) for corners in triangles]
        self.triangle_labels = np.repeat(
            np.array([class_ids[part.class_name] for part in owners], dtype=np.int32), sizes
        )
        self._triangle_objects = np.repeat(
            np.array([part.object_id for part in owners], dtype=np.int32), sizes
        )
        self._triangle_finish: NDArray[np.uint8] | None = None
        self._polish = polish
        if polish is not None:
            self._triangle_finish = np.repeat(
                np.array([part.finish for part in owners], dtype=np.uint8), sizes
            )
        self.casting: Any = open3d().t.geometry.RaycastingScene()
        self.casting.add_triangles(
            open3d().core.Tensor.from_numpy(self.vertices_m.astype(np.float32)),
            open3d().core.Tensor.from_numpy(self.triangles.astype(np.uint32)),
        )
        self.atlas, texels = paint_atlas(parts, texel_m)
        light = vertex_light(patches, lamps_m, self.casting)
        light = [np.maximum(values, part.glow) for values, part in zip(light, owners, strict=True)]
        self._vertex_looks = np.concatenate(
            [
                np.concatenate([xy, shade[..., None]], axis=-1).reshape(-1, 3)
                for xy, shade in zip(texels, light, strict=True)
            ]
        ).astype(np.float32)
        self._triangle_looks = _barycentric_form(self._vertex_looks[self.triangles])

    def distance_m(self, points: NDArray[np.float64]) -> NDArray[np.float32]:
        """Compute the distances [N] from points [N, 3] to the nearest surface, metres."""
        query = open3d().core.Tensor.from_numpy(np.asarray(points, dtype=np.float32))
        return np.asarray(self.casting.compute_distance(query, nthreads=1).numpy())

    def vertex_colours(self) -> NDArray[np.float32]:
        """Compute vertex colours [V, 3] in [0, 1] for the mesh file."""
        looks = self._vertex_looks
        colours = self.atlas.sample(looks[:, :2], np.full(len(looks), 3.0, dtype=np.float32))
        return np.clip(colours * looks[:, 2:] / 255.0, 0.0, 1.0)

    def render(self, camera: Camera, T_world_camera: NDArray, samples: int = 2) -> RayCastView:
        """Render a view.

        Args:
            camera: intrinsics and image size.
            T_world_camera: [4, 4] pose.
            samples: number of rays along each side of a pixel for colour.
        """
        shape = (camera.height, camera.width)
        hits = self._cast(camera, T_world_camera)
        hit = hits.triangle != _MISS
        triangle = np.where(hit, hits.triangle, 0)
        depth_m = np.where(hit, hits.depth_m, 0.0).astype(np.float32).reshape(shape)
        reflection = None
        if self._triangle_finish is not None:
            finish = self._finish(hits)
            places, mirrored = self._reflected(hits, finish)
            image_m = np.zeros(len(finish), dtype=np.float32)
            image_m[places] = np.where(mirrored.triangle != _MISS, mirrored.depth_m, 0.0)
            reflection = Reflection(finish.reshape(shape), depth_m, image_m.reshape(shape))
        return RayCastView(
            rgb=self._colour(camera, T_world_camera, samples),
            depth_m=depth_m,
            labels=np.where(hit, self.triangle_labels[triangle], 0).reshape(shape),
            cosine=np.where(hit, hits.cosine, 0.0).astype(np.float32).reshape(shape),
            reflection=reflection,
            objects=np.where(hit, self._triangle_objects[triangle], 0).reshape(shape),
        )

    def render_depth(self, camera: Camera, T_world_camera: NDArray) -> NDArray[np.float32]:
        """Render only the z-depth [H, W] in metres, 0 where no surface is hit."""
        hits = self._cast(camera, T_world_camera)
        depth_m = np.where(hits.triangle != _MISS, hits.depth_m, 0.0)
        return depth_m.astype(np.float32).reshape(camera.height, camera.width)

    def _colour(self, camera: Camera, T_world_camera: NDArray, samples: int) -> NDArray:
        fine = camera.scaled(samples, samples, camera.width * samples, camera.height * samples)
        hits = self._cast(fine, T_world_camera)
        colour = self._matt_colour(hits, fine.focal)
        if self._triangle_finish is not None and self._polish is not None:
            finish = self._finish(hits)
            places, mirrored = self._reflected(hits, finish)
            share = reflectance(finish[places], hits.cosine[places], self._polish)
            shown = self._matt_colour(mirrored, fine.focal)
            colour[places] = coated(colour[places], shown, share)
        image = colour.reshape(fine.height, fine.width, 3)
        image = cv2.GaussianBlur(image, (0, 0), LENS_BLUR_PIXELS * samples)
        image = cv2.resize(image, camera.size, interpolation=cv2.INTER_AREA)
        return np.clip(image, 0.0, 1.0).astype(np.float32)

    def _matt_colour(self, hits: _Hits, focal: float) -> NDArray[np.float32]:
        """Colours [N, 3] of the surfaces that rays hit, without reflections."""
        hit = hits.triangle != _MISS
        looks = self._triangle_looks.take(np.where(hit, hits.triangle, 0), axis=0)
        u, v = hits.barycentric[:, :1], hits.barycentric[:, 1:]
        here = looks[:, :3] + u * looks[:, 3:6] + v * looks[:, 6:]
        # The texture is averaged over the footprint of the ray. At grazing angles the footprint is
        # elongated, and the geometric mean of its sides is used.
        spacing_m = np.where(hit, hits.depth_m, 0.0) / focal
        stretch = np.sqrt(np.maximum(hits.cosine, 0.05))
        level = np.log2(np.maximum(spacing_m / stretch / self.atlas.texel_m, 1e-3))
        colour = self.atlas.sample(here[:, :2], level.astype(np.float32))
        colour *= (here[:, 2] * hit / 255.0)[:, None]
        return colour

    def _finish(self, hits: _Hits) -> NDArray[np.uint8]:
        """Finish [N] of the surfaces that rays hit, MATT where they hit none."""
        assert self._triangle_finish is not None
        hit = hits.triangle != _MISS
        finish = self._triangle_finish[np.where(hit, hits.triangle, 0)]
        return np.where(hit, finish, Finish.MATT).astype(np.uint8)

    def _reflected(self, hits: _Hits, finish: NDArray[np.uint8]) -> tuple[NDArray[np.int64], _Hits]:
        """Follow the rays that glossy surfaces reflect.

        Returns:
            The numbers [K] of these rays, and what they hit. Depth is measured along the whole
            way, as if the ray had gone straight on: it is the z-depth of the mirror image.
        """
        places = np.flatnonzero(finish != Finish.MATT)
        rays, normals = hits.rays[places], hits.normal[places]
        ahead = rays[:, 3:]
        toward = np.einsum("ij,ij->i", normals, ahead)[:, None]
        reflected = np.empty_like(rays)
        # In front of the surface, so that the ray does not hit it again.
        before = _CLEARANCE_M * normals * np.sign(toward)
        reflected[:, :3] = rays[:, :3] + hits.depth_m[places, None] * ahead - before
        reflected[:, 3:] = ahead - 2.0 * toward * normals
        seen = self._trace(reflected)
        return places, replace(seen, depth_m=seen.depth_m + hits.depth_m[places])

    def _cast(self, camera: Camera, T_world_camera: NDArray) -> _Hits:
        """Cast one ray through each pixel centre.

        The directions have z = 1 in camera coordinates, so that hit distances are z-depths.
        """
        T = np.asarray(T_world_camera, dtype=np.float64)
        directions = camera.rays().reshape(-1, 3) @ T[:3, :3].T
        rays = np.empty((len(directions), 6), dtype=np.float32)
        rays[:, :3] = T[:3, 3]
        rays[:, 3:] = directions
        return self._trace(rays)

    def _trace(self, rays: NDArray[np.float32]) -> _Hits:
        """Find what rays [N, 6] hit first; distances are in units of their directions' lengths."""
        answer = self.casting.cast_rays(open3d().core.Tensor.from_numpy(rays), nthreads=1)
        ahead = rays[:, 3:]
        normals = answer["primitive_normals"].numpy()
        toward = np.einsum("ij,ij->i", normals, ahead)
        return _Hits(
            rays=rays,
            normal=normals,
            triangle=answer["primitive_ids"].numpy(),
            barycentric=answer["primitive_uvs"].numpy(),
            depth_m=answer["t_hit"].numpy(),
            cosine=np.abs(toward) / np.sqrt(np.einsum("ij,ij->i", ahead, ahead)),
        )


@dataclass(frozen=True)
class _Hits:
    rays: NDArray[np.float32]
    normal: NDArray[np.float32]
    triangle: NDArray[np.uint32]
    barycentric: NDArray[np.float32]
    depth_m: NDArray[np.float32]
    cosine: NDArray[np.float32]


def _barycentric_form(corners: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return per triangle the value at the first corner and its change along both edges [M, 9]."""
    first, second, third = corners[:, 0], corners[:, 1], corners[:, 2]
    return np.concatenate([first, second - first, third - first], axis=1)
