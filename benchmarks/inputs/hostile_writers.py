"""Small valid recordings, maps, runs, class lists, masks and settings, to be damaged.

The tests damage recordings of the other layouts.
"""

from __future__ import annotations

import json
import os
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import torch
import yaml
from numpy.typing import NDArray

from toolkit.base.geometry import se3
from toolkit.base.geometry.trajectory import Trajectory
from toolkit.io import images
from toolkit.io.object_embeddings import ObjectEmbeddings, write_objects
from toolkit.io.splats import export_splats
from toolkit.io.trajectories import write_tum
from toolkit.semantics.taxonomy import Taxonomy
from toolkit.splatting.gaussians.cloud import GaussianCloud

SPLATS = 40
TREE = {"large": {"soft": ["bed", "sofa"], "hard": ["table"]}, "small": ["cup", "vase"]}
CLASSES = ("bed", "sofa", "table", "cup", "vase")


FRAMES, WIDTH, HEIGHT = 2, 32, 24
_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
_CLASSES = {
    "void": 0,
    "classes": {"1": "wall", "2": "chair"},
    "colours": {"1": [9, 9, 9], "2": [200, 0, 0]},
}
_INTRINSICS = {
    "fx": 30.0,
    "fy": 31.0,
    "cx": 15.5,
    "cy": 11.5,
    "width": WIDTH,
    "height": HEIGHT,
    "fps": 10.0,
    "distortion": [0.01, 0.0, 0.0, 0.0, 0.0],
}
Array = NDArray[np.floating]


def rgb(index: int) -> Array:
    """Random colours [H, W, 3]."""
    return np.random.default_rng(index).uniform(size=(HEIGHT, WIDTH, 3))


def depth_m(index: int) -> Array:
    """A slanted plane [H, W]."""
    return np.tile(np.linspace(1.0, 2.0, WIDTH), (HEIGHT, 1)) + 0.1 * index


def pose(index: int) -> NDArray[np.float64]:
    """A moving and turning camera [4, 4]."""
    return se3.exp(np.array([0.1 * index, 0.0, 0.05 * index, 0.0, 0.02 * index, 0.0]))


def write_folder(folder: Path) -> None:
    """The toolkit's own layout, with labels and times."""
    (folder / "labels").mkdir(parents=True)
    for i in range(FRAMES):
        _images(folder, f"rgb/{i}.png", f"depth/{i}.png", i, 2000)
        images.write_png(folder / f"labels/{i}.png", np.full((HEIGHT, WIDTH), i, np.uint8))
    (folder / "labels/classes.json").write_text(json.dumps(_CLASSES))
    (folder / "intrinsics.yaml").write_text(yaml.safe_dump(_INTRINSICS | {"depth_scale": 2000}))
    (folder / "timestamps.txt").write_text("".join(f"{i} {i / 10}\n" for i in range(FRAMES)))
    poses = np.array([pose(i) for i in range(FRAMES)])
    write_tum(folder / "trajectory.txt", Trajectory(np.arange(FRAMES) / 10.0, poses))


def write_nerfstudio(folder: Path) -> None:
    """`transforms.json` with depth."""
    frames = []
    for i in range(FRAMES):
        _images(folder, f"images/{i}.png", f"depths/{i}.png", i, 1000)
        names = {"file_path": f"images/{i}.png", "depth_file_path": f"depths/{i}.png"}
        frames.append({**names, "transform_matrix": (pose(i) @ _OPENGL).tolist()})
    values = {"camera_model": "OPENCV", "w": WIDTH, "h": HEIGHT, "fl_x": 30.0, "fl_y": 31.0}
    values |= {"cx": 16.0, "cy": 12.0, "k1": 0.01, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(values))


def write_record3d(folder: Path) -> None:
    """A `.r3d` file."""
    import lzfse

    poses = [pose(i) @ _OPENGL for i in range(FRAMES)]
    metadata = {
        "w": 2 * HEIGHT,
        "h": 2 * WIDTH,
        "dw": HEIGHT,
        "dh": WIDTH,
        "fps": 30,
        "K": [60.0, 0, 0, 0, 62.0, 0, 24.0, 32.0, 1],
        "perFrameIntrinsicCoeffs": [[60.0, 62.0, 24.0, 32.0]] * FRAMES,
        "frameTimestamps": [5.0 + 0.04 * i for i in range(FRAMES)],
        "poses": [[*se3.quaternion_xyzw(T[:3, :3]), *T[:3, 3]] for T in poses],
    }
    with zipfile.ZipFile(folder / "walk.r3d", "w") as archive:
        for i in range(FRAMES):
            jpeg = cv2.imencode(".jpg", np.full((WIDTH * 2, HEIGHT * 2, 3), 10 * i, np.uint8))[1]
            archive.writestr(f"rgbd/{i}.jpg", jpeg.tobytes())
            depth = depth_m(i).T.astype(np.float32)
            archive.writestr(f"rgbd/{i}.depth", lzfse.compress(depth.tobytes()))
            archive.writestr(f"rgbd/{i}.conf", lzfse.compress(bytes([2]) * depth.size))
        archive.writestr("metadata", json.dumps(metadata))


def write_colmap(folder: Path) -> None:
    """A binary model of COLMAP."""
    model = folder / "sparse/0"
    model.mkdir(parents=True)
    content = struct.pack("<Q", FRAMES)
    for i in range(FRAMES):
        _images(folder, f"images/{i}.png", None, i, 1)
        T = se3.inverse(pose(i))
        x, y, z, w = se3.quaternion_xyzw(T[:3, :3])
        content += struct.pack("<I7dI", i + 1, w, x, y, z, *T[:3, 3], 1) + f"{i}.png\0".encode()
        content += struct.pack("<Q2dq", 1, 1.5, 2.5, -1)
    (model / "images.bin").write_bytes(content)
    camera = struct.pack("<QiiQQ4d", 1, 1, 1, WIDTH, HEIGHT, 30, 31, 16, 12)
    (model / "cameras.bin").write_bytes(camera)


def _images(folder: Path, colour: str, depth: str | None, index: int, per_m: int) -> None:
    for name in filter(None, (colour, depth)):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
    images.write_rgb(folder / colour, rgb(index))
    if depth:
        images.write_depth_png(folder / depth, depth_m(index), per_m)


def splat_writer(name: str) -> Callable[[Path], None]:
    """Writes labelled splats in the format of a name."""

    def write(folder: Path) -> None:
        chance = np.random.default_rng(0)
        cloud = GaussianCloud.from_values(
            means=torch.tensor(chance.normal(size=(SPLATS, 3)), dtype=torch.float32),
            radii_m=torch.full((SPLATS,), 0.05),
            opacities=torch.full((SPLATS,), 0.5),
            colours=torch.tensor(chance.random((SPLATS, 3)), dtype=torch.float32),
        )
        extra = {
            "label": chance.integers(0, 6, SPLATS).astype(np.int32),
            "label_l0": chance.integers(0, 2, SPLATS).astype(np.int32),
            "confidence": chance.random(SPLATS).astype(np.float32),
        }
        taxonomy = Taxonomy(TREE, classes=CLASSES).to_json()
        export_splats(folder / name, cloud, extra, taxonomy=taxonomy)

    return write


def write_ksplat(folder: Path) -> None:
    """A `.ksplat` without quantisation, of one section."""
    rows = np.random.default_rng(0).normal(size=(SPLATS, 10)).astype("<f4")
    content = b"".join(row.tobytes() + b"\x80\x80\x80\xff" for row in rows)
    numbers = (1, 1, SPLATS, SPLATS, 0)
    header = struct.pack("<BBxxIIIIHxx12xff", 0, 1, *numbers, -1.0, 1.0).ljust(4096, b"\0")
    counts = (SPLATS, SPLATS, 0, 0, 0.0, 0, 0, len(content), 0, 0, 0)
    section = struct.pack("<IIIIfHxxIIIIH", *counts).ljust(1024, b"\0")
    (folder / "map.ksplat").write_bytes(header + section + content)


def write_run(folder: Path) -> None:
    """A finished run with classes and objects, over its recording."""
    _run(folder, ("--instances.kind", "geometric"))


def write_killed_run(folder: Path) -> None:
    """A run that still has its checkpoints."""
    from toolkit.runs.session import Session

    Session.close_results = lambda _: None  # type: ignore[method-assign, assignment]
    _run(folder, ())


def _run(folder: Path, words: tuple[str, ...]) -> None:
    from toolkit.tools.cli.main import main

    write_folder(folder / "data")
    where = os.fspath(folder / "data"), os.fspath(folder / "run")
    given = ("--dataset.kind", "folder", "--dataset.path", where[0], "--out", where[1])
    short = ("--mapping.iterations", "2", "--mapping.first-iterations", "2")
    assert main(["run", *given, "--poses", "given", *short, *words]) == 0


def write_class_lists(folder: Path) -> None:
    """Names of classes with ids and as lines, and trees over them."""
    classes = {str(k): name for k, name in enumerate(CLASSES, start=1)}
    colours = {str(k): [k, 2 * k, 3 * k] for k in range(1, 6)}
    content = {"void": 0, "classes": classes, "colours": colours}
    (folder / "classes.json").write_text(json.dumps(content))
    (folder / "names.txt").write_text("\n".join(CLASSES))
    taxonomy = Taxonomy(TREE, classes=CLASSES)
    taxonomy.save(folder / "tree.yaml")
    taxonomy.save(folder / "tree.json")


def write_shapes(folder: Path) -> None:
    """Tables of the shapes of classes."""
    rows = {name: [float(k), k / 2.0] for k, name in enumerate(CLASSES)}
    (folder / "shapes.json").write_text(json.dumps(rows))
    lines = [f"{name},{a},{b}" for name, (a, b) in rows.items()]
    (folder / "shapes.csv").write_text("class,a,b\n" + "\n".join(lines))


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
