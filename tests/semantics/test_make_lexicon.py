"""The reader of WordNet's files, from which the lexicon is made."""

from __future__ import annotations

from data_tools.lexicon_additions import INDOOR_SENSES, KINDS, NEW, SYNONYMS
from data_tools.make_lexicon import Sense, Synset, read_senses, read_synsets
from toolkit.semantics.lexicon.nouns import load_lexicon

DATA = """\
  1 This software and database is being provided to you, the LICENSEE, by
04263630 06 n 03 sofa 0 couch 0 Lounge_Chair 0 003 @ 04168419 n 0000 #m 04170059 n 0000 \
~ 03549897 n 0000 | an upholstered seat; "a | b"
"""
INDEX = """\
couch%1:06:00:: 04263630 1 5
couch%1:06:02:: 03120548 2 0
couch%2:32:00:: 00983308 1 1
lounge_chair%1:06:00:: 04263630 1 0
"""


def test_synsets_are_read_with_what_is_above_them(tmp_path):
    (tmp_path / "data.noun").write_text(DATA)
    ((offset, synset),) = read_synsets(tmp_path / "data.noun")
    assert offset == "04263630"
    words = ("sofa", "couch", "lounge chair")
    assert synset == Synset(6, words, ("04168419", "04170059"))


def test_senses_of_nouns_are_read_in_order(tmp_path):
    (tmp_path / "index.sense").write_text(INDEX)
    senses, offsets = read_senses(tmp_path / "index.sense")
    assert senses["couch"] == [Sense("04263630", 5), Sense("03120548", 0)]
    assert set(senses) == {"couch", "lounge chair"}
    assert offsets["couch%1:06:00"] == "04263630"
    assert "couch%2:32:00" not in offsets


def test_the_shipped_file_contains_the_additions():
    lexicon = load_lexicon()
    for word in (*SYNONYMS, *(noun for nouns, _ in NEW for noun in nouns)):
        assert word in lexicon, word
    for word, keys in INDOOR_SENSES.items():
        added = sum(word in nouns for nouns, _ in NEW)
        assert len(lexicon.meanings(word)) == max(1, len(keys.split()) + added), word
    for kind, parent in KINDS.items():
        below, above = (lexicon.meanings(_noun(key), first=9) for key in (kind, parent))
        assert any(set(above) & set(lexicon.ancestors(meaning)) for meaning in below), kind


def _noun(key: str) -> str:
    return key.partition("%")[0].replace("_", " ")
