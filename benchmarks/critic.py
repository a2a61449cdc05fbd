"""Trees of a scripted language model: what each kind of error costs until every class has a place.

python -m benchmarks.critic [--seeds 3]
"""

from __future__ import annotations

import contextlib
import logging
import statistics
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import tyro

from benchmarks.report import publish
from benchmarks.results_file import RESULTS, Results, current_header
from benchmarks.scripted_model import (
    ANSWER_ERRORS,
    ITEM_ERRORS,
    KINDS,
    TRANSPORT_ERRORS,
    Kind,
    ScriptedModel,
    scripted_endpoint,
)
from benchmarks.tables import Table, median_cell
from benchmarks.taxonomies import channels, check_classes, class_lists
from toolkit.semantics.taxonomy import Taxonomy
from toolkit.semantics.taxonomy_building.builder import build_taxonomy
from toolkit.semantics.taxonomy_building.grouper import Grouping, Question
from toolkit.semantics.taxonomy_building.language_model.chat import NoModelError
from toolkit.semantics.taxonomy_building.language_model.grouper import LanguageModelGrouper
from toolkit.semantics.taxonomy_building.repairs import Repairs
from toolkit.semantics.taxonomy_building.repairs import logger as repairs_logger

LIST = "objects_200"
RATES = (0.1, 0.3)
DESCRIPTION = """\
Trees of 200 object names by a scripted model behind an HTTP server of this machine
(`benchmarks/scripted_model.py`). It groups by the built-in rules and makes one kind of error at a
rate: per item (invented, omitted, duplicated, renamed), per answer (prose or a fence around the
JSON, a missing bracket or quotation mark, refusal, truncation) or per HTTP request (time-out, slow
stream, dropped connection, status 429 or 500); "all" makes every kind at a third of the rate. An
error ends the benchmark if a tree has not every class exactly once. A row is the median over the
seeds of the errors.

"requests" are HTTP requests. "repairs" are corrections of the critic, without items asked again.
"asked again" and "by the fallback" are shares of the items of all questions; the fallback is the
built-in rules. "moved" is the share of classes whose path differs from that in the tree without
errors. "no tree" counts the seeds for which six attempts at one request failed; the program then
ends with an error, or builds the tree by the rules if `--fall-back` is given."""


@dataclass(frozen=True, kw_only=True)
class Options:
    """Measure the critic."""

    seeds: int = 3
    """Seeds 0, 1, ... of the errors; a row is their median."""
    out: Path = RESULTS
    """Folder of the results file."""


@dataclass
class Session:
    """A tree and what it took.

    Attributes:
        tree: None if the model was not available.
        errors: number of errors made.
        requests: number of HTTP requests.
        items: number of items in all questions.
        repairs: of each question that needed some.
    """

    tree: Taxonomy | None = None
    errors: int = 0
    requests: int = 0
    items: int = 0
    repairs: list[Repairs] = field(default_factory=list)

    def share(self, items: int) -> float:
        """A number of items in percent of those of all questions."""
        return 100.0 * items / self.items


class _CountingGrouper:
    """Counts the items of questions that are asked for the first time."""

    def __init__(self, grouper: LanguageModelGrouper, session: Session) -> None:
        self._grouper, self._session = grouper, session

    def group(self, question: Question, complaint: str = "") -> Grouping:
        if not complaint:
            self._session.items += len(question.items)
        return self._grouper.group(question, complaint)


class _RepairsHandler(logging.Handler):
    """Collects the repairs that the critic logs."""

    def __init__(self, session: Session) -> None:
        super().__init__(logging.INFO)
        self._session = session

    def emit(self, record: logging.LogRecord) -> None:
        assert isinstance(record.args, tuple)
        self._session.repairs += [each for each in record.args if isinstance(each, Repairs)]


@contextlib.contextmanager
def _repairs_into(session: Session) -> Iterator[None]:
    """Collect the repairs that are logged within this context, and do not print them."""
    handler, level = _RepairsHandler(session), repairs_logger.level
    repairs_logger.setLevel(logging.INFO)
    repairs_logger.propagate = False
    repairs_logger.addHandler(handler)
    try:
        yield
    finally:
        repairs_logger.removeHandler(handler)
        repairs_logger.propagate = True
        repairs_logger.setLevel(level)


def session(classes: Sequence[str], rates: Mapping[Kind, float], seed: int) -> Session:
    """Build a tree by the scripted model."""
    made, scripted = Session(), ScriptedModel(rates, seed)
    with _repairs_into(made), scripted_endpoint(scripted) as (endpoint, server):
        grouper = _CountingGrouper(LanguageModelGrouper(endpoint), made)
        with contextlib.suppress(NoModelError):
            made.tree = build_taxonomy(classes, grouper)
        made.requests = len(server.requests)
    made.errors = sum(scripted.errors.values())
    return made


def row(name: str, sessions: Sequence[Session], right: Taxonomy) -> tuple[str, ...]:
    """One row of the table: the medians over finished sessions."""
    finished = [s for s in sessions if s.tree is not None]

    def median(values: Sequence[float]) -> str:
        return median_cell(values or [None])

    return (
        name,
        median([s.errors for s in finished]),
        median([s.requests for s in finished]),
        median([sum(map(_corrections, s.repairs)) for s in finished]),
        median([s.share(sum(len(r.asked_again) for r in s.repairs)) for s in finished]),
        median([s.share(sum(len(r.by_fallback) for r in s.repairs)) for s in finished]),
        median([moved(s.tree, right) for s in finished if s.tree]),
        median([channels(s.tree)[0] for s in finished if s.tree]),
        str(len(sessions) - len(finished)),
    )


def _corrections(repairs: Repairs) -> int:
    lists = (
        repairs.invalid,
        repairs.invented,
        repairs.renamed,
        repairs.repeated,
        repairs.labels,
        repairs.surplus,
    )
    return sum(map(len, lists)) + repairs.undivided


def moved(tree: Taxonomy, right: Taxonomy) -> float:
    """Percentage of classes whose path differs."""
    ids = range(1, len(right) + 1)
    return 100.0 * statistics.mean(tree.path(i) != right.path(i) for i in ids)


def rates_of(kind: str, rate: float) -> dict[Kind, float]:
    """The rate of one kind, or a third of it for all kinds."""
    if kind == "all":
        return dict.fromkeys(KINDS, rate / 3)
    return {each: rate for each in KINDS if each == kind}


def main() -> None:
    """Measure one row for each kind of error and rate."""
    options = tyro.cli(Options)
    header = current_header(range(options.seeds), ("toolkit/semantics/taxonomy_building",))
    classes = class_lists()[LIST]
    without = session(classes, {}, 0)
    assert without.tree is not None
    rows = [row("none", [without], without.tree)]
    for kind in (*ITEM_ERRORS, *ANSWER_ERRORS, *TRANSPORT_ERRORS, "all"):
        for rate in RATES:
            sessions = [session(classes, rates_of(kind, rate), s) for s in range(options.seeds)]
            for each in sessions:
                if each.tree is not None:
                    check_classes(classes, each.tree)
            rows.append(row(f"{kind}, {rate:.0%}", sessions, without.tree))
            print(*rows[-1], sep=" | ", flush=True)
    columns = (
        "error and rate",
        "errors",
        "requests",
        "repairs",
        "asked again %",
        "by the fallback %",
        "moved %",
        "one-hot",
        "no tree",
    )
    title = "Errors of a language model, corrected by the critic"
    results = Results("critic", title, DESCRIPTION, header, (Table(columns, tuple(rows)),))
    publish(results, options.out)


if __name__ == "__main__":
    main()
