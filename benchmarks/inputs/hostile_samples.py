"""Formats that the toolkit reads, each with a small valid sample and the reader that users reach.

The tests damage recordings of the other layouts, and more of each container and format of splats.
"""

from __future__ import annotations

import contextlib
import io
import json
import os
import random
import re
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import yaml

from toolkit.base.errors import ToolkitError
from toolkit.base.geometry.camera import Camera
from toolkit.base.geometry.trajectory import Trajectory
from toolkit.datasets.checks import check_recording
from toolkit.datasets.registry import describe, open_dataset
from toolkit.datasets.synthetic_rooms import tiny_room
from toolkit.io import images
from toolkit.io.arrays import read_array_tree
from toolkit.io.class_names import read_class_colours, read_class_names
from toolkit.io.object_embeddings import ObjectEmbeddings, read_objects, write_objects
from toolkit.io.splats import read_splats
from toolkit.io.trajectories import write_tum
from toolkit.runs.batch.plan import load_plan
from toolkit.runs.evaluation.metrics import flattened, read_metrics
from toolkit.runs.maps.finished import load_run
from toolkit.runs.maps.saved_objects import load_objects
from toolkit.runs.settings import load_settings
from toolkit.scene.instances.coco import CocoMasks
from toolkit.scene.instances.mask_images import MaskImageFolder
from toolkit.semantics.taxonomy import Taxonomy
from toolkit.semantics.taxonomy_building.shapes import read_shape_table
from toolkit.slam.loops.log import read_loop_log
from toolkit.tools.cli.main import main

Write = Callable[[Path], None]
Read = Callable[[Path], object]
FRAMES, WIDTH, HEIGHT = 2, 32, 24
TREE = {"large": {"soft": ["bed", "sofa"], "hard": ["table"]}, "small": ["cup", "vase"]}
CLASSES = ("bed", "sofa", "table", "cup", "vase")
_CLASS_FILE = {
    "void": 0,
    "classes": {str(k): name for k, name in enumerate(CLASSES, start=1)},
    "colours": {str(k): [k, 2 * k, 3 * k] for k in range(1, 6)},
}
_ERROR = re.compile(r"^semsplat: error: ", re.MULTILINE)


@dataclass(frozen=True)
class Sample:
    """A valid sample of a format.

    Attributes:
        area: row of the table.
        write: writes it into an empty folder.
        read: reads all of it from the folder, by the functions of a job.
        weight: share of the attempts; smaller for slow readers.
        special: attacks of this format only, by name: each changes the folder.
        files: names of the files to attack, as patterns; by default, all.
    """

    area: str
    write: Write
    read: Read
    weight: float = 1.0
    special: Mapping[str, Write] = field(default_factory=dict)
    files: tuple[str, ...] = ("*",)


class RefusedError(Exception):
    """A job that ended with an error of one or more lines."""


# Recordings, runs, and what is exported from runs


def write_recording(folder: Path) -> None:
    """The toolkit's own layout, with labels and times."""
    frames, truth = tiny_room(FRAMES, WIDTH, HEIGHT)
    for kind in ("rgb", "depth", "labels"):
        (folder / kind).mkdir(parents=True)
    for frame in frames:
        name = f"{frame.index}.png"
        images.write_rgb(folder / "rgb" / name, frame.rgb)
        images.write_depth_png(folder / "depth" / name, frame.depth_m, 2000)
        labels = 1 + np.arange(WIDTH * HEIGHT, dtype=np.uint8).reshape(HEIGHT, WIDTH) // 160
        images.write_png(folder / "labels" / name, labels)
    (folder / "labels/classes.json").write_text(json.dumps(_CLASS_FILE))
    values = {name: getattr(frames[0].camera, name) for name in ("fx", "fy", "cx", "cy")}
    values |= {"width": WIDTH, "height": HEIGHT, "fps": 10.0, "depth_scale": 2000}
    values |= {"distortion": [0.01, 0.0, 0.0, 0.0, 0.0]}
    (folder / "intrinsics.yaml").write_text(yaml.safe_dump(values))
    (folder / "timestamps.txt").write_text("".join(f"{i} {i / 10}\n" for i in range(FRAMES)))
    poses = Trajectory(np.arange(FRAMES) / 10.0, truth.T_world_camera)
    write_tum(folder / "trajectory.txt", poses)


def write_run(folder: Path, *words: str) -> None:
    """A finished run with classes, over its recording."""
    write_recording(folder / "data")
    place = ("--dataset.kind", "folder", "--dataset.path", os.fspath(folder / "data"))
    short = ("--mapping.iterations", "2", "--mapping.first-iterations", "2", "--poses", "given")
    assert main(["run", *place, "--out", os.fspath(folder / "run"), *short, *words]) == 0


def write_killed_run(folder: Path) -> None:
    """A run that still has its checkpoints."""
    from toolkit.runs.session import Session

    Session.close_results = lambda _: None  # type: ignore[method-assign, assignment]
    write_run(folder)


def exported(name: str, *words: str) -> Write:
    """Writes what `semsplat export` makes of a run: a file, or the content of the folder."""

    def write(folder: Path) -> None:
        with tempfile.TemporaryDirectory() as made:
            write_run(Path(made))
            run = os.fspath(Path(made) / "run")
            assert main(["export", run, "--to", os.fspath(folder / name), *words]) == 0

    return write


def command(*words: str) -> Read:
    """Runs a job in this process; FOLDER in its words is replaced.

    Raises:
        RefusedError: it reported an error.
    """

    def read(folder: Path) -> None:
        os.chdir(folder)
        shown = io.StringIO()
        with contextlib.redirect_stderr(shown), contextlib.redirect_stdout(io.StringIO()):
            status = main([word.replace("FOLDER", os.fspath(folder)) for word in words])
        if status:
            raise RefusedError(_ERROR.split(shown.getvalue())[-1].rstrip("\n"))

    return read


def dataset(kind: str) -> Read:
    """Opens a dataset, loads all frames, and looks for faults; exported ones have no depth."""
    own = kind == "folder"

    def read(folder: Path) -> None:
        with contextlib.suppress(ToolkitError):  # what it says is checked below
            check_recording(describe(kind, folder))
        for frame in open_dataset(kind, folder, needs_depth=own):
            assert frame.rgb is not None
        if own:
            read_class_colours(folder / "labels/classes.json")

    return read


def _read_run(folder: Path) -> None:
    run = load_run(folder / "run")
    load_objects(run.folder)
    flattened(read_metrics(run.folder.metrics))
    read_loop_log(folder / "run/loops.jsonl")
    for submap in sorted((folder / "run/submaps").iterdir()):
        read_array_tree(submap)


# Single files


def each(readers: Mapping[str, Read]) -> Read:
    """Reads the files of a folder, each by the reader of its name."""

    def read(folder: Path) -> None:
        for name, reader in readers.items():
            reader(folder / name)

    return read


def write_class_lists(folder: Path) -> None:
    """Names of classes with ids and as lines, trees over them, and tables of their shapes."""
    (folder / "classes.json").write_text(json.dumps(_CLASS_FILE))
    (folder / "names.txt").write_text("\n".join(CLASSES))
    taxonomy = Taxonomy(TREE, classes=CLASSES)
    taxonomy.save(folder / "tree.yaml")
    taxonomy.save(folder / "tree.json")
    rows = {name: [float(k), k / 2.0] for k, name in enumerate(CLASSES)}
    (folder / "shapes.json").write_text(json.dumps(rows))
    lines = [f"{name},{a},{b}" for name, (a, b) in rows.items()]
    (folder / "shapes.csv").write_text("class,a,b\n" + "\n".join(lines))


def _read_classes(path: Path) -> None:
    read_class_names(path)
    read_class_colours(path)


def _read_shapes(path: Path) -> None:
    read_shape_table(path).embeddings(CLASSES)


def _write_many_class_names(folder: Path) -> None:
    """60,000 names of classes that no vocabulary has, one a line."""
    chance, letters = random.Random(0), "abcdefghijklmnopqrstuvwxyz"
    names = {"".join(chance.choices(letters, k=chance.randint(8, 16))) for _ in range(60_000)}
    (folder / "names.txt").write_text("\n".join(sorted(names)))


def write_masks(folder: Path) -> None:
    """Images of ids with columns beside them."""
    ids = np.repeat(np.arange(3, dtype=np.uint16), HEIGHT * WIDTH // 3).reshape(HEIGHT, WIDTH)
    cv2.imwrite(str(folder / "000000.png"), ids)
    embeddings = np.eye(2, 4, dtype=np.float32)
    columns = {"ids": [1, 2], "classes": ["bed", ""], "scores": [0.5, 1.0]}
    np.savez(folder / "000000.npz", embeddings=embeddings, model="m", **columns)  # type: ignore


def write_coco(folder: Path) -> None:
    """COCO annotations: polygons, run lengths, and packed run lengths."""
    size = [HEIGHT, WIDTH]
    shapes = [
        [[1, 1, 9, 1, 9, 9]],
        {"size": size, "counts": [100, 50, HEIGHT * WIDTH - 150]},
        {"size": size, "counts": "T3b1Zc0"},
    ]
    image = {"id": 1, "file_name": "000000.png", "height": HEIGHT, "width": WIDTH}
    annotations = [
        {"image_id": 1, "category_id": 1, "segmentation": shape, "score": 0.9} for shape in shapes
    ]
    content = {"images": [image], "categories": [{"id": 1, "name": "bed"}]}
    (folder / "masks.json").write_text(json.dumps(content | {"annotations": annotations}))


def _read_masks(folder: Path) -> None:
    coco = (folder / "masks.json").exists()
    images_of = {0: folder / "000000.png"}
    masks = CocoMasks(folder / "masks.json") if coco else MaskImageFolder(folder, images_of)
    masks.class_names()
    camera = Camera(30.0, 31.0, 15.5, 11.5, WIDTH, HEIGHT)
    keyframe: Any = SimpleNamespace(index=0, camera=camera)
    masks.masks(keyframe)


def write_embeddings(folder: Path) -> None:
    """Embeddings of objects."""
    numbers = np.arange(1, 4, dtype=np.int32)
    vectors = np.eye(3, 8, dtype=np.float32)
    objects = ObjectEmbeddings(numbers, numbers, vectors, np.ones(3, np.float32), "m")
    write_objects(folder / "objects.npz", objects)


def write_settings(folder: Path) -> None:
    """Settings of runs, and a plan of many."""
    settings = {"seed": 3, "mapping": {"iterations": 5}, "dataset": {"kind": "folder"}}
    (folder / "settings.yaml").write_text(yaml.safe_dump(settings))
    place = {"dataset": {"kind": "folder", "path": "data"}}
    plan = {"sequences": {"a": place}, "settings": {"b": {"preset": "fast"}}, "seeds": [0]}
    (folder / "plan.yaml").write_text(yaml.safe_dump(plan))


_REVIEW = command("build-taxonomy", "--review", "--classes", "FOLDER/names.txt")
_RESUMED = command(
    *("run", "--resume", "--config", "FOLDER/run/config.yaml", "--out", "FOLDER/run"),
    *("--dataset.path", "FOLDER/data"),
)
_RUNS = tuple(f"run/*.{suffix}" for suffix in ("json", "jsonl", "yaml", "txt", "npz", "ply"))
_LISTS = {
    "classes.json": _read_classes,
    "tree.yaml": Taxonomy.load,
    "tree.json": Taxonomy.load,
    "shapes.json": _read_shapes,
    "shapes.csv": _read_shapes,
}
_RECORDINGS, _CLASSES, _MASKS = "recordings", "classes and trees", "masks and objects"
_MANY = {"60,000 classes": _write_many_class_names}
_SETTINGS = each({"settings.yaml": load_settings, "plan.yaml": load_plan})
_SPLATS = {
    "splats": ("map.ply", "map.compressed.ply", "map.splat", "map.spz", "map.sog"),
    "splats: glTF and USD": (
        *("map.splats.glb", "map.splats.gltf", "map.usda", "map.usdc", "map.usdz"),
    ),
}
SAMPLES: dict[str, Sample] = {
    "folder": Sample(_RECORDINGS, write_recording, dataset("folder")),
    **{
        kind: Sample(_RECORDINGS, exported("", "--format", name), dataset(kind))
        for kind, name in (("nerfstudio", "nerfstudio"), ("colmap", "colmap-binary"))
    },
    **{
        name: Sample(area, exported(name), each({name: read_splats}))
        for area, names in _SPLATS.items()
        for name in names
    },
    "class lists": Sample(_CLASSES, write_class_lists, each(_LISTS), 2.0),
    "class names": Sample(_CLASSES, write_class_lists, _REVIEW, 1.0, _MANY, ("names.txt",)),
    "masks": Sample(_MASKS, write_masks, _read_masks),
    "COCO": Sample(_MASKS, write_coco, _read_masks),
    "embeddings": Sample(_MASKS, write_embeddings, each({"objects.npz": read_objects})),
    "settings": Sample("settings and plans", write_settings, _SETTINGS),
    "run": Sample("run folders", write_run, _read_run, 2.0, files=_RUNS),
    "checkpoints": Sample("run folders", write_killed_run, _RESUMED, 0.5, files=_RUNS),
}
AREAS = tuple(dict.fromkeys(sample.area for sample in SAMPLES.values()))
