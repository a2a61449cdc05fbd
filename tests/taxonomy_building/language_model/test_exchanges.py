"""Earlier answers: cached, recorded, replayed."""

from __future__ import annotations

import json
import logging
from dataclasses import replace

import pytest
from fake_endpoint import KEY, says

from toolkit.base.errors import FormatError, RunFolderError, SettingsError
from toolkit.semantics.taxonomy_building.language_model.chat import (
    ChatAnswer,
    ChatRequest,
    ModelIdentity,
)
from toolkit.semantics.taxonomy_building.language_model.exchanges import (
    CachedModel,
    RecordingModel,
    ReplayedModel,
)

REQUEST = ChatRequest("system", "user", {"type": "object"})
OTHERS = [
    replace(REQUEST, system="x"),
    replace(REQUEST, user="x"),
    replace(REQUEST, schema={}),
    replace(REQUEST, seed=1),
    replace(REQUEST, temperature=1.0),
]


class Counter:
    """A model that answers with how often it was asked."""

    def __init__(self, url: str = "http://x/v1", model: str = "m") -> None:
        self.identity = ModelIdentity(url, model)
        self.asked = 0

    def complete(self, request: ChatRequest) -> ChatAnswer:
        self.asked += 1
        return ChatAnswer(f"answer {self.asked} \ud800", "length")


def test_a_cached_answer_is_not_asked_for_again(tmp_path):
    model = Counter()
    first = CachedModel(model, tmp_path / "deep" / "cache").complete(REQUEST)
    again = CachedModel(model, tmp_path / "deep" / "cache").complete(REQUEST)
    assert first == again == ChatAnswer("answer 1 \ud800", "length")
    assert model.asked == 1


def test_whatever_matters_is_part_of_the_key(tmp_path):
    model = Counter()
    cached = CachedModel(model, tmp_path)
    for request in (REQUEST, *OTHERS):
        cached.complete(request)
    assert model.asked == 6
    for other in (Counter(url="http://y/v1"), Counter(model="n")):
        CachedModel(other, tmp_path).complete(REQUEST)
        assert other.asked == 1
    assert len(list(tmp_path.iterdir())) == 8


@pytest.mark.parametrize("damage", ["", "{", "[]", '{"answer": {}}', '{"answer": {"text": 1}}'])
def test_a_damaged_cache_asks_again(tmp_path, caplog, damage):
    model = Counter()
    CachedModel(model, tmp_path).complete(REQUEST)
    (file,) = tmp_path.iterdir()
    file.write_text(damage)
    with caplog.at_level(logging.WARNING):
        assert CachedModel(model, tmp_path).complete(REQUEST).text == "answer 2 \ud800"
    assert "damaged" in caplog.text
    CachedModel(model, tmp_path).complete(REQUEST)
    assert model.asked == 2


def test_a_record_answers_like_the_model(tmp_path):
    record = tmp_path / "record.json"
    recording = RecordingModel(Counter(), record)
    answers = [recording.complete(request) for request in (REQUEST, *OTHERS)]
    replayed = ReplayedModel(record)
    assert [replayed.complete(request) for request in (REQUEST, *OTHERS)] == answers
    assert replayed.identity == recording.identity
    # Recorded from a replay, it is the same file.
    again = RecordingModel(replayed, tmp_path / "again.json")
    for request in (REQUEST, *OTHERS):
        again.complete(request)
    assert (tmp_path / "again.json").read_bytes() == record.read_bytes()


def test_a_record_of_an_aborted_dialogue_is_whole(tmp_path):
    recording = RecordingModel(Counter(), tmp_path / "record.json")
    recording.complete(REQUEST)
    recording.complete(OTHERS[0])
    assert ReplayedModel(tmp_path / "record.json").complete(REQUEST).text.startswith("answer 1")


def test_a_request_without_a_recorded_answer_is_an_error(tmp_path):
    RecordingModel(Counter(), tmp_path / "record.json").complete(REQUEST)
    with pytest.raises(SettingsError, match=r"record\.json has no answer .*seed.*record it again"):
        ReplayedModel(tmp_path / "record.json").complete(OTHERS[3])


@pytest.mark.parametrize("content", ["", "{}", "[]", '{"format": "x"}', "[" * 100_000, "\ud800"])
def test_what_is_no_record_is_named(tmp_path, content):
    file = tmp_path / "record.json"
    file.write_bytes(content.encode("utf-8", "surrogatepass"))
    with pytest.raises(FormatError, match=r"record\.json is not a recording.*--record"):
        ReplayedModel(file)


def test_places_that_cannot_be_are_named_before_anything_is_asked(tmp_path):
    with pytest.raises(FormatError, match="cannot be read"):
        ReplayedModel(tmp_path / "none.json")
    with pytest.raises(RunFolderError, match="cannot write"):
        RecordingModel(Counter(), tmp_path / "none" / "record.json")
    (tmp_path / "file").write_text("")
    with pytest.raises(RunFolderError, match="cannot write"):
        CachedModel(Counter(), tmp_path / "file")


def test_the_key_is_in_no_file(fake, connect, tmp_path):
    fake.behaviours = [says(f"Your key is {KEY}.")]
    endpoint, _ = connect()
    model = RecordingModel(CachedModel(endpoint, tmp_path / "cache"), tmp_path / "record.json")
    model.complete(REQUEST)
    files = [*(tmp_path / "cache").iterdir(), tmp_path / "record.json"]
    assert len(files) == 2
    for file in files:
        assert KEY not in file.read_text()
        assert "Your key is ***." in json.dumps(json.loads(file.read_text()))
