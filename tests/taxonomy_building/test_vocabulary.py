"""What the offline rules know of names, above all of names they never saw."""

from __future__ import annotations

import difflib
import random
from collections import Counter

import pytest

from toolkit.semantics.taxonomy_building.vocabulary import SHAPES, UNKNOWN, built_in


@pytest.fixture(scope="module")
def vocabulary():
    return built_in()


@pytest.mark.parametrize(
    ("name", "word"),
    [
        ("chair", "chair"),
        ("Kitchen Cabinets", "kitchen cabinet"),
        ("tv-stand", "tv stand"),
        ("TVStand", "tv stand"),
        ("night stand", "nightstand"),
        ("bath_tub", "bathtub"),
        ("chair 2", "chair"),
        ("lamp_03", "lamp"),
        ("knives", "knife"),
        ("shelves", "shelf"),
        ("mice", "mouse"),
        ("boxes", "box"),
        ("an extremely comfortable office chair", "office chair"),
        ("old oak bookrack", "rack"),
        ("otherfurniture", "furniture"),
        ("refridgerator", "refrigerator"),
        ("set of clothing", "set of clothing"),
        ("stack of books", "book"),
        ("bottle of water", "bottle"),
        ("jacket hanging on door", "jacket"),
        ("monitor (computer equipment)", "monitor"),
        ("Ölgemälde painting", "painting"),
    ],
)
def test_a_name_is_known_by_its_ending(vocabulary, name, word):
    assert vocabulary.look_up(name).word.replace(" ", "") == word.replace(" ", "")


@pytest.mark.parametrize(
    ("name", "function"),
    [
        ("toy dinosaur", "toys and games"),
        ("toy fire engine", "toys and games"),
        ("soap holder", "hygiene"),
        ("sofa cover", "bedding"),
        ("wine bottle holder", "tableware"),
        ("kitchen whatsit", "cookware"),
        ("quiche (food)", "food and drink"),
    ],
)
def test_parts_toys_and_unknown_things_have_the_function_in_their_name(vocabulary, name, function):
    assert vocabulary.look_up(name).function[-1] == function


@pytest.mark.parametrize("name", ["", "xyzzy", "42", "(", "of", "---", "字", "the of for"])
def test_the_unknown_is_medium_and_other(vocabulary, name):
    assert vocabulary.look_up(name) == UNKNOWN
    assert UNKNOWN.function == ("other",)


def test_adjectives_change_the_size(vocabulary):
    plain, small, large = (
        vocabulary.look_up(n).size_m for n in ("chest", "tiny chest", "huge chest")
    )
    assert small < plain < large


def test_the_file_is_sound(vocabulary):
    entries = list(vocabulary)
    assert len(entries) > 2000
    assert {e.shape for e in entries} == set(SHAPES)
    assert all(0.01 < e.size_m < 20 and e.function for e in entries)
    repeated = [w for w, n in Counter(e.word for e in entries).items() if n > 1]
    assert not repeated
    for entry in entries:  # every word finds itself
        assert vocabulary.look_up(entry.word) == entry


def test_no_word_stands_in_two_places():
    from importlib import resources

    import yaml

    words: Counter[str] = Counter()

    def count(tree):
        for value in tree.values():
            if isinstance(value, dict):
                count(value)
            else:
                words.update(w.strip().replace(" ", "") for w in value.split(","))

    folder = resources.files("toolkit.semantics.taxonomy_building")
    count(yaml.safe_load((folder / "vocabulary.yaml").read_text("utf-8")))
    assert [w for w, n in words.items() if n > 1] == []


def test_misspelt_names_are_found_as_by_comparing_all_words():
    """Most words are not compared, because they share too few letters."""
    words = list(built_in()._entries)
    chance = random.Random(0)
    for word in chance.sample(words, 60):
        letters = list(word)
        for _ in range(chance.randint(1, 3)):
            letters[chance.randrange(len(letters))] = chance.choice("aeinrst")
        changed = "".join(letters)
        expected = difflib.get_close_matches(changed, words, n=1, cutoff=0.88)
        assert built_in()._spellings.closest(changed) == (expected[0] if expected else None)
