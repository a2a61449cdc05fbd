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
from typing import Any

from benchmarks.inputs import hostile_maps as maps
from benchmarks.inputs import hostile_recordings as recordings

Read = Callable[[Path], None]
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
        from toolkit.tools.cli.main import main

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
        from toolkit.base.errors import ToolkitError
        from toolkit.datasets.checks import check_recording
        from toolkit.datasets.registry import describe, open_dataset
        from toolkit.io.class_names import read_class_colours

        path = folder / name
        with contextlib.suppress(ToolkitError):  # what it says is checked below
            check_recording(describe(kind, path))
        opened = open_dataset(kind, path, needs_depth=needs_depth)
        for frame in opened:
            assert frame.rgb is not None
        classes = folder / "labels/classes.json"
        if classes.is_file():
            read_class_colours(classes)

    return read


def splats(name: str) -> Read:
    """Reads a file of splats with what lies beside it."""

    def read(folder: Path) -> None:
        from toolkit.io.splats import read_splats

        assert len(read_splats(folder / name).means) > 0

    return read


def each(readers: Mapping[str, Read]) -> Read:
    """Reads the files of a folder, each by the reader of its name."""

    def read(folder: Path) -> None:
        for name, reader in readers.items():
            reader(folder / name)

    return read


def _class_colours(path: Path) -> None:
    from toolkit.io.class_names import read_class_colours, read_class_names

    read_class_names(path)
    read_class_colours(path)


def _tree(path: Path) -> None:
    from toolkit.semantics.taxonomy import Taxonomy

    Taxonomy.load(path)


def _shapes(path: Path) -> None:
    from toolkit.semantics.taxonomy_building.shapes import read_shape_table

    read_shape_table(path).embeddings(maps.CLASSES)


def _masks(folder: Path) -> None:
    from toolkit.scene.instances.mask_images import MaskImageFolder

    masks = MaskImageFolder(folder, {0: folder / "000000.png"})
    masks.class_names()
    masks.masks(_keyframe())


def _coco(folder: Path) -> None:
    from toolkit.scene.instances.coco import CocoMasks

    masks = CocoMasks(folder / "masks.json")
    masks.class_names()
    masks.masks(_keyframe())


def _keyframe() -> Any:
    from types import SimpleNamespace

    from toolkit.base.geometry.camera import Camera

    camera = Camera(30.0, 31.0, 15.5, 11.5, recordings.WIDTH, recordings.HEIGHT)
    return SimpleNamespace(index=0, camera=camera)


def _embeddings(folder: Path) -> None:
    from toolkit.io.object_embeddings import read_objects

    assert len(read_objects(folder / "objects.npz").ids) > 0


def _plan(path: Path) -> None:
    from toolkit.runs.batch.plan import load_plan

    load_plan(path)


def _settings(path: Path) -> None:
    from toolkit.runs.settings import load_settings

    load_settings(path)


def _run(folder: Path) -> None:
    from toolkit.io.arrays import read_array_tree
    from toolkit.runs.evaluation.metrics import flattened, read_metrics
    from toolkit.runs.maps.finished import load_run
    from toolkit.runs.maps.saved_objects import load_objects
    from toolkit.slam.loops.log import read_loop_log

    run = load_run(folder / "run")
    load_objects(run.folder)
    flattened(read_metrics(run.folder.metrics))
    read_loop_log(folder / "run/loops.jsonl")
    for submap in sorted((folder / "run/submaps").iterdir()):
        read_array_tree(submap)


_RUN_FILES = ("*.json", "*.jsonl", "*.yaml", "*.txt", "*.npz", "*.ply")
_SPLAT_NAMES = {
    "PLY": "map.ply",
    "compressed PLY": "map.compressed.ply",
    ".splat": "map.splat",
    "SPZ": "map.spz",
    "SOG": "map.sog",
    "GLB": "map.splats.glb",
    "glTF": "map.splats.gltf",
    "USD text": "map.usda",
    "USD binary": "map.usdc",
    "USDZ": "map.usdz",
}


def _recording(
    kind: str, write: Callable[[Path], None], name: str = "", needs_depth: bool = True
) -> Sample:
    return Sample(f"recordings: {kind}", write, dataset(kind, name, needs_depth))


def _samples() -> dict[str, Sample]:
    """All samples by name."""
    r = recordings
    found = {
        "folder": _recording("folder", r.write_folder),
        "replica": _recording("replica", r.write_replica),
        "tum": _recording("tum", r.write_tum),
        "seven-scenes": _recording("seven-scenes", r.write_seven_scenes),
        "nerfstudio": _recording("nerfstudio", r.write_nerfstudio),
        "stray-scanner": _recording("stray-scanner", r.write_stray_scanner),
        "polycam": _recording("polycam", r.write_polycam),
        "r3d": _recording("record3d", r.write_record3d, "walk.r3d"),
        "colmap text": _recording("colmap", r.colmap_writer(False), needs_depth=False),
        "colmap binary": _recording("colmap", r.colmap_writer(True), needs_depth=False),
    }
    for storage in ("ros1", "sqlite3", "mcap"):
        name = "recording.bag" if storage == "ros1" else "recording"
        found[f"bag {storage}"] = _recording("bag", r.bag_writer(storage), name)
    for title, file in _SPLAT_NAMES.items():
        area = "splats: glTF and USD" if file.endswith(("tf", "lb", "a", "c", "z")) else "splats"
        area = "splats" if file.endswith("spz") else area
        found[title] = Sample(area, maps.splat_writer(file), splats(file))
    found["SOG in a folder"] = Sample("splats", maps.write_unpacked_sog, splats("meta.json"))
    found["ksplat"] = Sample("splats", maps.write_ksplat, splats("map.ksplat"))
    return found | _other_samples()


def _other_samples() -> dict[str, Sample]:
    """Samples of classes, objects, runs and settings."""
    lists = {"classes.json": _class_colours, "tree.yaml": _tree, "tree.json": _tree}
    names = command("build-taxonomy", "--review", "--classes", "FOLDER/names.txt")
    resumed = command(
        *("run", "--resume", "--config", "FOLDER/run/config.yaml", "--out", "FOLDER/run"),
        *("--dataset.path", "FOLDER/data"),
    )
    many = {"60,000 classes": _many_class_names}
    runs = tuple(f"run/{pattern}" for pattern in _RUN_FILES)
    classes, objects = "classes and trees", "masks and objects"
    settings = each({"settings.yaml": _settings, "plan.yaml": _plan})
    shapes = each({"shapes.json": _shapes, "shapes.csv": _shapes})
    return {
        "class lists": Sample(classes, maps.write_class_lists, each(lists)),
        "class names": Sample(classes, maps.write_class_lists, names, 1.0, many, ("names.txt",)),
        "shapes": Sample(classes, maps.write_shapes, shapes),
        "masks": Sample(objects, maps.write_masks, _masks),
        "COCO": Sample(objects, maps.write_coco, _coco),
        "embeddings": Sample(objects, maps.write_embeddings, _embeddings),
        "settings": Sample("settings and plans", maps.write_settings, settings),
        "run": Sample("run folders", maps.write_run, _run, 2.0, files=runs),
        "checkpoints": Sample("run folders", maps.write_killed_run, resumed, 0.5, files=runs),
    }


def _many_class_names(folder: Path) -> None:
    """Write 60,000 names of classes that no vocabulary has, one a line."""
    chance, letters = random.Random(0), "abcdefghijklmnopqrstuvwxyz"
    names = {"".join(chance.choices(letters, k=chance.randint(8, 16))) for _ in range(60_000)}
    (folder / "names.txt").write_text("\n".join(sorted(names)))


SAMPLES = _samples()
AREAS = tuple(dict.fromkeys(sample.area for sample in SAMPLES.values()))
