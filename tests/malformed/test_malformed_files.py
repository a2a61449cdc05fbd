"""Damaged files of datasets and runs: one line that names the file, status 2, nothing changed."""

from __future__ import annotations

import json
import re
from itertools import cycle

import corruptions as damage
import numpy as np
import pytest

from toolkit.tools.cli.main import main

JOBS = {
    "run": "run --dataset.kind folder --dataset.path data --out out",
    "given": "run --dataset.kind folder --dataset.path data --out out --poses given",
    "check-data": "check-data --kind folder --path data",
    "resume": "run --config whole.yaml --out run --resume",
    "resume killed": "run --config whole.yaml --out killed --resume",
    "extend": "run --dataset.kind folder --dataset.path data --out out --map run",
    "render": "render run --out out",
    "labels": "render run --out out --what labels",
    "trajectory": "render run --out out --trajectory run/trajectory.txt",
    "splats": "render run/map.ply --out out",
    "export": "export run --to out.ply",
    "query": "query run wall",
    "evaluate": "evaluate run --max-views 1",
    "explain-loops": "explain-loops run --out out",
    "register": "register run other --out out",
    "settings": "run --dataset.kind folder --dataset.path data --out out --config settings.yaml",
    "taxonomy": "run --dataset.kind folder --dataset.path data --out out"
    " --semantics.taxonomy run/taxonomy.yaml",
}
READERS = ["render", "export", "query", "evaluate", "explain-loops", "register", "extend"]
COLOUR = np.full((48, 64, 3), 90, np.uint8)
IMAGE = {name: damage.ANY_FILE[name] for name in ("empty", "truncated", "garbage", "directory")}
IMAGE |= {"other size": damage.image(COLOUR[:20])}

# (file, jobs that read it, corruptions). Each job meets some corruption, each corruption some job.
TARGETS = [
    (
        "data/intrinsics.yaml",
        ["run", "check-data", "check-data"],
        damage.TEXT_FILE
        | {
            "a list": damage.text("[1]"),
            "missing key": damage.edit("fx:", "gx:"),
            "negative": damage.edit("fx: ", "fx: -"),
            "NaN": damage.edit("fx: ", "fx: .nan # "),
            "text": damage.edit("cx: ", "cx: centre # "),
            "zero scale": damage.edit("depth_scale: ", "depth_scale: 0 # "),
            "zero rate": damage.edit("fps: ", "fps: 0 # "),
            "huge size": damage.edit("width: 64", "width: 99999999"),
            "infinite size": damage.edit("width: 64", "width: .inf"),
            "null": damage.edit("height: 48", "height: null"),
            "distortion": damage.edit("fps: ", "distortion: [1, 2]\nfps: "),
        },
    ),
    (
        "data/intrinsics.yaml",
        ["run"],
        {"other size": damage.edit("width: 64", "width: 32")},
    ),
    ("data/rgb/0000.png", ["run"], IMAGE),
    (
        "data/depth/0000.png",
        ["run"],
        IMAGE | {"colour": damage.image(COLOUR)},
    ),
    ("data/labels/0000.png", ["run"], IMAGE | {"colour": damage.image(COLOUR)}),
    (
        "data/labels/classes.json",
        ["check-data", "run"],
        damage.JSON_FILE
        | {
            "negative id": damage.text('{"void": 0, "classes": {"-1": "wall"}}'),
            "text id": damage.text('{"void": 0, "classes": {"one": "wall"}}'),
            "number name": damage.text('{"void": 0, "classes": {"1": 5}}'),
            "no classes": damage.text('{"void": 0}'),
        },
    ),
    (
        "data/trajectory.txt",
        ["given"],
        {name: damage.TEXT_FILE[name] for name in ("garbage", "directory", "not UTF-8", "missing")}
        | {"short line": damage.text("0 1 2 3\n"), "text": damage.text("0 a b c d e f g\n")},
    ),
    ("data/rgb", ["run", "check-data"], damage.FOLDER),
    ("data/depth", ["run"], damage.FOLDER),
    ("data/depth", ["check-data"], {"file": damage.FOLDER["file"]}),
    (
        "run/config.yaml",
        READERS,
        {n: damage.TEXT_FILE[n] for n in ("missing", "garbage", "directory", "not UTF-8")}
        | {
            "a list": damage.text("[1]"),
            "NaN": damage.text("checkpoint: {every_s: .nan}\n"),
            "wrong type": damage.text("seed: many\n"),
            "broken YAML": damage.text("seed: [1\n"),
        },
    ),
    ("run/config.yaml", ["resume"], {n: damage.TEXT_FILE[n] for n in ("missing", "garbage")}),
    (
        "run/frames.json",
        READERS,
        damage.JSON_FILE
        | {
            "no frames": damage.without_key("frames"),
            "missing key": damage.without_key("frames", 2, "gain"),
            "fewer frames": damage.without_key("frames", 0),
            "text": damage.json_value("frames", 1, "index", value="one"),
            "null": damage.json_value("keyframes", value=None),
            "NaN gain": damage.json_value("frames", 0, "gain", value=float("nan")),
            "bad camera": damage.json_value("camera", "fx", value=-1),
            "no camera": damage.json_value("camera", value="pinhole"),
            "huge camera": damage.json_value("camera", "width", value=10**9),
            "bad pose": damage.json_value("submaps", 0, "T_world_submap", value=[[0] * 4] * 4),
            "short pose": damage.json_value("submaps", 0, "T_world_submap", value=[1]),
            "negative index": damage.json_value("frames", 0, "index", value=-7),
        },
    ),
    (
        "run/trajectory.txt",
        ["render", "export", "evaluate", "trajectory"],
        damage.TEXT_FILE
        | {
            "NaN": damage.text("nan 0 0 0 0 0 0 1\n"),
            "infinite": damage.text("0 inf 0 0 0 0 0 1\n"),
            "zero quaternion": damage.text("0 0 0 0 0 0 0 0\n"),
            "short line": damage.text("0 0 0 0\n"),
            "text": damage.text("0 a b c d e f g\n"),
            "times go back": damage.text("1 0 0 0 0 0 0 1\n0 0 0 0 0 0 0 1\n"),
        },
    ),
    (
        "run/map.ply",
        ["render", "splats", "export", "query", "evaluate"],
        damage.ANY_FILE
        | {
            "not UTF-8": damage.content(b"\xff\xfe" * 50),
            "other count": damage.edit("element vertex ", "element vertex 9"),
            "missing property": damage.edit("property float opacity", "property float solidity"),
            "text": damage.text("ply\nformat ascii 1.0\nend_header\n"),
            "no Gaussians": damage.text("ply\nformat ascii 1.0\nelement vertex 0\nend_header\n"),
        },
    ),
    (
        "run/taxonomy.yaml",
        ["query", "labels", "export", "taxonomy"],
        damage.TEXT_FILE
        | {
            "a list": damage.text("[1]"),
            "other tree": damage.text("name: x\nlevels: [class]\ntree: [bed, chair]\n"),
            "deep": damage.text("[" * 300),
        },
    ),
    (
        "run/semantics/metadata.json",
        ["query", "labels", "export"],
        damage.JSON_FILE | {"other digest": damage.json_value("taxonomy", value="0")},
    ),
    (
        "run/semantics/arrays.npz",
        ["query", "labels", "export"],
        damage.ANY_FILE
        | {
            "no features": damage.array("features", None),
            "fewer features": damage.array("features", lambda a: a[:5]),
            "other channels": damage.array("features", lambda a: a[:, :2]),
            "flat": damage.array("features", np.ravel),
            "text": damage.array("features", lambda a: np.full(len(a), "x")),
        },
    ),
    (
        "run/loops.jsonl",
        ["explain-loops"],
        {n: damage.JSON_FILE[n] for n in ("garbage", "directory", "not UTF-8", "missing")}
        | {
            "a list": damage.text("[1]\n"),
            "NaN": damage.text("NaN\n"),
            "no kind": damage.text("{}\n"),
            "missing keys": damage.text('{"kind": "candidate"}\n'),
        },
    ),
    (
        "run/submaps/0000_0/metadata.json",
        ["register", "extend"],
        damage.JSON_FILE | {"empty object": damage.text("{}")},
    ),
    ("run/submaps/0000_0/arrays.npz", ["extend", "register"], damage.ANY_FILE),
    ("run/submaps", ["register", "extend"], damage.FOLDER),
    (
        "killed/checkpoint/0/metadata.json",
        ["resume killed"],
        {n: c for n, c in damage.JSON_FILE.items() if n != "missing"}
        | {
            "no threads": damage.without_key("threads"),
            "no values": damage.without_key("values"),
            "empty values": damage.json_value("values", value={}),
            "negative frame": damage.json_value("next_frame", value=-4),
            "far frame": damage.json_value("next_frame", value=10**6),
            "text frame": damage.json_value("next_frame", value="two"),
        },
    ),
    ("killed/checkpoint/0/arrays.npz", ["resume killed"], damage.ANY_FILE),
    (
        "settings.yaml",
        ["settings"],
        {n: c for n, c in damage.TEXT_FILE.items() if n not in ("empty", "truncated")}
        | {
            "a list": damage.text("[1]"),
            "unknown key": damage.text("speed: 3\n"),
            "wrong type": damage.text("mapping: 3\n"),
            "negative seed": damage.text("seed: -1\n"),
            "no frames": damage.text("max_frames: 0\n"),
            "NaN": damage.text("checkpoint: {every_s: .nan}\n"),
            "tag": damage.text("!!python/object:os.system {}\n"),
            "deep": damage.text("[" * 300),
        },
    ),
]


# Content of several files that is read as a whole, and named by its folder.
UNITS = ("run/semantics", "run/submaps/0000_0", "killed/checkpoint")
# Damage that appears as a contradiction to another file, or as a lack of content.
OTHER_NAMES = {
    "run: data/intrinsics.yaml other size": "data/depth/0000.png is 64x48 but the camera",
    "given: data/trajectory.txt missing": "poses 'given' needs poses, but data has none",
    "check-data: data/rgb file": "data/rgb contains no images",
    "run: data/depth file": "data/depth contains no .png images",
    "check-data: data/depth file": "data/depth contains no .png images",
    "taxonomy: run/taxonomy.yaml other tree": "taxonomy 'x' has no class",
    "query: run/semantics/metadata.json other digest": "run/taxonomy.yaml is not the taxonomy",
}


def cases():
    for file, jobs, corruptions in TARGETS:
        for job, (name, corruption) in zip(
            cycle(jobs), _at_least(corruptions, len(jobs)), strict=False
        ):
            case = f"{job}: {file} {name}"
            yield pytest.param(job, file, corruption, OTHER_NAMES.get(case), id=case)


def _at_least(corruptions: dict, count: int) -> list:
    items = list(corruptions.items())
    return items * (1 + (count - 1) // len(items))


@pytest.mark.parametrize(("job", "file", "corruption", "other_name"), list(cases()))
def test_a_damaged_file_is_named(place, refused, job, file, corruption, other_name):
    corruption(place / file)
    line = refused(*JOBS[job].split())
    if other_name is None:
        assert is_named(file, line)
    else:
        assert other_name in line


@pytest.mark.parametrize(
    ("file", "name"),
    [
        *(("data/rgb/0003.png", name) for name in ("empty", "truncated", "other size")),
        *(("data/depth/0004.png", name) for name in ("garbage", "directory")),
    ],
)
def test_a_run_continues_without_a_damaged_frame(place, monkeypatch, caplog, file, name):
    monkeypatch.chdir(place)
    IMAGE[name](place / file)
    assert main(JOBS["run"].split()) == 0
    assert is_named(file, caplog.text)
    states = json.loads((place / "out/frames.json").read_text())["states"]
    assert [state["state"] for state in states].count("lost") == 1
    assert (place / "out/metrics.json").is_file()


def is_named(file: str, line: str) -> bool:
    """Whether a message has the path of a file, of its unit, or its folder and then its name."""
    folder, _, name = (re.escape(part) for part in file.rpartition("/"))
    paths = [file, *(unit for unit in UNITS if file.startswith(unit))]
    separate = re.search(rf"(^|\s){folder}\b.*\s{name}\b", line)
    return separate is not None or any(path in line for path in paths)
