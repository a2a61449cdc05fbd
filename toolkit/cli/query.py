"""`semsplat query`: ask a labelled map what is where."""

from __future__ import annotations

import json
import logging
import math
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import torch

from toolkit.cli.arguments import parse_arguments
from toolkit.cli.programs import QueryProgram
from toolkit.errors import SettingsError
from toolkit.io.atomic import write_bytes
from toolkit.io.meshes import MESH_SUFFIXES, POINT_SUFFIXES, write_mesh
from toolkit.runs.labelled import LabelledRun, load_labelled_run
from toolkit.runs.shapes import MeshOptions, check_output, part_mesh, write_solid_points
from toolkit.semantics.query import FLOOR_NAMES, ObjectOptions
from toolkit.semantics.scene import SceneReader

_log = logging.getLogger(__name__)

_HEADINGS = ("", "what", "Gaussians", "sure", "size m", "position m", "away m", "floor m2")


def main(argv: Sequence[str]) -> int:
    """Answer a query.

    Returns:
        0.

    Raises:
        ToolkitError: there is no finished run with labels, a name is not in its tree, nothing
            was found, a value is out of range, or a file cannot be written.
    """
    program = parse_arguments(QueryProgram, argv, "query")
    _check_values(program)
    mesh_options = MeshOptions(program.voxel_m, program.max_depth_m, program.every)
    labelled = load_labelled_run(program.run)
    chosen = labelled.holding(program.nodes, program.min_confidence)
    reader = _reader(program, labelled)
    print("\n".join(_printed(program, reader)))

    gaussians = labelled.run.gaussians.select(torch.from_numpy(chosen))
    # Not printed: what is printed may be JSON that another program reads.
    if program.cloud:
        points = write_solid_points(program.cloud, gaussians)
        _log.info("wrote %d points to %s", points, program.cloud)
    if program.mesh:
        mesh = part_mesh(labelled.run, gaussians, mesh_options)
        write_mesh(program.mesh, mesh)
        _log.info("wrote %s to %s", mesh, program.mesh)
    if program.summary:
        write_bytes(program.summary, (_json(reader.summary()) + "\n").encode())
        _log.info("wrote the scene to %s", program.summary)
    return 0


def _check_values(program: QueryProgram) -> None:
    if program.nodes and program.list:
        raise SettingsError("give names or --list, not both")
    if not program.nodes and (program.cloud or program.mesh):
        raise SettingsError("--cloud and --mesh need the names of what to write")
    for option, path, suffixes in (
        ("--cloud", program.cloud, POINT_SUFFIXES),
        ("--mesh", program.mesh, MESH_SUFFIXES),
        ("--summary", program.summary, (".json",)),
    ):
        if path is not None:
            check_output(option, path, suffixes)
    if not 0.0 <= program.min_confidence <= 1.0:
        raise SettingsError(f"--min-confidence must be in [0, 1], got {program.min_confidence}")
    for name in ("link_m", "min_gaussians"):
        value = getattr(program, name)
        if not 0 < value < math.inf:
            raise SettingsError(f"--{name.replace('_', '-')} must be positive, got {value}")


def _reader(program: QueryProgram, labelled: LabelledRun) -> SceneReader:
    for name in program.floor:
        labelled.map.taxonomy.find(name)  # a name that was given must exist
    poses = [frame.T_map_camera for frame in labelled.run.tracked] or [np.eye(4)]
    return SceneReader(
        labelled.map,
        ObjectOptions(program.link_m, program.min_gaussians, program.min_confidence),
        poses[0 if program.distance_from == "first" else -1][:3, 3],
        program.floor or FLOOR_NAMES,
    )


def _printed(program: QueryProgram, reader: SceneReader) -> Iterator[str]:
    """What goes to the terminal, line by line."""
    if not program.nodes:
        tree = reader.tree()
        yield from [_json(tree)] if program.json else _tree_lines(tree)
        return
    answers = [reader.answer(name) for name in program.nodes]
    if program.json:
        yield _json(answers)
        return
    for answer in answers:
        yield from _answer_lines(answer)
    if reader.ground is None:
        yield "nothing in the map tells what is up: boxes lie as they fit best"


def _tree_lines(tree: dict[str, Any]) -> Iterator[str]:
    rows = [*_tree_rows(tree["tree"], ""), ("(no label)", tree["unlabelled"])]
    width = max(len(name) for name, _ in rows)
    for name, count in rows:
        share = 100.0 * count / max(tree["gaussians"], 1)
        yield f"{name:<{width}}  {count:>9}  {share:5.1f} %"


def _tree_rows(nodes: list[dict[str, Any]], indent: str) -> Iterator[tuple[str, int]]:
    for node in nodes:
        yield indent + node["name"], node["gaussians"]
        yield from _tree_rows(node["children"], indent + "  ")


def _answer_lines(answer: dict[str, Any]) -> Iterator[str]:
    objects = answer["objects"]
    area = answer["floor_area_m2"]
    covered = "" if area is None else f", covering {area:.2f} m2 of floor"
    yield (
        f"{' > '.join(answer['path'])}: {answer['gaussians']} Gaussians, "
        f"{100.0 * answer['confidence']:.0f} % sure, {len(objects)} object(s){covered}"
    )
    rows = [_HEADINGS, *(_row(number, found) for number, found in enumerate(objects, start=1))]
    if objects:
        widths = [max(len(row[column]) for row in rows) for column in range(len(_HEADINGS))]
        for row in rows:
            cells = [f"{cell:>{width}}" for cell, width in zip(row, widths, strict=True)]
            cells[1] = f"{row[1]:<{widths[1]}}"
            yield "  ".join(cells).rstrip()
    yield ""


def _row(number: int, found: dict[str, Any]) -> tuple[str, ...]:
    area = found["floor_area_m2"]
    return (
        str(number),
        found["name"],
        str(found["gaussians"]),
        f"{100.0 * found['confidence']:.0f} %",
        " x ".join(f"{v:.2f}" for v in found["box"]["size_m"]),
        " ".join(f"{v:.2f}" for v in found["box"]["centre_m"]),
        f"{found['distance_m']:.2f}",
        "n/a" if area is None else f"{area:.2f}",
    )


def _json(values: Any) -> str:
    return json.dumps(values, indent=1, ensure_ascii=False, allow_nan=False)
