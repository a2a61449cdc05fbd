"""`semsplat query`: query the objects of a labelled map."""

from __future__ import annotations

import json
import logging
from collections.abc import Iterator
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from toolkit.base.errors import SettingsError
from toolkit.base.printable import printable
from toolkit.io.atomic import write_text
from toolkit.io.images import write_png
from toolkit.io.length_names import LengthNames
from toolkit.io.meshes import write_mesh
from toolkit.runs.highlights import Marker, highlighted_view
from toolkit.runs.maps.finished import load_run
from toolkit.runs.maps.labelled import LabelledRun, label, load_labelled_run
from toolkit.runs.maps.meshing import MeshOptions, part_mesh, write_opaque_points
from toolkit.scene.graph.scene import SceneReader
from toolkit.scene.query import FLOOR_NAMES
from toolkit.semantics.lexicon.matching import match
from toolkit.semantics.options import ObjectOptions
from toolkit.semantics.taxonomy import Taxonomy
from toolkit.tools.cli.programs import QueryProgram
from toolkit.tools.cli.similar_objects import ranking_lines, rankings

_log = logging.getLogger(__name__)


def main(options: QueryProgram) -> int:
    """Answer a query.

    Returns:
        0.

    Raises:
        ToolkitError: there is no finished run with labels, a name matches nothing in its taxonomy,
            nothing was found, or a file cannot be written.
    """
    _check_picture(options)
    if options.encoder or options.embedding:
        return _search(options)
    labelled = load_labelled_run(options.run)
    selected = _selected(options, labelled)
    reader = _reader(options, labelled)
    names = labelled.run.length_names
    print("\n".join(_output_lines(options, reader, names)))

    gaussians = labelled.run.gaussians.select(torch.from_numpy(selected))
    # Logged to stderr: stdout may be JSON for another program.
    if options.cloud:
        points = write_opaque_points(options.cloud, gaussians, labelled.run.origin_m)
        _log.info("Wrote %d points to %s.", points, options.cloud)
    if options.mesh:
        mesh_options = MeshOptions(options.voxel_m, options.max_depth_m, options.every)
        mesh = part_mesh(labelled.run, gaussians, mesh_options)
        write_mesh(options.mesh, mesh, labelled.run.origin_m)
        _log.info("Wrote %s to %s.", mesh, options.mesh)
    if options.picture:
        image = highlighted_view(labelled.run, selected, _markers(options, reader))
        write_png(options.picture, image)
        _log.info("Wrote the picture to %s.", options.picture)
    if options.summary:
        write_text(options.summary, _json(reader.summary(), ensure_ascii=False) + "\n")
        _log.info("Wrote the scene to %s.", options.summary)
    return 0


def _check_picture(options: QueryProgram) -> None:
    """Check that a picture can be made, before the map is read."""
    if options.picture is None:
        return
    if options.picture.suffix.lower() != ".png":
        raise SettingsError(f"--picture {options.picture} must be a .png file")
    if not options.nodes or options.encoder or options.embedding:
        raise SettingsError("--picture shows classes: name some, without --encoder or --embedding")


def _markers(options: QueryProgram, reader: SceneReader) -> list[Marker]:
    """The number of each object in the table, at the centre of its box."""
    return [
        Marker(str(number), np.array(item["box"]["centre_m"]))
        for name in options.nodes
        for number, item in enumerate(reader.answer(name)["objects"], start=1)
    ]


def _search(options: QueryProgram) -> int:
    """Rank objects by their embeddings; classes with the name of a text come first."""
    run = load_run(options.run)
    file = run.folder.taxonomy
    taxonomy = Taxonomy.load(file) if file.is_file() else None
    found = rankings(options, taxonomy)
    answers: list[dict[str, Any]] = []
    if taxonomy is not None and any(map(taxonomy.find_all, options.nodes)):
        reader = _reader(options, label(run))
        named = map(reader.answer, reader.map.known(options.nodes))
        answers = [answer for answer in named if answer["gaussians"]]
    if options.json:
        print(_json([*answers, *found]))
        return 0
    for answer in answers:
        print("\n".join(_answer_lines(answer, run.length_names)))
    for ranking in found:
        print("\n".join(ranking_lines(ranking, run.length_names.length)))
    for line in run.length_names.note_lines:
        print(line)
    return 0


def _selected(options: QueryProgram, labelled: LabelledRun) -> NDArray[np.bool_]:
    """Return a mask [N] of the Gaussians that the words of the query mean."""
    selected = np.zeros(len(labelled.map), bool)
    for text in options.nodes:
        meant = match(text, labelled.map.taxonomy)
        selected |= labelled.select_meant(meant, options.min_confidence)
    return selected


def _reader(options: QueryProgram, labelled: LabelledRun) -> SceneReader:
    for name in options.floor:
        labelled.map.taxonomy.find(name)  # raises an error if the name does not exist
    poses = [frame.T_map_camera for frame in labelled.run.tracked] or [np.eye(4)]
    return SceneReader(
        labelled.map,
        ObjectOptions(options.link_m, options.min_gaussians, options.min_confidence),
        poses[0 if options.distance_from == "first" else -1][:3, 3],
        options.floor or FLOOR_NAMES,
        metric=labelled.run.metric,
    )


def _output_lines(options: QueryProgram, reader: SceneReader, names: LengthNames) -> Iterator[str]:
    """Yield the lines to print."""
    if not options.nodes:
        tree = reader.tree()
        yield from [_json(tree)] if options.json else _tree_lines(tree)
        return
    answers = [reader.answer(name) for name in options.nodes]
    if options.json:
        yield _json(answers)
        return
    for answer in answers:
        yield from _answer_lines(answer, names)
    yield from names.note_lines
    if reader.ground is None:
        yield "No floor was found: bounding boxes are not aligned with the vertical."


def _tree_lines(tree: dict[str, Any]) -> Iterator[str]:
    rows = [*_tree_rows(tree["tree"], ""), ("(no label)", tree["unlabelled"])]
    width = max(len(name) for name, _ in rows)
    for name, count in rows:
        percent = 100.0 * count / max(tree["gaussians"], 1)
        yield f"{name:<{width}}  {count:>9}  {percent:5.1f} %"


def _tree_rows(nodes: list[dict[str, Any]], indent: str) -> Iterator[tuple[str, int]]:
    for node in nodes:
        yield indent + printable(node["name"]), node["gaussians"]
        yield from _tree_rows(node["children"], indent + "  ")


def _answer_lines(answer: dict[str, Any], names: LengthNames) -> Iterator[str]:
    objects = answer["objects"]
    area = answer["floor_area_m2"]
    floor = "" if area is None else f", {area:.2f} {names.area} of floor area"
    if "explanation" in answer:
        yield printable(f"Note: {answer['explanation']}.")
    paths = answer.get("paths", [answer["path"]])
    yield (
        f"{printable(', '.join(' > '.join(path) for path in paths))}: {answer['gaussians']} "
        f"Gaussians, confidence {100.0 * answer['confidence']:.0f} %, {len(objects)} "
        f"object(s){floor}"
    )
    length = names.length
    headings = (
        *("", "class", "Gaussians", "confidence"),
        *(f"size ({length})", f"position ({length})", f"distance ({length})"),
        f"floor area ({names.area})",
    )
    rows = [headings, *(_row(number, item) for number, item in enumerate(objects, start=1))]
    if objects:
        widths = [max(len(row[column]) for row in rows) for column in range(len(headings))]
        for row in rows:
            cells = [f"{cell:>{width}}" for cell, width in zip(row, widths, strict=True)]
            cells[1] = f"{row[1]:<{widths[1]}}"
            yield "  ".join(cells).rstrip()
    elif answer["gaussians"]:
        yield "Its Gaussians form no object; try a smaller --min-gaussians or a larger --link-m."
    yield ""


def _row(number: int, item: dict[str, Any]) -> tuple[str, ...]:
    area = item["floor_area_m2"]
    return (
        str(number),
        printable(item["name"]),
        str(item["gaussians"]),
        f"{100.0 * item['confidence']:.0f} %",
        " x ".join(f"{v:.2f}" for v in item["box"]["size_m"]),
        " ".join(f"{v:.2f}" for v in item["box"]["centre_m"]),
        f"{item['distance_m']:.2f}",
        "n/a" if area is None else f"{area:.2f}",
    )


def _json(values: Any, ensure_ascii: bool = True) -> str:
    """JSON; in ASCII for stdout, whose encoding may lack characters."""
    return json.dumps(values, indent=1, ensure_ascii=ensure_ascii, allow_nan=False)
