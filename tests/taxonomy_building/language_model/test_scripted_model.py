"""Trees of a scripted model that makes the errors of real ones, over HTTP."""

from __future__ import annotations

import logging

import pytest
from scripted_model import (
    ANSWER_ERRORS,
    ITEM_ERRORS,
    KINDS,
    TRANSPORT_ERRORS,
    ScriptedModel,
    scripted_tree,
)
from test_language_model import CLASSES

from toolkit.datasets.synthetic_rooms.vocabulary import CLASS_NAMES
from toolkit.semantics.taxonomy import Taxonomy
from toolkit.semantics.taxonomy_building.builder import build_taxonomy
from toolkit.semantics.taxonomy_building.language_model.chat import NoModelError
from toolkit.semantics.taxonomy_building.language_model.exchanges import (
    RecordingModel,
    ReplayedModel,
)
from toolkit.semantics.taxonomy_building.language_model.grouper import LanguageModelGrouper
from toolkit.semantics.taxonomy_building.rules import RuleGrouper
from toolkit.semantics.taxonomy_building.shapes import GivenShapes

REPAIRS = "toolkit.semantics.taxonomy_building.repairs"


@pytest.fixture
def tree(fake, connect):
    """Builds the tree of a scripted model."""

    def build(scripted: ScriptedModel, classes=CLASSES, shapes=None, **retries) -> Taxonomy:
        fake.behaviours = [scripted]
        retries = {"request_timeout_s": 0.1} | retries
        grouper = LanguageModelGrouper(connect(**retries)[0])
        return build_taxonomy(classes, grouper, shapes)

    return build


def groups(taxonomy: Taxonomy) -> list[tuple[str, ...]]:
    """The paths, in an order that does not depend on that of an answer."""
    return sorted(node.path for node in taxonomy.nodes)


RULES = groups(build_taxonomy(CLASSES, RuleGrouper()))


def test_without_errors_the_tree_is_that_of_the_rules(tree):
    scripted = ScriptedModel({})
    assert groups(tree(scripted)) == RULES
    assert not +scripted.errors


@pytest.mark.parametrize("kind", [*ITEM_ERRORS, *ANSWER_ERRORS])
def test_whatever_the_error_the_tree_has_every_class_once(tree, fake, kind):
    scripted = [ScriptedModel({kind: 0.3}, seed=1) for _ in range(2)]
    # On a busy machine, an answer may take longer than the timeout that other tests wait for.
    trees = [tree(each, request_timeout_s=10.0) for each in scripted]
    # Taxonomy has compared the leaves with the classes.
    assert trees[0].classes == CLASSES
    assert trees[0] == trees[1]
    assert scripted[0].errors == scripted[1].errors
    assert set(+scripted[0].errors) == {kind}


@pytest.mark.parametrize("kind", TRANSPORT_ERRORS)
def test_requests_without_an_answer_are_repeated(tree, fake, kind, monkeypatch):
    monkeypatch.setattr("scripted_model.TIMEOUT_S", 0.1)
    scripted = ScriptedModel({kind: 0.4}, seed=1)
    too_late = kind in ("time-out", "slow")
    timeout_s = 0.1 if too_late else 10.0
    assert groups(tree(scripted, max_attempts=20, request_timeout_s=timeout_s)) == RULES
    assert scripted.errors[kind] > 0
    repeated = len(fake.requests) - len({str(r) for r in fake.requests})
    if too_late:
        # On a busy machine, an answer that should arrive in time may be late as well.
        assert repeated >= scripted.errors[kind]
    else:
        assert repeated == scripted.errors[kind]


def test_all_errors_together_and_replayed(tree, fake, connect, tmp_path, caplog):
    scripted = ScriptedModel(dict.fromkeys((*ITEM_ERRORS, *ANSWER_ERRORS), 0.1), seed=2)
    fake.behaviours = [scripted]
    record = tmp_path / "record.json"
    with caplog.at_level(logging.INFO, REPAIRS):
        model = RecordingModel(connect()[0], record)
        made = build_taxonomy(CLASS_NAMES, LanguageModelGrouper(model))
    assert "invented" in caplog.text
    assert set(+scripted.errors) == {*ITEM_ERRORS, *ANSWER_ERRORS}
    replayed = build_taxonomy(CLASS_NAMES, LanguageModelGrouper(ReplayedModel(record)))
    for name, taxonomy in (("made", made), ("replayed", replayed)):
        taxonomy.save(tmp_path / f"{name}.yaml")
    assert (tmp_path / "made.yaml").read_bytes() == (tmp_path / "replayed.yaml").read_bytes()


def test_the_model_in_this_process_gives_the_same_tree(tree):
    errors = dict.fromkeys((*ITEM_ERRORS, *ANSWER_ERRORS), 0.1)
    assert scripted_tree(CLASSES) == tree(ScriptedModel(errors))


def test_clusters_of_measured_shape_are_named(tree):
    known = [name for name in CLASSES if name[0] in "bcs"]
    shapes = GivenShapes({name: [len(name), ord(name[1])] for name in known})
    named = tree(ScriptedModel({"prose": 0.5}), shapes=shapes)
    assert named.classes == CLASSES
    assert groups(named) == groups(build_taxonomy(CLASSES, RuleGrouper(), shapes))


def test_a_model_that_never_answers_ends_in_an_error(tree):
    with pytest.raises(NoModelError, match="in 3 attempts"):
        tree(ScriptedModel({"500": 1.0}), max_attempts=3)


def test_every_kind_is_one_of_items_answers_or_requests():
    assert len(KINDS) == len(set(KINDS)) == 14
