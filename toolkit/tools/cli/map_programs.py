"""Arguments of the jobs that serve maps or write them for other programs, or change them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional

from toolkit.base.options import Fraction, NonNegativeInt, PositiveFloat, PositiveInt, Range
from toolkit.exports.options import (
    ExportFormat,
    GridOptions,
    ObjectGraphOptions,
    PlanOptions,
    format_of,
)
from toolkit.semantics.options import ObjectOptions
from toolkit.tools.serving.options import EarlierRun, ServiceLimits
from toolkit.tools.viewer.options import ShownContent

# A mesh of a room with smaller voxels does not fit in memory.
VoxelSize = Annotated[float, Range(ge=0.001)]
ColourValue = Annotated[int, Range(ge=0, le=255)]


@dataclass(frozen=True)
class ExportOptions:
    """Export the map of a finished run for other programs, or convert a file of splats."""

    run: Positional[Path]
    """Run folder, or a splat file (.ply, .splat, .spz, .sog, .ksplat, glTF, USD), which is
    converted to splats of another format."""
    to: Path
    """File to write, or folder (new or empty) of COLMAP and nerfstudio formats."""
    format: ExportFormat | None = None
    """Format (docs/guides/exports.md). By default, it follows from the suffix: .ply is splats, but
    .mesh.ply a mesh; .glb and .gltf are a mesh, but .splats.glb and .splats.gltf splats."""
    spz_version: Literal[2, 3, 4] = 4
    """Version of .spz files; more viewers read the versions 2 and 3, and version 2 has coarser
    rotations."""
    mesh: bool = False
    """Short for --format mesh."""
    points: bool = False
    """Short for --format points: the centres of opaque Gaussians (.ply, .pcd)."""
    voxel_m: VoxelSize = 0.015
    """Voxel size of meshes, in metres. Memory grows with its inverse square."""
    max_depth_m: PositiveFloat = 6.0
    """Maximum depth fused into meshes, in metres."""
    every: PositiveInt = 3
    """Interval of the poses that are fused into meshes or exported with images: every n-th one."""
    images: Literal["copy", "render", "reference"] = "copy"
    """Images of COLMAP and nerfstudio formats: recorded images as the run used them (copy), images
    of the map (render), or the files of the dataset without a copy (reference)."""
    max_points: PositiveInt = 100_000
    """Maximum number of points in COLMAP and nerfstudio formats."""
    keep: tuple[str, ...] = ()
    """Classes and groups of the taxonomy to export: names, or paths such as
    "large items > furnishings"; "void" selects Gaussians without a label. By default, all."""
    drop: tuple[str, ...] = ()
    """Classes and groups of the taxonomy to exclude."""
    floor: tuple[str, ...] = ()
    """Classes of the floor, which determines the vertical direction. By default, those of floor,
    ground, rug and carpet that the taxonomy contains."""
    grid: GridOptions = GridOptions()
    objects: ObjectGraphOptions = ObjectGraphOptions()
    plan: PlanOptions = PlanOptions()
    viewer: ShownContent = ShownContent()

    @property
    def kind(self) -> ExportFormat:
        """Format of the export, from the options or the file name."""
        name = self.to.name.lower()
        if self.format is not None:
            return self.format
        if self.mesh or name.endswith(".mesh.ply"):
            return "mesh"
        if self.points:
            return "points"
        if name.endswith((".splats.glb", ".splats.gltf")):
            return "splats"
        return format_of(self.to.suffix.lower())


@dataclass(frozen=True)
class ViewOptions:
    """Show a map in the browser, with cameras, classes, submaps and loops; Ctrl-C stops."""

    map: Positional[Path]
    """Run folder, or a splat file (.ply, .splat, .spz, .sog, .ksplat, glTF, USD)."""
    live: bool = False
    """Follow a run in progress."""
    host: str = "127.0.0.1"
    """Address to listen on. Other computers can connect only if another address is given; there is
    no password."""
    port: Annotated[int, Range(ge=0, le=65535)] = 8080
    """Port to listen on; 0 takes any free port."""
    highlight: tuple[str, ...] = ()
    """Classes and groups that are highlighted at the start."""
    budget: PositiveInt = 1_000_000
    """Maximum number of Gaussians that a browser draws at once of a map with more than
    --viewer.max-gaussians, which is streamed in levels of detail. A browser needs about 0.3 kB of
    memory for each."""
    viewer: ShownContent = ShownContent()


@dataclass(frozen=True)
class EditOptions:
    """Edit the labelled map of a finished run by class; report the holes that are left behind."""

    run: Positional[Path]
    """Run folder."""
    out: Path
    """Folder to write, new or empty: map.ply, taxonomy.yaml, edit.json and renders/."""
    remove: tuple[str, ...] = ()
    """Classes and groups to remove, named as for `semsplat query`."""
    keep: tuple[str, ...] = ()
    """Classes and groups to keep; all others are removed."""
    move: tuple[tuple[str, float, float, float], ...] = ()
    """Classes and groups to move: a name, and metres to the right, down and forward as seen by the
    first camera of the run."""
    recolour: tuple[tuple[str, ColourValue, ColourValue, ColourValue], ...] = ()
    """Classes and groups to recolour: a name, and red, green and blue from 0 to 255. Differences in
    brightness are kept."""
    min_confidence: Fraction = 0.0
    """Minimum confidence of the class of an edited Gaussian."""
    every: PositiveInt = 10
    """Interval of the poses of the run that are rendered: every n-th one."""


@dataclass(frozen=True)
class EmbedObjectsOptions:
    """Embed the objects of a labelled map with a model such as CLIP or SigLIP, for `semsplat query
    --encoder`; write objects.npz into the run folder."""

    run: Positional[Path]
    """Run folder."""
    encoder: Path
    """Folder of a model such as CLIP or SigLIP (transformers)."""
    dataset: Path | None = None
    """Folder of the dataset, if it was moved after the run."""
    max_keyframes: PositiveInt = 100
    """Maximum number of keyframes that are searched for views of objects, evenly spaced."""
    max_views: PositiveInt = 12
    """Maximum number of views of each object."""
    codes: NonNegativeInt = 0
    """Bytes per embedding, by product quantisation (FAISS): a divisor of the dimensions of the
    model. It saves space from about 300 objects on. By default (0), values have 16 bits."""
    replace: bool = False
    """Replace existing embeddings."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Device of the encoder; a GPU if available (auto)."""
    min_confidence: Fraction = 0.0
    """Minimum confidence of the class of a Gaussian."""
    link_m: PositiveFloat = ObjectOptions.link_m
    """Maximum distance between neighbouring Gaussians of one object, in metres."""
    min_gaussians: PositiveInt = ObjectOptions.min_gaussians
    """Minimum number of Gaussians of an object."""


@dataclass(frozen=True)
class ServeOptions:
    """Serve poses, rendered views, queries and objects of a finished run over HTTP, or to
    assistants over the Model Context Protocol."""

    run: Positional[Path]
    """Run folder."""
    host: str = "127.0.0.1"
    """Address to listen on. By default, only this machine can connect; at another address, anyone
    who can connect can read the map."""
    port: Annotated[int, Range(ge=0, le=65535)] = 8000
    """Port to listen on; 0 chooses a free one."""
    mcp: bool = False
    """Serve tools for assistants over stdin and stdout (Model Context Protocol) instead of HTTP."""
    limits: ServiceLimits = ServiceLimits()
    changes: EarlierRun = EarlierRun()
