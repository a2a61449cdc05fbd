"""Description of what the viewer shows of a map; the offline page and the server share it."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from toolkit.base.geometry.camera import Camera
from toolkit.semantics.palette import Palette
from toolkit.semantics.taxonomy import Taxonomy
from toolkit.tools.viewer.thinning import thin, visibility

# Stored coefficients of harmonics are this many times the real ones, which lie in [-1, 1] with few
# exceptions.
HARMONIC_STEPS = 127
# Colours of Gaussians without a class, of measured content and of inferred content.
UNKNOWN_RGB = (96, 100, 108)
MEASURED_RGB = (66, 150, 250)
INFERRED_RGB = (250, 150, 50)
_NO_CAMERAS = np.zeros((0, 3))
# States of the way from one pose of the path to the next, and their colours: tracked, a doubtful
# frame at one of its ends, or lost frames and frames of other parts of the map between them.
TRACKED, DOUBTFUL, INTERRUPTED = 0, 1, 2
PATH_RGB = ((245, 247, 252), (255, 171, 94), (255, 92, 82))


@dataclass(frozen=True)
class ShownSplats:
    """The Gaussians that are shown, the most visible first.

    Attributes:
        means_m: [N, 3] float32, in the frame of the map.
        sigmas_m: [N] float32 standard deviations; of anisotropic Gaussians, the geometric mean of
            the three axes.
        opacities: [N] float32 in [0, 1].
        rgb: [N, 3] uint8.
        shapes: [N, 6] float32 covariances relative to the squared sigma, as xx, xy, xz, yy, yz, zz;
            None if all Gaussians are isotropic.
        levels: [N, L] int32 node at each level of the class tree, -1 if unknown; or None.
        confidence: [N] float32 in [0, 1], or None.
        submap: [N] int32, or None.
        inferred: [N] bool, whether the position follows from a depth prior only; None if all is
            measured, or if the map does not store it.
        harmonics: [N, K, 3] int8 coefficients of the spherical harmonics of the degrees 1 to 3 (K
            is 3, 8 or 15), in units of 1 / `HARMONIC_STEPS`, added to the colour; None if colours
            do not depend on the view.

    Raises:
        ValueError: shapes do not match.
    """

    means_m: NDArray[np.float32]
    sigmas_m: NDArray[np.float32]
    opacities: NDArray[np.float32]
    rgb: NDArray[np.uint8]
    shapes: NDArray[np.float32] | None = None
    levels: NDArray[np.int32] | None = None
    confidence: NDArray[np.float32] | None = None
    submap: NDArray[np.int32] | None = None
    inferred: NDArray[np.bool_] | None = None
    harmonics: NDArray[np.int8] | None = None

    def __post_init__(self) -> None:
        for name, values in self.columns().items():
            if len(values) != len(self.means_m):
                raise ValueError(f"{name} has {len(values)} rows, expected {len(self.means_m)}")

    def __len__(self) -> int:
        return len(self.means_m)

    def columns(self) -> dict[str, NDArray]:
        """Return the arrays by name, without absent ones."""
        return {name: a for name, a in vars(self).items() if a is not None}

    def select(self, index: NDArray | slice) -> ShownSplats:
        """Select Gaussians by a boolean mask [N], integer indices [M] or a range."""
        return ShownSplats(**{name: values[index] for name, values in self.columns().items()})

    def thinned(self, count: int, cameras_m: NDArray[np.float64] = _NO_CAMERAS) -> ShownSplats:
        """Return at most `count` Gaussians, the most visible ones first.

        Args:
            count: maximum number of Gaussians, >= 1.
            cameras_m: [M, 3] positions of the cameras of the run.
        """
        visible = visibility(self.means_m, self.sigmas_m, self.opacities, cameras_m)
        thinning = thin(self.means_m, visible, count)
        kept = self.select(thinning.index)
        return replace(kept, sigmas_m=kept.sigmas_m * thinning.growth)


@dataclass(frozen=True)
class ShownNode:
    """A class or group.

    Attributes:
        path: names from the root.
        level: index of its level.
        rgb: its colour.
    """

    path: tuple[str, ...]
    level: int
    rgb: tuple[int, int, int]


@dataclass(frozen=True)
class ShownTree:
    """The class tree with the colours of the palette.

    Attributes:
        levels: names of the levels, coarsest first.
        nodes: the nodes that `ShownSplats.levels` refers to.
    """

    levels: tuple[str, ...]
    nodes: tuple[ShownNode, ...]

    @classmethod
    def from_taxonomy(cls, taxonomy: Taxonomy) -> ShownTree:
        """Describe a taxonomy with the colours of all other pictures of it."""
        colours = Palette(taxonomy).nodes.tolist()
        nodes = tuple(
            ShownNode(node.path, node.level, (r, g, b))
            for node, (r, g, b) in zip(taxonomy.nodes, colours, strict=True)
        )
        return cls(tuple(taxonomy.levels), nodes)

    def matching(self, text: str) -> list[int]:
        """Return the nodes whose name or path contains a text, ignoring case.

        Names that equal the text take precedence over names that contain it. Commas separate
        several texts.
        """
        found = {node for part in text.split(",") for node in self._matching(part)}
        return sorted(found)

    def _matching(self, text: str) -> list[int]:
        wanted = text.strip().casefold()
        if not wanted:
            return []
        names = [node.path[-1].casefold() for node in self.nodes]
        exact = [i for i, name in enumerate(names) if name == wanted]
        paths = [" > ".join(node.path).casefold() for node in self.nodes]
        return exact or [
            i
            for i, (name, path) in enumerate(zip(names, paths, strict=True))
            if wanted in name or (">" in wanted and wanted in path)
        ]


@dataclass(frozen=True)
class ShownKeyframe:
    """A keyframe of the run.

    Attributes:
        index: frame index.
        T_map_camera: [4, 4] float64.
        submap: number of its submap, or None.
        image: [h, w, 3] uint8, or None.
    """

    index: int
    T_map_camera: NDArray[np.float64]
    submap: int | None = None
    image: NDArray[np.uint8] | None = None


@dataclass(frozen=True)
class ShownLoop:
    """A verified loop between two frames.

    Attributes:
        first, second: frame indices.
        ends_m: [2, 3] positions of both cameras.
    """

    first: int
    second: int
    ends_m: NDArray[np.float64]


@dataclass(frozen=True)
class ShownObject:
    """An object of the scene graph.

    Attributes:
        number: its number in the scene graph; while a run continues, an object keeps it.
        name: its class and number.
        room: name of its room, empty if it is in none.
        corners_m: [8, 3] corners of its box; corner i is at the upper end of axis a if bit a of i
            is set.
        relations: lines about its relations.
        storey: name of its storey, empty if there is only one.
        path: names of its class, from the root of the class tree.
        voxels_m: [V, 3] points of its surface, about one in each voxel of 4 cm; None if only its
            box is known.
    """

    number: int
    name: str
    room: str
    corners_m: NDArray[np.float64]
    relations: tuple[str, ...] = ()
    storey: str = ""
    path: tuple[str, ...] = ()
    voxels_m: NDArray[np.float32] | None = None


@dataclass(frozen=True)
class ViewerScene:
    """All that a viewer shows.

    Attributes:
        title: name of the map.
        splats: the Gaussians, thinned.
        total: number of Gaussians of the map before thinning.
        up: [3] float64 unit vector, the vertical in the frame of the map.
        tree: class tree; None for a map without labels.
        path: [M, 4, 4] float64 poses T_map_camera of the tracked frames.
        path_states: [M] uint8 state of the way to each pose (`path_states`); empty if unknown.
        keyframes: keyframes.
        camera: intrinsics of the run, for the frusta of its keyframes; None for a splat file.
        loops: verified loops.
        notes: lines about lost and doubtful frames, separate parts of the map and its unit.
        length: name of the unit of length.
        objects: of the scene graph, by storey and room; empty without one.
    """

    title: str
    splats: ShownSplats
    total: int
    up: NDArray[np.float64] = field(default_factory=lambda: np.array([0.0, -1.0, 0.0]))
    tree: ShownTree | None = None
    path: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 4, 4)))
    path_states: NDArray[np.uint8] = field(default_factory=lambda: np.zeros(0, np.uint8))
    keyframes: tuple[ShownKeyframe, ...] = ()
    camera: Camera | None = None
    loops: tuple[ShownLoop, ...] = ()
    notes: tuple[str, ...] = ()
    length: str = "m"
    objects: tuple[ShownObject, ...] = ()

    def __str__(self) -> str:
        return f"{len(self.splats)} of {self.total} Gaussians, {len(self.keyframes)} keyframes"

    @property
    def path_colours(self) -> NDArray[np.uint8]:
        """Colours [M - 1, 3] of the lines between the poses of the path."""
        states = self.path_states[1:]
        if not len(states):
            states = np.zeros(max(len(self.path) - 1, 0), np.uint8)
        return np.array(PATH_RGB, np.uint8)[states]

    def thinned(self, count: int) -> ViewerScene:
        """Return the scene with at most `count` Gaussians, the most visible first."""
        return replace(self, splats=self.splats.thinned(count, self.path[:, :3, 3]))


def path_states(
    indices: Sequence[int], doubtful: Collection[int], absent: Collection[int]
) -> NDArray[np.uint8]:
    """Return the state [M] of the way to each frame of a path from the one before.

    Args:
        indices: [M] frame indices, in order.
        doubtful: indices of frames whose poses may be wrong.
        absent: indices of frames that are not on the path: lost, or in another part of the map.
    """
    own = np.asarray(indices, np.int64)
    unsure = np.isin(own, list(doubtful))
    states = np.where(unsure, DOUBTFUL, TRACKED).astype(np.uint8)
    states[1:][unsure[:-1]] = DOUBTFUL
    before = np.searchsorted(np.sort(np.asarray(list(absent), np.int64)), own)
    states[1:][np.diff(before) > 0] = INTERRUPTED
    return states
