"""The offline grouper's answers."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from toolkit.semantics.taxonomy_building.grouper import Question
from toolkit.semantics.taxonomy_building.rules import RuleGrouper
from toolkit.semantics.taxonomy_building.vocabulary import ObjectVocabulary, built_in

WORDS = [entry.word for entry in built_in()]
NAMES = st.one_of(st.sampled_from(WORDS), st.text("abcdefg -", min_size=1, max_size=12))


def ask(items, aspect, **more):
    return RuleGrouper().group(Question(tuple(sorted(items)), aspect, **more))


def test_sizes_are_what_a_person_would_say():
    names = ["cup", "book", "pillow", "stool", "sink", "sofa", "bed", "wardrobe", "wall"]
    groups = ask(names, "size", max_groups=3)
    assert list(groups) == ["small", "medium", "large"]
    assert groups["small"] == ("book", "cup")
    assert groups["medium"] == ("pillow", "sink", "stool")
    assert groups["large"] == ("bed", "sofa", "wall", "wardrobe")


@given(st.lists(st.sampled_from(WORDS), min_size=1, max_size=60, unique=True))
def test_balance_never_moves_a_size_far(words):
    groups = ask(words, "size", max_groups=4)
    size_m = {word: built_in().look_up(word).size_m for word in words}
    for name, low, high in (
        ("small", 0.0, 0.4),
        ("medium", 0.25, 0.9),
        ("large", 0.7, 2.2),
        ("very large", 1.7, 99.0),
    ):
        assert all(low <= size_m[word] <= high for word in groups.get(name, ()))


def test_functions_are_what_a_person_would_say():
    names = ["chair", "office chair", "sofa", "dining table", "desk", "oven", "microwave", "cup"]
    groups = ask([*names, "plate", "sock", "t-shirt"], "function", max_groups=4)
    together = [set(items) for items in groups.values()]
    assert {"sock", "t-shirt"} in together
    assert any({"chair", "office chair", "sofa"} <= group for group in together)
    assert not any({"cup", "chair"} <= group for group in together)


def test_shapes_and_then_sizes_distinguish_things():
    groups = ask(["ball", "orange", "wall", "picture", "pillow"], "geometry", max_groups=4)
    assert {"ball", "orange"} in [set(items) for items in groups.values()]
    boxes = ask(["jewelry box", "shoe box", "packing box", "wardrobe"], "geometry", max_groups=4)
    assert set(boxes) == {"smaller boxy", "larger boxy"}


def test_what_does_not_differ_stays_together():
    assert len(ask(["chair", "dining chair", "desk chair"], "geometry")) == 1
    assert len(ask(["xyzzy", "foo", "zap"], "function")) == 1


def test_an_empty_vocabulary_is_not_replaced_by_the_built_in_one():
    question = Question(("cup", "wardrobe"), "size")
    assert len(RuleGrouper().group(question)) == 2
    assert len(RuleGrouper(ObjectVocabulary({})).group(question)) == 1


def test_two_groups_of_one_name_are_kept_apart():
    tree = {kind: {"1 flat": f"{kind}one, {kind}two"} for kind in "abcdefghi"}
    tree["e"] = {"1 flat": ", ".join(f"e{n}" for n in "pqrstuvwxyz")}
    vocabulary = ObjectVocabulary(tree)
    items = tuple(entry.word for entry in vocabulary)
    groups = RuleGrouper(vocabulary).group(Question(items, "function", max_groups=3))
    sizes = {name: len(members) for name, members in groups.items()}
    assert sizes == {"other": 8, "e": 11, "other 2": 8}


def test_clusters_get_names_of_their_own_and_stay_as_they_are():
    clusters = (("door", "wall"), ("floor", "rug"), ("bowl", "cup"), ("picture", "poster"))
    names = ask([i for c in clusters for i in c], "geometry", clusters=clusters)
    assert tuple(names.values()) == clusters
    first, _, third, _ = names
    assert (first, third) == ("flat", "hollow")


def test_given_names_are_the_only_ones_used():
    names = ("kitchen things", "seating", "all the rest")
    groups = ask(["chair", "sofa", "cup", "kitchen knife", "dog"], "function", groups=names)
    assert groups["seating"] == ("chair", "sofa")
    assert groups["kitchen things"] == ("cup", "kitchen knife")
    assert groups["all the rest"] == ("dog",)


@given(
    st.lists(NAMES, min_size=1, max_size=40, unique=True),
    st.sampled_from(["size", "function", "geometry"]),
    st.integers(2, 6),
    st.randoms(),
)
def test_any_names_are_grouped_completely_and_always_alike(names, aspect, most, random):
    question = Question(tuple(names), aspect, max_groups=most)
    groups = RuleGrouper().group(question)
    assert sorted(i for items in groups.values() for i in items) == sorted(names)
    assert 1 <= len(groups) <= most
    assert all(groups) and all(groups.values())
    random.shuffle(names)
    assert RuleGrouper().group(Question(tuple(names), aspect, max_groups=most)) == groups
