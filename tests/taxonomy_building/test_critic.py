"""The critic: a grouper may lie in every way, the groups are right all the same."""

from __future__ import annotations

import logging

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from toolkit.base.errors import ToolkitError
from toolkit.semantics.taxonomy_building.critic import settle
from toolkit.semantics.taxonomy_building.grouper import Grouping, InvalidAnswerError, Question
from toolkit.semantics.taxonomy_building.names import Matcher, clean_label, distinct, fold

ITEMS = ("base-cabinet", "bed", "chair", "lamp", "shelf", "sofa")
QUESTION = Question(ITEMS, "function")


class Answers:
    """A grouper that gives prepared answers, and keeps the questions."""

    def __init__(self, *answers: Grouping | Exception) -> None:
        self._answers = list(answers)
        self.questions: list[Question] = []
        self.complaints: list[str] = []

    def group(self, question: Question, complaint: str = "") -> Grouping:
        self.questions.append(question)
        self.complaints.append(complaint)
        answer = self._answers[min(len(self.questions), len(self._answers)) - 1]
        if isinstance(answer, Exception):
            raise answer
        return answer


class Halves:
    """A fallback that cuts the alphabet in two."""

    def group(self, question: Question, complaint: str = "") -> Grouping:
        first, second = question.groups[:2] if len(question.groups) > 1 else ("first", "second")
        if question.clusters:
            return {f"shape {i}": c for i, c in enumerate(question.clusters, start=1)}
        middle = (len(question.items) + 1) // 2
        return {first: question.items[:middle], second: question.items[middle:]}


class Untouched:
    """A fallback that must not be asked."""

    def group(self, question: Question, complaint: str = "") -> Grouping:
        raise AssertionError("the fallback was asked")


def test_a_right_answer_stays_as_it_is(caplog):
    right = {"seats": ("sofa", "chair"), "rest": ("bed", "lamp", "shelf", "base-cabinet")}
    grouper = Answers(right)
    with caplog.at_level(logging.INFO):
        settled = settle(QUESTION, grouper, Untouched())
    assert settled == {
        "seats": ("chair", "sofa"),
        "rest": ("base-cabinet", "bed", "lamp", "shelf"),
    }
    assert list(settled) == ["seats", "rest"]
    assert len(grouper.questions) == 1
    assert not caplog.records


def test_names_written_otherwise_are_put_back_and_inventions_dropped(caplog):
    answer = {
        "Storage": ("Base Cabinets", "SHELVES", "wardrobe"),
        "seats": (" chair ", "sofas"),
        "sleep": ("Bed", "lamp", "dragon"),
    }
    with caplog.at_level(logging.INFO):
        settled = settle(QUESTION, Answers(answer), Untouched())
    assert settled == {
        "Storage": ("base-cabinet", "shelf"),
        "seats": ("chair", "sofa"),
        "sleep": ("bed", "lamp"),
    }
    assert len(caplog.records) == 1
    assert "2 invented (wardrobe, dragon)" in caplog.text
    assert "Base Cabinets -> base-cabinet" in caplog.text


def test_of_two_places_the_first_counts():
    answer = {"a": ("bed", "chair", "bed", "lamp"), "b": ("chair", "sofa", "shelf", "base cabinet")}
    settled = settle(QUESTION, Answers(answer), Untouched())
    assert settled["a"] == ("bed", "chair", "lamp")
    assert settled["b"] == ("base-cabinet", "shelf", "sofa")


def test_only_what_was_left_out_is_asked_again():
    grouper = Answers(
        {"seats": ("chair", "sofa"), "storage": ("shelf",)},
        {"Storage": ("base-cabinet",), "sleep": ("bed", "lamp")},
    )
    settled = settle(QUESTION, grouper, Untouched())
    assert settled == {
        "seats": ("chair", "sofa"),
        "storage": ("base-cabinet", "shelf"),
        "sleep": ("bed", "lamp"),
    }
    assert grouper.questions[1].items == ("base-cabinet", "bed", "lamp")
    assert 'so far: ["seats", "storage"]' in grouper.complaints[1]


def test_rounds_are_bounded_and_the_fallback_puts_the_rest_where_its_kin_are(caplog):
    grouper = Answers({"x": ("base-cabinet", "bed"), "y": ("sofa", "lamp")})
    settled = settle(QUESTION, grouper, Halves(), rounds=4)
    assert len(grouper.questions) == 4
    # The fallback has chair with base-cabinet and bed, shelf with sofa and lamp.
    assert settled == {"x": ("base-cabinet", "bed", "chair"), "y": ("lamp", "shelf", "sofa")}
    assert caplog.records[-1].levelno == logging.WARNING
    assert "2 by fallback (chair, shelf)" in caplog.text


def test_no_complaint_is_made_twice():
    grouper = Answers({})
    settle(QUESTION, grouper, Halves(), rounds=5)
    assert len(set(grouper.complaints)) == 5


def test_one_group_of_everything_is_refused():
    two = {"a": ITEMS[:2], "b": ITEMS[2:]}
    grouper = Answers({"all": ITEMS}, two)
    assert settle(QUESTION, grouper, Untouched()) == two
    assert grouper.questions[1] == QUESTION
    assert "at least two" in grouper.complaints[1]
    # Nor may it come about in pieces, or with the fallback's help.
    pieces = Answers({"all": ITEMS[:4]}, {"all": ITEMS[4:]}, {"all": ITEMS[:5]})
    assert len(settle(QUESTION, pieces, Halves())) == 2


def test_one_group_stays_where_the_fallback_sees_no_difference():
    everything = Answers({"all": ITEMS})
    assert settle(QUESTION, everything, Answers({"things": ITEMS})) == {"things": ITEMS}


def test_surplus_groups_are_refused_the_small_ones():
    question = Question(ITEMS, "function", max_groups=2)
    grouper = Answers(
        {"a": ("bed",), "b": ("chair", "sofa"), "c": ("lamp", "shelf"), "d": ("base-cabinet",)},
        {"c": ("base-cabinet",), "b": ("bed",)},
    )
    settled = settle(question, grouper, Untouched())
    assert settled == {"b": ("bed", "chair", "sofa"), "c": ("base-cabinet", "lamp", "shelf")}
    assert grouper.questions[1].groups == ("b", "c")


@pytest.mark.parametrize(
    ("written", "used"),
    [
        ("chair", "chair group"),
        ("CHAIR", "CHAIR group"),
        ("Void", "Void group"),
        ("a > b", "a b"),
        ("soft\u202e\x07\nthings", "soft things"),
        ("x" * 200, "x" * 60),
    ],
)
def test_names_of_groups_become_fit_for_a_path(written, used):
    settled = settle(QUESTION, Answers({written: ITEMS[:3], "rest": ITEMS[3:]}), Untouched())
    assert list(settled) == [used, "rest"]


@pytest.mark.parametrize("written", ["", " \t", ">", "\x00", "\ud800", "\ue000", "--"])
def test_a_group_without_a_name_is_refused(written):
    named = {"named": ITEMS[:3], "rest": ITEMS[3:]}
    grouper = Answers({written: ITEMS[:3], "rest": ITEMS[3:]}, {"named": ITEMS[:3]})
    assert settle(QUESTION, grouper, Untouched()) == named


def test_no_group_is_called_like_a_class_however_classes_are_called():
    question = Question(("-", "chair", "chair-group", "other"), "function")
    answer = {"Chair": ("chair", "chair group"), "Other": ("other", "-")}
    settled = settle(question, Answers(answer), Untouched())
    assert settled == {"Chair group 2": ("chair", "chair-group"), "Other group": ("-", "other")}
    # Nor may what the critic itself comes up with be.
    nothing = Answers({})
    assert settle(question, nothing, nothing) == {"other group": question.items}


def test_equal_names_are_one_group_and_empty_groups_do_not_count():
    answer = {"Seats": ("chair",), "none": (), "seats ": ("sofa",), "rest": ("bed", "lamp")}
    answer |= {"SEATS": ("shelf", "base-cabinet")}
    settled = settle(QUESTION, Answers(answer), Untouched())
    assert list(settled) == ["Seats", "rest"]


def test_given_names_are_kept_to_the_letter_and_in_their_order():
    question = Question(ITEMS, "size", groups=("small", "medium", "large"))
    grouper = Answers(
        {"Large": ("bed", "sofa"), "tiny": ("lamp",), "small": ("chair",)},
        {"small": ("lamp",), "LARGE": ("shelf", "base-cabinet")},
    )
    settled = settle(question, grouper, Untouched())
    assert list(settled.items()) == [
        ("small", ("chair", "lamp")),
        ("large", ("base-cabinet", "bed", "shelf", "sofa")),
    ]


def test_useless_answers_are_asked_again_and_missing_ones_end_it():
    refusal = InvalidAnswerError("the model refused")
    two = {"a": ITEMS[:2], "b": ITEMS[2:]}
    grouper = Answers(refusal, two)
    assert settle(QUESTION, grouper, Untouched()) == two
    assert "the model refused" in grouper.complaints[1]
    assert len(settle(QUESTION, Answers(refusal), Halves())) == 2
    with pytest.raises(ToolkitError, match="no network"):
        settle(QUESTION, Answers(ToolkitError("no network")), Halves())


CLUSTERS = (("bed", "sofa"), ("chair", "lamp", "shelf"), ("base-cabinet",))
SHAPES = Question(ITEMS, "geometry", clusters=CLUSTERS)


def test_clusters_stay_and_take_the_names_of_the_majority():
    answer = {
        "flat": ("beds", "sofa", "lamp"),
        "thin": ("chair", "shelf"),
        "box": ("Base cabinet",),
    }
    settled = settle(SHAPES, Answers(answer), Untouched())
    assert settled == dict(zip(("flat", "thin", "box"), CLUSTERS, strict=True))


def test_clusters_without_a_name_of_their_own_are_asked_again():
    grouper = Answers({"flat": ITEMS}, {"Flat": ("bed",), "box": ("base-cabinet",)}, {})
    settled = settle(SHAPES, grouper, Answers({"flat": ("bed", "sofa")}))
    assert settled == {"flat 2": CLUSTERS[0], "flat": CLUSTERS[1], "box": CLUSTERS[2]}
    assert grouper.questions[1].clusters == (CLUSTERS[0], CLUSTERS[2])
    assert grouper.questions[1].items == ("base-cabinet", "bed", "sofa")
    assert grouper.questions[2].clusters == (CLUSTERS[0],)


names = st.text(st.sampled_from("abB s-_>é椅\x00\u202e1"), min_size=1, max_size=6)
items = st.lists(names.filter(str.strip), min_size=1, max_size=12, unique_by=str.casefold)


@st.composite
def lies(draw, about: tuple[str, ...]) -> Grouping | InvalidAnswerError:
    """An answer in which anything may be wrong."""
    if draw(st.integers(0, 9)) == 0:
        return InvalidAnswerError("no JSON")
    change = st.sampled_from([str, str.upper, lambda n: n + "s", lambda n: f" {n} ", str.strip])
    written = st.one_of(
        st.sampled_from(about), st.builds(lambda n, f: f(n), st.sampled_from(about), change), names
    )
    label = st.one_of(st.sampled_from(about), names, st.just(""), st.just("large"))
    return draw(st.dictionaries(label, st.lists(written, max_size=12).map(tuple), max_size=9))


@st.composite
def dialogues(draw) -> tuple[Question, Answers, Answers]:
    """A question, a lying grouper and a lying fallback."""
    about = tuple(sorted(draw(items)))
    groups = draw(st.sampled_from([(), ("small", "medium", "large")]))
    clusters: tuple[tuple[str, ...], ...] = ()
    if draw(st.booleans()):
        cut = draw(st.integers(0, len(about)))
        clusters = tuple(c for c in (about[:cut], about[cut:]) if c)
    aspect = "geometry" if clusters else "function"
    most = draw(st.integers(2, 4))
    question = Question(about, aspect, (), () if clusters else groups, most, clusters)
    grouper = Answers(*draw(st.lists(lies(about), min_size=1, max_size=3)))
    answer = draw(lies(about).filter(lambda a: not isinstance(a, Exception)))
    return question, grouper, Answers(answer)


def is_valid(question: Question, settled: Grouping) -> None:
    held = sorted(item for group in settled.values() for item in group)
    assert held == sorted(question.items)
    assert all(settled.values())
    folded = [fold(label) for label in settled]
    assert len(set(folded)) == len(folded)
    if question.groups:
        assert [g for g in question.groups if g in settled] == list(settled)
    else:
        assert not set(folded) & {fold(item) for item in question.items}
        for label in settled:
            assert label == label.strip() != ""
            assert ">" not in label
            assert label.isprintable()
    if question.clusters:
        assert set(settled.values()) == set(question.clusters)
    else:
        assert len(settled) <= question.max_groups


@settings(max_examples=50)
@given(dialogues(), st.integers(1, 4))
def test_whatever_is_answered_every_item_is_in_one_group(dialogue, rounds):
    question, grouper, fallback = dialogue
    is_valid(question, settle(question, grouper, fallback, rounds))
    assert len(grouper.questions) <= rounds


@settings(max_examples=50)
@given(dialogues())
def test_the_same_lies_give_the_same_groups(dialogue):
    question, grouper, fallback = dialogue
    again = Answers(*grouper._answers)
    first, second = settle(question, grouper, fallback), settle(question, again, fallback)
    assert list(first.items()) == list(second.items())


@settings(max_examples=50)
@given(items, st.data())
def test_what_was_right_stays(about, data):
    about = tuple(sorted(about))
    groups = data.draw(st.lists(st.sampled_from(("X", "YY", "ZZZ")), min_size=len(about)))
    truth = {g: tuple(i for i, h in zip(about, groups, strict=False) if h == g) for g in groups}
    missing = data.draw(st.sets(st.sampled_from(about)))
    answer = {g: tuple(i for i in held if i not in missing) for g, held in truth.items()}
    if sum(map(bool, answer.values())) < 2:
        return
    question = Question(about, "function")
    settled = settle(question, Answers(answer), Answers({"W": about}))
    for label, held in answer.items():
        assert set(held) <= set(settled.get(clean_label(label), ()))


def test_names_are_found_by_the_strictest_way_that_is_unambiguous():
    matcher = Matcher(("glass", "glasses", "tv-stand", "tv stand", "knife", "candy", "vase"))
    assert matcher.find("glasses") == "glasses"
    assert matcher.find("Glass") == "glass"
    assert matcher.find("tv_stand") is None  # either could be meant
    assert matcher.find("knives") == "knife"
    assert matcher.find("Candies") == "candy"
    assert matcher.find("vases") == "vase"
    assert matcher.find("") is None


@pytest.mark.parametrize("plural", ["boxes", "benches", "shelves", "toys", "stoves", "dishes"])
def test_plurals_find_their_singular(plural):
    singular = {"boxes": "box", "benches": "bench", "shelves": "shelf", "toys": "toy"}
    word = singular.get(plural, plural[:-1] if plural == "stoves" else "dish")
    assert Matcher((word, "something else")).find(plural) == word
    assert Matcher((plural, "something else")).find(word) == plural


def test_distinct_numbers_what_is_taken():
    assert distinct("box", ["flat"]) == "box"
    assert distinct("box", ["Box", "box 2"]) == "box 3"
