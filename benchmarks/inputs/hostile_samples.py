"""Formats that the toolkit reads, each with a valid sample and the reader that users reach."""

from __future__ import annotations

import contextlib
import io
import os
import random
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from benchmarks.inputs import hostile_writers as writers
from toolkit.base.errors import ToolkitError
from toolkit.base.geometry.camera import Camera
from toolkit.datasets.checks import check_recording
from toolkit.datasets.registry import describe, open_dataset
from toolkit.io.arrays import read_array_tree
from toolkit.io.class_names import read_class_colours, read_class_names
from toolkit.io.object_embeddings import read_objects
from toolkit.io.splats import read_splats
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

Read = Callable[[Path], object]
_ERROR = re.compile(r"^semsplat: error: ", re.MULTILINE)
_CAMERA = Camera(30.0, 31.0, 15.5, 11.5, writers.WIDTH, writers.HEIGHT)
_KEYFRAME: Any = SimpleNamespace(index=0, camera=_CAMERA)


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
    write: Callable[[Path], None]
    read: Read
    weight: float = 1.0
    special: Mapping[str, Callable[[Path], None]] = field(default_factory=dict)
    files: tuple[str, ...] = ("*",)


class RefusedError(Exception):
    """A job that ended with an error of one or more lines."""


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


def dataset(kind: str, name: str = "", needs_depth: bool = True) -> Read:
    """Opens a dataset, loads all frames, and looks for faults."""

    def read(folder: Path) -> None:
        with contextlib.suppress(ToolkitError):  # what it says is checked below
            check_recording(describe(kind, folder / name))
        for frame in open_dataset(kind, folder / name, needs_depth=needs_depth):
            assert frame.rgb is not None
        classes = folder / "labels/classes.json"
        if classes.is_file():
            read_class_colours(classes)

    return read


def each(readers: Mapping[str, Read]) -> Read:
    """Reads the files of a folder, each by the reader of its name."""

    def read(folder: Path) -> None:
        for name, reader in readers.items():
            reader(folder / name)

    return read


def _classes(path: Path) -> None:
    read_class_names(path)
    read_class_colours(path)


def _shapes(path: Path) -> None:
    read_shape_table(path).embeddings(writers.CLASSES)


def _masks(folder: Path) -> None:
    coco = (folder / "masks.json").exists()
    images = {0: folder / "000000.png"}
    masks = CocoMasks(folder / "masks.json") if coco else MaskImageFolder(folder, images)
    masks.class_names()
    masks.masks(_KEYFRAME)


def _run(folder: Path) -> None:
    run = load_run(folder / "run")
    load_objects(run.folder)
    flattened(read_metrics(run.folder.metrics))
    read_loop_log(folder / "run/loops.jsonl")
    for submap in sorted((folder / "run/submaps").iterdir()):
        read_array_tree(submap)


def _many_class_names(folder: Path) -> None:
    """Write 60,000 names of classes that no vocabulary has, one a line."""
    chance, letters = random.Random(0), "abcdefghijklmnopqrstuvwxyz"
    names = {"".join(chance.choices(letters, k=chance.randint(8, 16))) for _ in range(60_000)}
    (folder / "names.txt").write_text("\n".join(sorted(names)))


_REVIEW = command("build-taxonomy", "--review", "--classes", "FOLDER/names.txt")
_RESUMED = command(
    *("run", "--resume", "--config", "FOLDER/run/config.yaml", "--out", "FOLDER/run"),
    *("--dataset.path", "FOLDER/data"),
)
_RUNS = tuple(f"run/*.{suffix}" for suffix in ("json", "jsonl", "yaml", "txt", "npz", "ply"))
_LISTS = each({"classes.json": _classes, "tree.yaml": Taxonomy.load, "tree.json": Taxonomy.load})
_MANY = {"60,000 classes": _many_class_names}
_CLASSES, _MASKS, _FOLDERS = "classes and trees", "masks and objects", "run folders"
_SETTINGS = each({"settings.yaml": load_settings, "plan.yaml": load_plan})
_TABLES = each({"shapes.json": _shapes, "shapes.csv": _shapes})
_SPLATS = {
    "splats": ("map.ply", "map.compressed.ply", "map.splat", "map.spz", "map.sog"),
    "splats: glTF and USD": (
        *("map.splats.glb", "map.splats.gltf", "map.usda", "map.usdc", "map.usdz"),
    ),
}
SAMPLES: dict[str, Sample] = {
    "folder": Sample("recordings", writers.write_folder, dataset("folder")),
    "nerfstudio": Sample("recordings", writers.write_nerfstudio, dataset("nerfstudio")),
    "r3d": Sample("recordings", writers.write_record3d, dataset("record3d", "walk.r3d")),
    "colmap": Sample("recordings", writers.write_colmap, dataset("colmap", needs_depth=False)),
    "ksplat": Sample("splats", writers.write_ksplat, each({"map.ksplat": read_splats})),
    **{
        name: Sample(area, writers.splat_writer(name), each({name: read_splats}))
        for area, names in _SPLATS.items()
        for name in names
    },
    "class lists": Sample(_CLASSES, writers.write_class_lists, _LISTS),
    "class names": Sample(_CLASSES, writers.write_class_lists, _REVIEW, 1.0, _MANY, ("names.txt",)),
    "shapes": Sample(_CLASSES, writers.write_shapes, _TABLES),
    "masks": Sample(_MASKS, writers.write_masks, _masks),
    "COCO": Sample(_MASKS, writers.write_coco, _masks),
    "embeddings": Sample(_MASKS, writers.write_embeddings, each({"objects.npz": read_objects})),
    "settings": Sample("settings and plans", writers.write_settings, _SETTINGS),
    "run": Sample(_FOLDERS, writers.write_run, _run, 2.0, files=_RUNS),
    "checkpoints": Sample(_FOLDERS, writers.write_killed_run, _RESUMED, 0.5, files=_RUNS),
}
AREAS = tuple(dict.fromkeys(sample.area for sample in SAMPLES.values()))
