"""Words that are no class names: what they find, the explanations, and what is refused."""

from __future__ import annotations

import pytest

from toolkit.base.errors import FormatError
from toolkit.semantics.lexicon.matching import match, selected_nodes
from toolkit.semantics.lexicon.nouns import Lexicon, forms, load_lexicon
from toolkit.semantics.taxonomy import Taxonomy
from toolkit.semantics.trees import shipped_taxonomy

ROOM = Taxonomy.flat(["chair", "sofa", "table", "cup", "base-cabinet", "tv-screen", "bike"], "room")


def names(text: str, taxonomy: Taxonomy = ROOM) -> list[str]:
    return [node.name for node in match(text, taxonomy).nodes]


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("couch", ["sofa"]),
        ("Settee", ["sofa"]),
        ("seating", ["chair", "sofa"]),
        ("furniture", ["chair", "sofa", "table", "base-cabinet"]),
        ("armchairs", ["chair"]),
        ("coffee-table", ["table"]),
        ("red mug", ["cup"]),
        ("television", ["tv-screen"]),
        ("cupboard", ["base-cabinet"]),
        ("bicycle", ["bike"]),
    ],
)
def test_a_noun_finds_classes_of_the_same_a_narrower_or_a_wider_meaning(text, found):
    assert names(text) == found


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("couch", "no class is called 'couch'; 'sofa' means the same (lexicon)"),
        ("seating", "no class is called 'seating'; it includes 'chair' and 'sofa' (lexicon)"),
        ("armchair", "no class is called 'armchair'; it is a kind of 'chair' (lexicon)"),
        ("red mug", "no class is called 'red mug'; 'mug' is a kind of 'cup' (lexicon)"),
        ("chairs", "no class is called 'chairs'; searched for 'chair'"),
        ("chair", None),
        ("Base Cabinet", None),
    ],
)
def test_the_answer_says_why(text, said):
    assert match(text, ROOM).explanation == said


def test_exact_names_come_before_meanings():
    both = Taxonomy.flat(["couch", "sofa", "chair"])
    assert names("couch", both) == ["couch"]
    assert names("settee", both) == ["couch", "sofa"]
    groups = Taxonomy({"seating": ["chair", "sofa"], "other": ["stool", "lamp"]})
    (node,) = match("seating", groups).nodes
    assert not node.leaf
    assert match("seating > chair", groups).explanation is None


def test_plurals_with_a_meaning_of_their_own_keep_it():
    assert names("clothes", Taxonomy.flat(["cloth", "clothing"])) == ["clothing"]
    assert list(forms("night tables")) == ["night tables", "night tabl", "night table"]
    assert "shelf" in forms("shelves")
    assert "glass" in forms("glasses")
    assert list(forms("glass")) == ["glass"]


def test_compounds_are_known_by_their_last_word():
    assert names("houseplant", Taxonomy.flat(["plant", "chair"])) == ["plant"]
    assert names("ball", Taxonomy.flat(["exercise-ball", "chair"])) == ["exercise-ball"]


@pytest.mark.parametrize("text", ["factory", "rodent", "matrix"])
def test_meanings_that_are_not_indoors_do_not_match(text):
    with pytest.raises(FormatError, match=text):
        match(text, Taxonomy.flat(["plant", "mouse", "table"]))


def test_what_cannot_be_matched_names_what_is_near():
    with pytest.raises(FormatError, match="means 'ottoman'; near in meaning: 'chair' and 'sofa'"):
        match("ottoman", Taxonomy.flat(["cup", "chair", "sofa"]))
    with pytest.raises(FormatError, match=r"did you mean chair\?$"):
        match("chiar", ROOM)
    with pytest.raises(FormatError, match=r"no class or group 'qwertz'.*--list"):
        match("qwertz", ROOM)


def test_ambiguous_words_are_refused():
    words = [["seat"], ["chair"], ["bank", "coin bank"], ["bank", "bench"]]
    lexicon = Lexicon(words, [[], [0], [], [0]], {"bank": [(2, 1), (3, 1)]})
    taxonomy = Taxonomy.flat(["coin bank", "bench"])
    with pytest.raises(FormatError, match="'bank' may mean 'coin bank' or 'bench'; give one of"):
        match("bank", taxonomy, lexicon)
    # The rarer meaning does not count if the other one is ten times as frequent.
    rare = Lexicon(words, [[], [0], [], [0]], {"bank": [(2, 100), (0, 90), (3, 1)]})
    assert names_with(rare, "bank", taxonomy) == ["coin bank"]


def names_with(lexicon: Lexicon, text: str, taxonomy: Taxonomy) -> list[str]:
    return [node.name for node in match(text, taxonomy, lexicon).nodes]


def test_long_and_empty_queries_are_refused_in_one_line():
    with pytest.raises(FormatError, match="has 10000 characters; give at most 200") as error:
        match("a" * 10_000, ROOM)
    assert len(str(error.value)) < 100
    with pytest.raises(FormatError, match="the query is empty"):
        match("  ", ROOM)


def test_the_shipped_graph_is_sound():
    lexicon = load_lexicon()
    (sofa,) = lexicon.meanings("sofa")
    steps = lexicon.ancestors(sofa)
    assert steps[sofa] == 0
    assert {lexicon.nouns(m)[0] for m in steps} >= {"seat", "furniture", "artifact"}
    assert lexicon.kinds(max(steps, key=steps.__getitem__)) > 1000 > lexicon.kinds(sofa)
    assert lexicon.meanings("night stand") == lexicon.meanings("nightstand") != ()
    assert lexicon.meanings("qwertz") == ()


@pytest.mark.parametrize("tree", ["replica", "nyu40", "scannet20"])
def test_every_class_of_the_shipped_trees_finds_itself(tree):
    taxonomy = shipped_taxonomy(tree)
    for name in taxonomy.classes:
        assert [node.name for node in match(name, taxonomy).nodes] == [name]


PEOPLE = Taxonomy.flat(["person", "chair", "sofa", "cup"], "room")


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("people", ["person"]),
        ("humans", ["person"]),
        ("couch", ["sofa"]),
        ("seating", ["chair", "sofa"]),
        ("cup", ["cup"]),
    ],
)
def test_words_select_classes_that_they_include(text, found, caplog):
    caplog.set_level("INFO")
    assert [node.name for node in selected_nodes([text], PEOPLE)] == found
    assert (text in caplog.text) == (text not in found)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("armchair", "it is a kind of 'chair' (lexicon); to select more than 'armchair', give 'ch"),
        ("red mug", "to select more than 'red mug', give 'cup'"),
        ("red chair", "searched for 'chair'; to select more than 'red chair', give 'chair'"),
        ("perzon", "did you mean person?"),
        ("piano", "means 'piano'; its classes are many"),
    ],
)
def test_words_do_not_select_more_than_they_mean(text, said):
    with pytest.raises(FormatError) as error:
        selected_nodes([text], PEOPLE, "its classes are many")
    assert said in str(error.value)
