"""Arguments of the jobs.

They are declared apart from the implementations, so that help and parsing do not load torch.
`semsplat run` declares its arguments in `run.py`.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional

from toolkit.base.options import (
    Fraction,
    NonNegativeFloat,
    NonNegativeInt,
    PositiveFloat,
    PositiveInt,
    Range,
)
from toolkit.datasets.options import BagTopics, DatasetKind
from toolkit.semantics.options import ObjectOptions
from toolkit.slam.loops.registration.options import RegistrationOptions
from toolkit.tools.cli.batch_programs import RefineOptions, RunManyOptions
from toolkit.tools.cli.map_programs import (
    EditOptions,
    EmbedObjectsOptions,
    ExportOptions,
    ServeOptions,
    ViewOptions,
    VoxelSize,
)

ImageSize = tuple[PositiveInt, PositiveInt]

ColourValue = Annotated[int, Range(ge=0, le=255)]

# Images of `semsplat render` that need a map with semantics.
RenderedImage = Literal["colour", "depth", "silhouette", "strip", "labels", "levels", "instances"]
SEMANTIC_IMAGES = frozenset(("labels", "levels"))


@dataclass(frozen=True)
class DatasetLocation:
    """The dataset of the run."""

    path: Path | None = None
    """Folder of the dataset, if it was moved after the run."""


@dataclass(frozen=True)
class EvaluateOptions:
    """Evaluate a finished run again and update its metrics.json; times and memory are kept."""

    run: Positional[Path]
    """Run folder."""
    dataset: DatasetLocation = DatasetLocation()
    max_views: PositiveInt = 100
    """Maximum number of views evaluated in each group (mapped, held out, unseen), evenly
    spaced."""
    lpips_weights: tuple[Path, ...] = ()
    """Files with the weights of LPIPS: torchvision's AlexNet (alexnet-owt-7be5be79.pth) and the
    linear weights of the lpips package (alex.pth), or one file (.pth, .safetensors) with both.
    By default, those of the run."""
    subset: bool = False
    """Compute the papers' subset mIoU, for which each view is decoded among the classes of its
    ground-truth labels only."""
    truth_error_m: NonNegativeFloat | None = None
    """Error of the ground truth's relative positions, in metres, which loop edges are allowed in
    addition to 5 cm. By default, that of the run."""
    truth_error_deg: NonNegativeFloat | None = None
    """Error of the ground truth's relative rotations, in degrees, in addition to 2 degrees. By
    default, that of the run."""
    truth_error_s: NonNegativeFloat | None = None
    """Error of the ground truth's times relative to the images, in seconds. By default, that of the
    run."""
    mesh: Path | None = None
    """Ground-truth mesh (.ply, .obj) in the frame of the ground-truth poses, to which a mesh fused
    from renderings is compared. By default, mesh.ply of a synthetic room."""


@dataclass(frozen=True)
class RenderProgram:
    """Render views of a map to PNG, along the run's path, a trajectory, or from given positions; or
    a video along a smooth path through them."""

    map: Positional[Path]
    """Run folder, or a splat file (.ply, .splat, .spz, .sog, .ksplat, glTF, USD)."""
    out: Path | None = None
    """Folder for the images. By default, RUN/renders/views, or FILE_views beside a splat file."""
    trajectory: Path | None = None
    """Poses to render, in the map's frame: a TUM file (time tx ty tz qx qy qz qw)."""
    view: tuple[tuple[float, float, float, float, float], ...] = ()
    """Views to render, five numbers each: x y z in metres (right, down, forward), yaw (right) and
    pitch (up) in degrees, relative to the run's first camera or the axes of a splat file."""
    every: PositiveInt = 1
    """Interval of the poses that are rendered: every n-th one."""
    what: tuple[RenderedImage, ...] = ("colour", "depth", "silhouette")
    """Images of each view. A strip shows colour, depth and silhouette beside the input; labels are
    one image per level of the class tree with a legend; levels show all levels side by side;
    instances have a colour for each object."""
    camera: tuple[float, float, float, float] | None = None
    """Camera intrinsics fx fy cx cy, in pixels. By default, those of the run."""
    image_size: ImageSize | None = None
    """Width and height of the images, in pixels. By default, those of the run."""
    video: Path | None = None
    """Video to write instead of images (.mp4, .gif): the first image of --what on a smooth path
    through the views or the trajectory given, by default through the keyframes of the run."""
    video_s: PositiveFloat = 10.0
    """Duration of the video in seconds."""
    video_fps: PositiveInt = 30
    """Images per second of the video."""


@dataclass(frozen=True)
class CompareOptions:
    """Compare finished runs on one HTML page: settings that differ, metrics, paths and views."""

    runs: Positional[tuple[Path, ...]]
    """Run folders, at least two."""
    out: Path = Path("compare.html")
    """Page to write (.html), which needs no network."""
    objects: Path | None = None
    """Compare the objects of two runs of one place, and write those that were moved, are new or are
    gone in the second run as JSON."""
    registration: Path | None = None
    """The register.json of `semsplat register` for both runs, which aligns their objects. By
    default, the maps are registered."""
    same_frame: bool = False
    """The maps have the same frame, as maps of given poses do; they are not registered."""


@dataclass(frozen=True)
class ExplainLoopsOptions:
    """Draw each loop candidate of a run: both views, overlap, similarity and result."""

    run: Positional[Path]
    """Run folder."""
    out: Path | None = None
    """Folder for the images. By default, RUN/loops."""
    refused: bool = False
    """Include the candidates that were rejected before registration."""
    missed: bool = True
    """Include the loops of the ground truth that were not found; reads all frames."""
    dataset_path: Path | None = None
    """Folder of the dataset, if it was moved after the run."""


@dataclass(frozen=True)
class RegisterOptions:
    """Register the map of RUN_B with that of RUN_A, and write both as one map in A's frame."""

    run_a: Positional[Path]
    """Folder of the run that defines the frame of the merged map."""
    run_b: Positional[Path]
    """Folder of the run that is moved."""
    out: Path
    """Folder to write, new or empty: map.ply, register.json, trajectory_a.txt, trajectory_b.txt."""
    pairs: PositiveInt = 6
    """Number of pairs of submaps that are registered, the most similar first."""
    registration: RegistrationOptions = RegistrationOptions()


@dataclass(frozen=True)
class QueryProgram:
    """Query the labelled map of a finished run for number, position and size of objects."""

    run: Positional[Path]
    """Run folder."""
    nodes: Positional[tuple[str, ...]] = ()
    """Classes or groups of the taxonomy: a name, or a path such as "large items > furnishings",
    which may start at any level. Nouns that are no names find classes of the same or a narrower
    meaning: "couch", "seating". By default, the taxonomy is listed."""
    encoder: Path | None = None
    """Folder of a model such as CLIP or SigLIP: NODES are any texts, and objects with embeddings
    (objects.npz) are ranked by their similarity. Exact names of classes are answered first."""
    image: Path | None = None
    """Image of an object to search for; needs --encoder."""
    embedding: Path | None = None
    """File (.npy) with the embedding of a text or image, made by the model of the objects."""
    top: PositiveInt = 5
    """Maximum number of objects in a ranking by similarity."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Device of the encoder; a GPU if available (auto)."""
    list: bool = False
    """Print the taxonomy with the number of Gaussians of each class and group."""
    json: bool = False
    """Print JSON instead of tables."""
    cloud: Path | None = None
    """Write the selected classes as a point cloud (.ply, .pcd): the centres of their Gaussians."""
    mesh: Path | None = None
    """Write the selected classes as a mesh (.ply), fused from renderings at the run's poses."""
    picture: Path | None = None
    """Write a picture (.png) of the view that shows most of the found classes, with these
    highlighted and the numbers of the objects in the table. It needs NODES."""
    summary: Path | None = None
    """Write the scene as JSON: the taxonomy with counts, all objects with bounding boxes, and the
    dimensions of the room."""
    min_confidence: Fraction = 0.0
    """Minimum confidence of the class of a Gaussian."""
    link_m: PositiveFloat = ObjectOptions.link_m
    """Maximum distance between neighbouring Gaussians of one object, in metres."""
    min_gaussians: PositiveInt = ObjectOptions.min_gaussians
    """Minimum number of Gaussians of an object."""
    floor: tuple[str, ...] = ()
    """Classes of the floor, which determines the vertical direction. By default, those of floor,
    ground, rug and carpet that the taxonomy contains."""
    distance_from: Literal["first", "last"] = "first"
    """Camera of the run from which distances are measured."""
    voxel_m: VoxelSize = 0.01
    """Voxel size of the mesh, in metres."""
    max_depth_m: PositiveFloat = 6.0
    """Maximum depth fused into the mesh, in metres."""
    every: PositiveInt = 1
    """Interval of the poses fused into the mesh: every n-th one."""


@dataclass(frozen=True)
class CheckDataOptions:
    """Read a dataset frame by frame and report its defects."""

    kind: DatasetKind
    """Layout of the dataset (docs/guides/datasets.md)."""
    path: Path
    """Folder of the dataset, or file of a video or bag."""
    image_size: ImageSize | None = None
    """Width and height in pixels to which images are resized. By default, they keep their size."""
    topics: BagTopics = BagTopics()


@dataclass(frozen=True)
class MakeRoomOptions:
    """Create a furnished room and a recording of it: colour, depth, labels, poses and a mesh."""

    out: Path
    """Folder to write: new, empty, or an earlier synthetic room."""
    layout: Literal[
        "room",
        "rooms",
        "hall",
        "ring",
        "ring-moved",
        "ring-light",
        "ring-evening",
        "ring-repainted",
        "ring-changed",
        "twins",
        "twins-objects",
        "orbit",
        "still",
        "long",
        "corridor",
        "corridor-turns",
        "corridor-stop",
        "wall",
    ] = "room"
    """Layout: one room, three on a corridor (rooms), twelve (hall), four that close a loop (ring).
    When the camera returns to the first room of the ring, objects have moved (ring-moved), its
    lamps are off (ring-light), objects have moved and a warm lamp lights it (ring-evening), it is
    repainted in this light (ring-repainted), or all of this (ring-changed). Other layouts: three
    rooms of which two are equal (twins) or have equal walls and different objects (twins-objects),
    around a table with objects (orbit), one room from a single place (still), or one room in which
    the camera moves freely for minutes (long). In others, some views do not determine the motion:
    along white panels with identical doors to a hall and back (corridor), with turns to the sides
    (corridor-turns) or a stop of 20 frames (corridor-stop), and along a wall of an empty room
    (wall)."""
    seed: NonNegativeInt = 0
    """Seed of furniture, textures, camera motion and sensor noise."""
    frames: PositiveInt | None = None
    """Number of frames along the path. By default, the camera moves at walking pace."""
    share: Annotated[float, Range(gt=0, le=1)] = 1.0
    """Fraction of the path that is recorded."""
    image_size: ImageSize = (320, 240)
    """Width and height of the images, in pixels."""
    sensor_noise: bool = False
    """Simulate a real camera (noise, holes, blur, exposure, wrong labels)."""
    real: bool = False
    """Simulate what else real recordings have: drifting white balance, flying pixels, no depth on
    shiny objects, at edges and grazing angles, and a walker."""
    walker: bool = False
    """Let a person walk through the view; masks are written to the folder walker."""
    glossy: bool = False
    """Let surfaces reflect the room: a lacquered floor, switched-off screens, and mirrors on a wall
    and on the wardrobe. Depth is what a sensor measures: that of the mirror image on mirrors, and
    none on screens at most angles; true depth is in the folder surface. Excludes --walker, --real
    and --classes."""
    polish: Annotated[float, Range(gt=0, lt=1)] = 0.07
    """With --glossy, the fraction of the light that the floor reflects where it is seen from above;
    more at grazing angles."""
    texture: Literal["normal", "weak", "plain", "wallpaper", "stripes"] = "normal"
    """Texture of all surfaces. Weak ones keep a tenth of their contrast, so that images show little
    but the edges and shadows of objects. Plain walls, ceilings, floors and doors show none at all.
    With wallpaper or stripes, all walls have a pattern that repeats exactly every 12.5 cm."""
    fov_deg: Annotated[float, Range(ge=10, le=120)] | None = None
    """Horizontal field of view of the camera, in degrees. By default, 64 degrees."""
    unseen: NonNegativeInt = 20
    """Number of ideal views off the path, in the folder unseen."""
    classes: Annotated[int, Range(ge=20, le=500)] | None = None
    """Number of classes of a room with shelves of small objects instead of furniture, from 20 to
    500; also writes taxonomy.yaml, a tree of them. Requires the layout room and excludes --real.
    By default, the room is furnished, with the 101 classes of Replica."""


@dataclass(frozen=True)
class LabelledData:
    """The labelled dataset for training."""

    kind: DatasetKind
    """Layout of the dataset (docs/guides/datasets.md)."""
    path: Path
    """Folder of the dataset, which must have labels."""


@dataclass(frozen=True)
class TrainHeadOptions:
    """Train a linear head on the labels of some frames: classes of your own.

    The head is for `--segmenter.kind model` with the same encoder.
    """

    dataset: LabelledData
    out: Path
    """File of the head to write (.safetensors)."""
    model: Path | None = None
    """Local folder of a vision transformer such as DINOv2, in the format of transformers, as the
    encoder. By default, the encoder is the indoor network, which sees depth, and colour."""
    every: PositiveInt = 1
    """Interval of the frames that are used: every n-th one."""
    hold_out: Annotated[int, Range(ge=2)] = 5
    """Interval of the used frames that are held out to evaluate the head: every n-th one."""
    image_size: ImageSize | None = None
    """Width and height in pixels to which images are resized. By default, they keep their size."""
    longest_side: Annotated[int, Range(ge=14)] = 518
    """Length in pixels of the longer image side for the encoder of --model."""
    patches_per_frame: PositiveInt = 2000
    """Maximum number of patches per frame used for training."""
    seed: NonNegativeInt = 0
    """Seed of the selection of patches."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Device that runs the encoder."""


@dataclass(frozen=True)
class DatasetChoice:
    """The dataset that supplies class names and labelled frames."""

    kind: DatasetKind = "folder"
    """Layout of the dataset (docs/guides/datasets.md)."""
    path: Path | None = None
    """Folder of the dataset."""


@dataclass(frozen=True)
class BuildTaxonomyOptions:
    """Build the taxonomy from which semantic codes are derived (docs/guides/taxonomies.md)."""

    classes: Path | None = None
    """Class names: a dataset's classes.json, or a text file with one name per line ('#' starts a
    comment)."""
    dataset: DatasetChoice = DatasetChoice()
    out: Path | None = None
    """File of the taxonomy to write (.yaml, .json)."""
    picture: Path | None = None
    """Drawing of the taxonomy to write (.png, .svg, .pdf)."""
    review: bool = False
    """Print the taxonomy for review."""
    grouper: Literal["rules", "language-model"] = "rules"
    """Source of the groups: built-in rules (rules) or a model behind an OpenAI-compatible endpoint
    (language-model)."""
    base_url: str | None = None
    """URL of the endpoint. By default, SEMSPLAT_LLM_BASE_URL; the key is SEMSPLAT_LLM_API_KEY."""
    model: str | None = None
    """Name of the model at the endpoint. By default, SEMSPLAT_LLM_MODEL."""
    cache: Path | None = None
    """Folder in which answers of the model are cached."""
    record: Path | None = None
    """File to which all questions and answers are written, for --replay."""
    replay: Path | None = None
    """File from which all answers are read, without network access."""
    fall_back: bool = False
    """Build the taxonomy by rules if the model is not available."""
    shapes: tuple[Literal["scans"]] | tuple[Literal["table", "meshes"], Path] | None = None
    """Shapes of the classes, by which the last level is grouped: 'scans' measures the labelled
    frames of --dataset; 'table FILE' and 'meshes DIR' read them. By default, only names are
    used."""
    mesh_up: Literal["y", "z"] = "z"
    """Vertical axis of the meshes."""
    seed: NonNegativeInt = 0
    """Seed of clustering and of the language model."""


PROGRAMS: dict[str, type] = {
    "run-many": RunManyOptions,
    "refine": RefineOptions,
    "evaluate": EvaluateOptions,
    "render": RenderProgram,
    "compare": CompareOptions,
    "export": ExportOptions,
    "view": ViewOptions,
    "edit": EditOptions,
    "explain-loops": ExplainLoopsOptions,
    "register": RegisterOptions,
    "query": QueryProgram,
    "embed-objects": EmbedObjectsOptions,
    "serve": ServeOptions,
    "check-data": CheckDataOptions,
    "make-room": MakeRoomOptions,
    "train-head": TrainHeadOptions,
    "build-taxonomy": BuildTaxonomyOptions,
}
