"""Rankings of objects by embeddings for `semsplat query`."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toolkit.base.errors import FormatError
from toolkit.base.printable import printable
from toolkit.io.guarded.arrays import read_array
from toolkit.io.images import read_rgb
from toolkit.io.object_embeddings import OBJECTS, ObjectEmbeddings, read_objects
from toolkit.io.visualisation import colour_image
from toolkit.scene.object_search import rank_objects
from toolkit.semantics.lexicon.matching import check_query
from toolkit.semantics.taxonomy import VOID, Taxonomy
from toolkit.tools.cli.programs import QueryProgram

_DECIMALS = 4


def rankings(options: QueryProgram, taxonomy: Taxonomy | None) -> list[dict[str, Any]]:
    """Return the objects that are most similar to each text, embedding and image of a query.

    Args:
        options: the arguments of the program.
        taxonomy: classes of the objects, if the run has any.

    Raises:
        ToolkitError: the run has no embeddings, or a file, text or model does not fit to them.
    """
    path = options.run / OBJECTS
    objects = read_objects(path)
    if taxonomy is not None and objects.class_ids.max(initial=VOID) > len(taxonomy):
        raise FormatError(
            f"{path} contains class {objects.class_ids.max()}, taxonomy '{taxonomy.name}' has "
            f"{len(taxonomy)} classes; copy the file of this run there"
        )
    found = []
    for name, query, model in _queries(options):
        ranked = rank_objects(objects, query, options.top, model)
        rows = [_values(objects, r.row, r.similarity, taxonomy) for r in ranked]
        found.append({"query": name, "model": objects.model, "of": len(objects), "ranking": rows})
    return found


def ranking_lines(ranking: dict[str, Any], length: str) -> Iterator[str]:
    """Yield the table of a ranking.

    Args:
        ranking: an element of `rankings`.
        length: name of the unit of length.
    """
    rows = ranking["ranking"]
    yield (
        f"{printable(ranking['query'])}: the {len(rows)} most similar of {ranking['of']} objects "
        f"({printable(ranking['model'])})"
    )
    table = [("", "object", "class", "similarity", f"position ({length})")]
    for number, row in enumerate(rows, start=1):
        centre_m = row["centre_m"]
        position = "n/a" if centre_m is None else " ".join(f"{v:.2f}" for v in centre_m)
        name = printable(row["name"] or "n/a")
        table.append((str(number), str(row["id"]), name, f"{row['similarity']:.3f}", position))
    if rows:
        widths = [max(len(cells[column]) for cells in table) for column in range(len(table[0]))]
        for cells in table:
            padded = [f"{cell:>{width}}" for cell, width in zip(cells, widths, strict=True)]
            padded[2] = f"{cells[2]:<{widths[2]}}"
            yield "  ".join(padded).rstrip()
    yield ""


def _queries(options: QueryProgram) -> Iterator[tuple[str, NDArray[np.floating], str | None]]:
    """Yield name, embedding [D] and model of each query."""
    for text in options.nodes:
        check_query(text)
    if options.encoder is not None:
        # Loads transformers, which takes seconds.
        from toolkit.semantics.features.pretrained.text_image import TextImageEncoder

        encoder = TextImageEncoder(options.encoder, options.device)
        for text in options.nodes:
            yield text, encoder.embed_texts([text])[0], encoder.name
        if options.image is not None:
            image = colour_image(read_rgb(options.image))
            yield options.image.name, encoder.embed_images([image])[0], encoder.name
    if options.embedding is not None:
        yield options.embedding.name, _read_embedding(options.embedding), None


def _read_embedding(path: Path) -> NDArray[np.floating]:
    try:
        array = read_array(path)
    except (OSError, ValueError) as error:
        raise FormatError(f"--embedding {path} is not a readable .npy file; check it") from error
    if array.dtype.kind != "f" or array.squeeze().ndim != 1:
        raise FormatError(f"--embedding {path} must contain one vector of floating point numbers")
    return array.squeeze()


def _values(
    objects: ObjectEmbeddings, row: int, similarity: float, taxonomy: Taxonomy | None
) -> dict[str, Any]:
    class_id = int(objects.class_ids[row])
    path: Sequence[str] = ()
    if taxonomy is not None and class_id != VOID:
        path = taxonomy.path(class_id)
    centres_m, instances = objects.centres_m, objects.instances
    return {
        "id": int(objects.ids[row]),
        "instance": None if instances is None else int(instances[row]) or None,
        "name": path[-1] if path else None,
        "path": list(path),
        "similarity": round(similarity, _DECIMALS),
        "weight": round(float(objects.weights[row]), _DECIMALS),
        "centre_m": None if centres_m is None else centres_m[row].round(_DECIMALS).tolist(),
    }
