"""The client of chat endpoints: patient where it helps, one line where it does not."""

from __future__ import annotations

import asyncio
import email.utils
import json
import logging
import sys
import time

import numpy as np
import pytest
from chat_server import Response, fails
from fake_endpoint import KEY, honest, knows_no, says

from toolkit.base.errors import DependencyError, SettingsError, ToolkitError
from toolkit.semantics.taxonomy_building.grouper import Question
from toolkit.semantics.taxonomy_building.language_model import transport
from toolkit.semantics.taxonomy_building.language_model.chat import (
    ChatAnswer,
    ModelIdentity,
    NoModelError,
)
from toolkit.semantics.taxonomy_building.language_model.endpoint import (
    Endpoint,
    endpoint_from_environment,
)
from toolkit.semantics.taxonomy_building.language_model.prompts import request_for

REQUEST = request_for(Question(("bed", "chair", "lamp"), "size"), seed=7)


def dropped(request: dict) -> Response:
    return Response(dropped=True)


def dropped_halfway(request: dict) -> Response:
    return Response("never read whole", dropped=True)


def test_a_request_asks_for_structured_reproducible_output(fake, connect):
    endpoint, waits = connect()
    answer = endpoint.complete(REQUEST)
    assert answer.ending == "stop"
    assert json.loads(answer.text)["groups"]
    assert fake.headers["authorization"] == f"Bearer {KEY}"
    (sent,) = fake.requests
    assert (sent["model"], sent["temperature"], sent["seed"]) == ("fake-1", 0, 7)
    assert sent["response_format"]["type"] == "json_schema"
    assert sent["response_format"]["json_schema"]["strict"] is True
    assert waits == []


@pytest.mark.parametrize(
    "trouble", [fails(500), fails(503), fails(429), fails(408), dropped, dropped_halfway]
)
def test_what_passes_is_tried_again_after_growing_waits(fake, connect, trouble):
    fake.behaviours = [trouble, trouble, trouble, honest]
    endpoint, waits = connect()
    assert endpoint.complete(REQUEST).ending == "stop"
    assert len(waits) == 3
    for wait_s, longest_s in zip(waits, (1.0, 2.0, 4.0), strict=True):
        assert 0.5 * longest_s <= wait_s <= longest_s


def test_waits_are_the_generators(fake, connect):
    fake.behaviours = [fails(500), fails(500), honest, fails(500), fails(500), honest]
    runs = []
    for _ in range(2):
        endpoint, waits = connect()
        endpoint.complete(REQUEST)
        runs.append(waits)
    assert runs[0] == runs[1]


def test_retry_after_is_honoured_in_seconds_and_as_a_date(fake, connect):
    date = email.utils.formatdate(time.time() + 40.0, usegmt=True)
    fake.behaviours = [fails(429, Retry_After="17"), fails(503, Retry_After=date), honest]
    endpoint, waits = connect()
    endpoint.complete(REQUEST)
    assert waits[0] == 17.0
    assert 35.0 < waits[1] <= 40.0


@pytest.mark.parametrize("nonsense", ["soon", "-5", "nan", "0", ""])
def test_a_retry_after_that_says_nothing_is_as_none(fake, connect, nonsense):
    fake.behaviours = [fails(429, Retry_After=nonsense), honest]
    endpoint, waits = connect()
    endpoint.complete(REQUEST)
    assert 0.5 <= waits[0] <= 1.0


def test_a_wait_longer_than_the_whole_time_ends_it_at_once(fake, connect):
    fake.behaviours = [fails(429, "quota", Retry_After="86400")]
    endpoint, waits = connect(total_timeout_s=60.0)
    with pytest.raises(ToolkitError, match=r"in 1 attempts.*quota.*asks to wait 86400 s"):
        endpoint.complete(REQUEST)
    assert waits == []


def test_tries_and_time_are_bounded(fake, connect):
    fake.behaviours = [fails(500)]
    endpoint, waits = connect(max_attempts=4)
    with pytest.raises(ToolkitError, match=r"no answer from fake-1 at http.* in 4 attempts"):
        endpoint.complete(REQUEST)
    assert len(fake.requests) == 4
    assert len(waits) == 3
    endpoint, waits = connect(max_attempts=1000, total_timeout_s=20.0)
    with pytest.raises(ToolkitError, match="no answer"):
        endpoint.complete(REQUEST)
    assert sum(waits) <= 20.0


@pytest.mark.parametrize(
    "late", [Response("late", delay_s=0.4), Response(body=" " * 9, trickle_s=0.04)]
)
def test_a_slow_answer_is_given_up_and_asked_for_again(fake, connect, late):
    fake.behaviours = [lambda request: late, honest]
    endpoint, waits = connect(request_timeout_s=0.1)
    assert endpoint.complete(REQUEST).text != "late"
    assert len(waits) == 1


def test_without_network_one_line_says_what_to_do():
    pytest.importorskip("openai")
    nowhere = ModelIdentity("http://127.0.0.1:9/v1", "m")
    endpoint = Endpoint(nowhere, "", np.random.default_rng(0), sleep=lambda s: None)
    with pytest.raises(ToolkitError) as error:
        endpoint.complete(REQUEST)
    message = str(error.value)
    assert "no answer from m at http://127.0.0.1:9/v1 in 6 attempts: no connection" in message
    assert "--grouper rules" in message
    assert "\n" not in message


@pytest.mark.parametrize(
    ("status", "remedy"),
    [
        (401, "SEMSPLAT_LLM_API_KEY"),
        (403, "SEMSPLAT_LLM_API_KEY"),
        (404, "--model"),
        (402, "--grouper rules"),
    ],
)
def test_what_stays_refused_is_not_tried_again(fake, connect, status, remedy):
    fake.behaviours = [fails(status, "no\n such luck")]
    endpoint, waits = connect()
    with pytest.raises(ToolkitError, match=remedy) as error:
        endpoint.complete(REQUEST)
    assert "no\\n such luck" in str(error.value)
    assert "\n" not in str(error.value)
    assert len(fake.requests) == 1
    assert waits == []


@pytest.mark.parametrize(
    ("unknown", "left"),
    [
        (("temperature",), {"seed", "response_format"}),
        (("seed", "temperature"), {"response_format"}),
        (("response_format=json_schema",), {"seed", "temperature", "response_format"}),
        (("response_format", "seed"), {"temperature"}),
    ],
)
def test_what_an_endpoint_does_not_know_is_left_out_from_then_on(fake, connect, unknown, left):
    fake.behaviours = [knows_no(*unknown)]
    endpoint, waits = connect()
    assert endpoint.complete(REQUEST).ending == "stop"
    tried = len(fake.requests)
    assert endpoint.complete(REQUEST).ending == "stop"
    assert len(fake.requests) == tried + 1
    assert set(fake.requests[-1]) == {"model", "messages", *left}
    assert waits == []


def test_a_server_error_about_the_format_is_a_refusal_of_it(fake, connect):
    broken = "response_format type must be one of text or json_object"
    fake.behaviours = [fails(500, broken), honest]
    endpoint, waits = connect()
    assert endpoint.complete(REQUEST).ending == "stop"
    assert fake.requests[-1]["response_format"] == {"type": "json_object"}
    assert waits == []


def test_too_long_for_the_model_and_refusals_are_answers(fake, connect):
    endpoint, _ = connect()
    fake.behaviours = [
        fails(400, "This model's maximum context length is 4096 tokens"),
        lambda request: Response('{"groups": [', finish="length"),
        lambda request: Response("", refusal="I cannot help with that"),
        lambda request: Response("", finish="content_filter"),
    ]
    assert endpoint.complete(REQUEST) == ChatAnswer("", "length")
    assert endpoint.complete(REQUEST) == ChatAnswer('{"groups": [', "length")
    assert endpoint.complete(REQUEST) == ChatAnswer("", "refused")
    assert endpoint.complete(REQUEST) == ChatAnswer("", "refused")


@pytest.mark.parametrize("body", ["<html>", "{}", "[]", '{"choices": []}', '{"error": "no"}', ""])
def test_what_is_no_chat_completion_ends_in_one_line(fake, connect, body):
    fake.behaviours = [lambda request: Response(body=body)]
    endpoint, _ = connect()
    with pytest.raises(ToolkitError, match="not send a chat completion"):
        endpoint.complete(REQUEST)


def test_an_error_sent_as_a_success_is_an_error(fake, connect):
    limited = json.dumps({"error": {"message": "slow down", "code": 429}})
    fake.behaviours = [lambda request: Response(body=limited), honest]
    endpoint, waits = connect()
    assert endpoint.complete(REQUEST).ending == "stop"
    assert len(waits) == 1


@pytest.mark.parametrize("trouble", [fails(401, f"bad key {KEY}"), fails(500, KEY)])
def test_the_key_is_in_no_error_and_no_log(fake, connect, caplog, trouble):
    fake.behaviours = [trouble]
    endpoint, _ = connect()
    with caplog.at_level(logging.DEBUG), pytest.raises(ToolkitError) as error:
        endpoint.complete(REQUEST)
    chain: BaseException | None = error.value
    while chain:
        assert KEY not in str(chain)
        assert chain.__cause__ is None
        chain = None if chain.__suppress_context__ else chain.__context__
    assert KEY not in caplog.text
    assert KEY not in repr(endpoint)


def test_a_key_that_comes_back_is_blotted_out(fake, connect):
    fake.behaviours = [says(f"your key is {KEY}")]
    endpoint, _ = connect()
    assert endpoint.complete(REQUEST).text == "your key is ***"


def test_it_works_where_an_event_loop_runs(fake, connect):
    endpoint, _ = connect()

    async def notebook() -> ChatAnswer:
        return endpoint.complete(REQUEST)

    assert asyncio.run(notebook()).ending == "stop"


@pytest.mark.parametrize(
    "url",
    [
        "",
        "localhost:80",
        "ftp://x/v1",
        "http://",
        "http://u:p@x/v1",
        "http://x/v1?key=1",
        "http://[",
    ],
)
def test_urls_that_cannot_be_are_refused(url):
    pytest.importorskip("openai")
    with pytest.raises(SettingsError, match="--base-url"):
        Endpoint(ModelIdentity(url, "m"), "", np.random.default_rng(0))


@pytest.mark.parametrize("key", ["tvö", "two words", "two\nlines"])
def test_keys_that_cannot_be_are_refused_unseen(key):
    pytest.importorskip("openai")
    with pytest.raises(SettingsError) as error:
        Endpoint(ModelIdentity("http://x/v1", "m"), key, np.random.default_rng(0))
    assert key not in str(error.value)


def test_without_the_package_the_remedy_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "openai", None)
    with pytest.raises(DependencyError, match=r"pip install 'semsplat\[language-model\]'"):
        Endpoint(ModelIdentity("http://x/v1", "m"), "", np.random.default_rng(0))


def test_what_is_not_given_comes_from_the_environment(fake):
    pytest.importorskip("openai")
    generator = np.random.default_rng(0)
    named = {"SEMSPLAT_LLM_BASE_URL": fake.url, "SEMSPLAT_LLM_MODEL": "m"}
    endpoint = endpoint_from_environment(
        None, None, generator, named | {"SEMSPLAT_LLM_API_KEY": KEY}
    )
    endpoint.complete(REQUEST)
    assert endpoint.identity == ModelIdentity(fake.url, "m")
    assert fake.headers["authorization"] == f"Bearer {KEY}"
    given = endpoint_from_environment("http://x/v1", "n", generator, named)
    assert given.identity == ModelIdentity("http://x/v1", "n")
    for missing in named:
        left = {name: value for name, value in named.items() if name != missing}
        with pytest.raises(SettingsError, match=missing):
            endpoint_from_environment(None, None, generator, left)


def test_the_packages_own_key_is_never_sent(fake, monkeypatch):
    pytest.importorskip("openai")
    monkeypatch.setenv("OPENAI_API_KEY", "sk-of-someone-else")
    Endpoint(ModelIdentity(fake.url, "m"), "", np.random.default_rng(0)).complete(REQUEST)
    assert "someone-else" not in str(fake.headers)


def test_an_answer_without_end_is_not_read_to_its_end(fake, connect, monkeypatch):
    monkeypatch.setattr(transport, "_MAX_RESPONSE_BYTES", 10_000)
    for status in (200, 500):
        fake.behaviours = [lambda request, s=status: Response(body=" " * 20_000, status=s)]
        endpoint, waits = connect()
        with pytest.raises(NoModelError, match=r"sent more than 9\.77 KB as an answer"):
            endpoint.complete(REQUEST)
        assert waits == []


def test_answers_that_are_compressed_unasked_are_refused(fake, connect):
    """Their length is known only once they are in memory."""
    headers = {"Content-Encoding": "gzip"}
    fake.behaviours = [lambda request: Response(body="packed", headers=headers)]
    endpoint, _ = connect()
    with pytest.raises(NoModelError, match="compresses its answers by gzip"):
        endpoint.complete(REQUEST)
    assert fake.headers["accept-encoding"] == "identity"


def test_control_characters_of_an_answer_are_escaped_in_errors(fake, connect):
    fake.behaviours = [lambda request: Response(body="\x1b[31mred")]
    endpoint, _ = connect()
    with pytest.raises(NoModelError) as raised:
        endpoint.complete(REQUEST)
    assert str(raised.value).isprintable()
