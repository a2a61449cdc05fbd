"""Retrieval of objects by their names against noise, wrong views and dropped views.

    python -m benchmarks.retrieval

The encoder is made on the spot: it hashes the words of a name to a vector. Takes seconds.
"""

from __future__ import annotations

import functools
import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro
from numpy.typing import NDArray

from benchmarks.report import publish
from benchmarks.results_file import RESULTS, Results, current_header
from benchmarks.tables import Metrics, Table, table_of
from toolkit.datasets.synthetic_rooms.vocabulary import CLASS_NAMES
from toolkit.io.object_embeddings import ObjectEmbeddings, unit_rows
from toolkit.scene.object_search import rank_objects
from toolkit.semantics.embedding_fusion import FusionOptions, fuse_views, view_weights
from toolkit.semantics.product_quantisation import compress

Array = NDArray[np.float64]

_SEEDS = range(3)
_DIMENSIONS = 512
_OBJECTS, _VIEWS = 200, 12
_COLOURS = ("red", "blue", "green", "white", "black", "brown")
_COLOUR_SHARE = 0.5  # length of the vector of a colour; that of a noun is 1
# Distances of the views; an object that is fully visible has this area from 1 m.
_DISTANCES_M, _FULL_AREA_PX = (0.7, 4.0), 64.0**2
_PARTS, _CODEWORDS = 64, 64
_MEASURES = (
    "toolkit/semantics/embedding_fusion.py",
    "toolkit/scene/object_search.py",
    "toolkit/semantics/product_quantisation.py",
    "toolkit/io/object_embeddings.py",
)

TEXT = f"""\
{_OBJECTS} objects have names of a colour and one of Replica's classes ("red chair"); some names
repeat. The embedding of a name is the sum of vectors that its words are hashed to ({_DIMENSIONS}
dimensions, colours of half the length), so that chairs of all colours are similar. An object has
{_VIEWS} views from {_DISTANCES_M[0]} to {_DISTANCES_M[1]} m. The embedding of a view is that of the
name plus Gaussian noise. `noise` is the length of the noise in a view with 64x64 pixels, relative
to the embedding; smaller views have more. `wrong` views show the neighbour of the object, always
the same one; `dropped` views are missing, but one remains.

The query is each name. `recall@1` is the share of the names whose most similar object has this
name, `mAP` the mean average precision, `similarity` the mean cosine of the fused embedding and that
of the right name. `largest view` uses the view with the greatest weight alone,
`mean` all views equally, `weighted` by area and distance, `robust` without the views that disagree.
Medians of {len(_SEEDS)} seeds, in percent."""


@dataclass(frozen=True)
class Options:
    """Measure the retrieval of objects by name."""

    out: Path = RESULTS
    """Folder of the results file."""


@dataclass(frozen=True)
class Case:
    """Conditions of the views.

    Attributes:
        noise: length of the noise in a large view, relative to the embedding.
        wrong: share of the views that show the neighbour.
        dropped: share of the views that are missing.
    """

    noise: float = 0.5
    wrong: float = 0.0
    dropped: float = 0.0

    @property
    def name(self) -> str:
        """Name of the row."""
        return f"noise {self.noise:g}, {self.wrong:.0%} wrong, {self.dropped:.0%} dropped"


@dataclass(frozen=True)
class Views:
    """Views of one object: embeddings [V, D] and weights [V]."""

    embeddings: Array
    weights: Array


Fusion = Callable[[Views], NDArray[np.floating]]


def _largest(views: Views) -> NDArray[np.floating]:
    return unit_rows(views.embeddings[[np.argmax(views.weights)]])[0]


def _fused(views: Views, weighted: bool, robust: bool) -> NDArray[np.floating]:
    weights = views.weights if weighted else None
    fused = fuse_views(views.embeddings, weights, FusionOptions(robust=robust))
    assert fused is not None
    return fused.embedding


METHODS: dict[str, Fusion] = {
    "largest view": _largest,
    "mean": functools.partial(_fused, weighted=False, robust=False),
    "weighted": functools.partial(_fused, weighted=True, robust=False),
    "robust": functools.partial(_fused, weighted=True, robust=True),
}
METRICS = {"recall@1": "recall@1 (%)", "mAP": "mAP (%)", "similarity": "Similarity (%)"}
CASES = (
    *(Case(noise) for noise in (0.25, 0.5, 1.0, 2.0)),
    *(Case(wrong=wrong) for wrong in (0.1, 0.2, 0.3, 0.4)),
    *(Case(dropped=dropped) for dropped in (0.5, 0.75, 0.9)),
    Case(wrong=0.3, dropped=0.5),
)


def main() -> None:
    """Measure the tables."""
    options = tyro.cli(Options)
    rows = {case.name: [measured(case, seed) for seed in _SEEDS] for case in CASES}
    stored = stored_rows(Case(wrong=0.3))
    tables = (
        *(
            table_of(tuple(METHODS), _part(rows, metric), "views", title)
            for metric, title in METRICS.items()
        ),
        stored,
    )
    header = current_header(_SEEDS, _MEASURES)
    publish(Results("retrieval", "Objects found by name", TEXT, header, tables), options.out)


def _part(rows: dict[str, list[Metrics]], metric: str) -> dict[str, list[Metrics]]:
    return {name: [run[metric] for run in runs] for name, runs in rows.items()}


def measured(case: Case, seed: int) -> Metrics:
    """Both metrics of every method on the same views."""
    names, views = scene(case, seed)
    found = {}
    for method, fusion in METHODS.items():
        found[method] = scores(names, np.stack([fusion(v) for v in views]))
    return {
        metric: {method: values[metric] for method, values in found.items()} for metric in METRICS
    }


def stored_rows(case: Case) -> Table:
    """The robust result as it is stored: bytes per object and metrics."""
    rows: dict[str, list[Metrics]] = {"float32": [], "float16": [], f"{_PARTS} codes": []}
    for seed in _SEEDS:
        names, views = scene(case, seed)
        exact = np.stack([METHODS["robust"](v) for v in views]).astype(np.float32)
        packed = compress(exact, _PARTS, _CODEWORDS)
        forms = {
            "float32": (exact, exact.nbytes),
            "float16": (exact.astype(np.float16).astype(np.float32), exact.nbytes // 2),
            f"{_PARTS} codes": (packed.decoded(), packed.codes.nbytes + packed.codebooks.nbytes),
        }
        for name, (embeddings, size) in forms.items():
            rows[name].append({"bytes": size // len(names), **scores(names, embeddings)})
    title = f"Stored embeddings ({case.name}); codes with their codebooks"
    return table_of(("bytes", *METRICS), rows, "form", title)


def scene(case: Case, seed: int) -> tuple[list[str], list[Views]]:
    """Names of objects and their views."""
    generator = np.random.default_rng(seed)
    colours = generator.choice(_COLOURS, _OBJECTS)
    nouns = generator.choice(CLASS_NAMES, _OBJECTS)
    names = [f"{colour} {noun}" for colour, noun in zip(colours, nouns, strict=True)]
    truth = np.stack([name_embedding(name) for name in names])
    views = []
    for number in range(_OBJECTS):
        distances_m = generator.uniform(*_DISTANCES_M, _VIEWS)
        visible = generator.uniform(0.2, 1.0, _VIEWS)
        areas_px = _FULL_AREA_PX * visible / distances_m**2
        wrong = generator.permutation(_VIEWS) < round(case.wrong * _VIEWS)
        shown = np.where(wrong[:, None], truth[number - 1], truth[number])
        noise = generator.normal(0, case.noise / np.sqrt(_DIMENSIONS), shown.shape)
        embeddings = shown + noise * np.sqrt(_FULL_AREA_PX / areas_px)[:, None]
        kept = generator.permutation(_VIEWS) < max(1, round((1 - case.dropped) * _VIEWS))
        weights = view_weights(areas_px, distances_m)
        views.append(Views(unit_rows(embeddings[kept]).astype(np.float64), weights[kept]))
    return names, views


@functools.cache
def name_embedding(name: str) -> NDArray[np.float32]:
    """The embedding [D] of a colour and a noun."""
    colour, noun = name.split(" ", 1)
    return unit_rows((_word(noun) + _COLOUR_SHARE * _word(colour))[None])[0]


def _word(word: str) -> Array:
    digest = hashlib.sha256(word.encode()).digest()
    generator = np.random.default_rng(np.frombuffer(digest, np.uint32))
    vector = generator.normal(size=_DIMENSIONS)
    return np.asarray(vector / np.linalg.norm(vector))


def scores(names: list[str], embeddings: NDArray[np.floating]) -> dict[str, float]:
    """recall@1, mean average precision and similarity to the right names, in percent."""
    count = len(names)
    objects = ObjectEmbeddings(
        np.arange(count, dtype=np.int32),
        np.zeros(count, np.int32),
        unit_rows(embeddings),
        np.ones(count, np.float32),
        "hashed names",
    )
    first, precisions = [], []
    for name in sorted(set(names)):
        ranked = rank_objects(objects, name_embedding(name), count)
        right = np.array([names[r.row] == name for r in ranked])
        first.append(right[0])
        ranks = np.flatnonzero(right) + 1
        precisions.append(np.mean(np.arange(1, len(ranks) + 1) / ranks))
    truth = np.stack([name_embedding(name) for name in names])
    return {
        "recall@1": 100 * float(np.mean(first)),
        "mAP": 100 * float(np.mean(precisions)),
        "similarity": 100 * float((truth * objects.embeddings).sum(axis=1).mean()),
    }


if __name__ == "__main__":
    main()
