"""Whole trees built by a model that lies: every class once, the same tree each time."""

from __future__ import annotations

import zlib
from pathlib import Path

import pytest
from chat_server import Behaviour, Response, fails
from fake_endpoint import honest
from test_language_model import CLASSES, INJECTIONS, LIES

from toolkit.base.errors import SettingsError
from toolkit.datasets.synthetic_rooms.vocabulary import CLASS_NAMES
from toolkit.semantics.taxonomy import Taxonomy
from toolkit.semantics.taxonomy_building.builder import BuildOptions, build_taxonomy
from toolkit.semantics.taxonomy_building.language_model.chat import ChatModel, NoModelError
from toolkit.semantics.taxonomy_building.language_model.exchanges import (
    CachedModel,
    RecordingModel,
    ReplayedModel,
)
from toolkit.semantics.taxonomy_building.language_model.grouper import LanguageModelGrouper

OBJECTS = Path(__file__).resolve().parents[3] / "benchmarks/data/objects_200.txt"


def tree(model: ChatModel, classes: tuple[str, ...] = CLASSES, seed: int = 0) -> Taxonomy:
    options = BuildOptions(rounds=2)
    return build_taxonomy(classes, LanguageModelGrouper(model, seed), options=options, seed=seed)


def moody(request: dict) -> Response:
    """A different lie for each question, the same one for the same question."""
    moods: list[Behaviour] = [honest, honest, *LIES.values()]
    return moods[zlib.crc32(request["messages"][1]["content"].encode()) % len(moods)](request)


@pytest.mark.parametrize("lie", LIES.values(), ids=LIES)
def test_whatever_the_lie_the_tree_holds_every_class_once(fake, connect, lie):
    fake.behaviours = [lie]
    first, second = (tree(connect()[0]) for _ in range(2))
    assert first.classes == CLASSES  # the constructor has checked the tree against them
    assert first == second


@pytest.mark.parametrize("lines", [CLASS_NAMES, OBJECTS.read_text().splitlines()])
def test_long_lists_and_a_moody_model(fake, connect, lines):
    classes = tuple(line for line in lines if line and not line.startswith("#"))
    assert len(classes) >= 100
    fake.behaviours = [moody]
    first, second = (tree(connect()[0], classes) for _ in range(2))
    assert first.classes == classes
    assert first == second


def test_names_that_give_orders_become_classes(fake, connect):
    harmless = tuple(name for name in INJECTIONS if ">" not in name and "\n" not in name)
    fake.behaviours = [moody]
    assert tree(connect()[0], (*CLASSES, *harmless)).classes == (*CLASSES, *harmless)


def test_a_cache_answers_the_second_time(fake, connect, tmp_path):
    first = tree(CachedModel(connect()[0], tmp_path))
    asked = len(fake.requests)
    fake.behaviours = [fails(500)]
    assert tree(CachedModel(connect()[0], tmp_path)) == first
    assert len(fake.requests) == asked > 5


def test_a_record_makes_the_same_tree_without_the_model(fake, connect, tmp_path):
    fake.behaviours = [moody]
    record = tmp_path / "record.json"
    first = tree(RecordingModel(connect()[0], record))
    asked = len(fake.requests)
    assert tree(ReplayedModel(record)) == first
    assert len(fake.requests) == asked
    with pytest.raises(SettingsError, match="has no answer"):
        tree(ReplayedModel(record), seed=1)
    with pytest.raises(SettingsError, match="has no answer"):
        tree(ReplayedModel(record), CLASSES[1:])


def test_without_the_model_there_is_no_tree(fake, connect):
    fake.behaviours = [honest, fails(503)]
    with pytest.raises(NoModelError):
        tree(connect(max_attempts=2)[0])
