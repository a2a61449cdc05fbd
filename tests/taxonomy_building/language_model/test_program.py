"""build-taxonomy with a language model, as a process of its own."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest
from chat_server import fails
from fake_endpoint import KEY, says
from programs import semsplat
from test_language_model import CLASSES, INJECTIONS
from test_trees_of_a_model import moody

from toolkit.semantics.taxonomy import Taxonomy
from toolkit.tools.cli.main import main

NAMES = (*CLASSES, INJECTIONS[0])
MODEL = ("--grouper", "language-model")


@pytest.fixture
def build(tmp_path, fake, monkeypatch) -> Callable[..., subprocess.CompletedProcess[str]]:
    """Runs the program in a scratch folder that holds names.txt."""
    pytest.importorskip("openai")
    for name in [name for name in os.environ if name.startswith("SEMSPLAT_LLM")]:
        monkeypatch.delenv(name)
    (tmp_path / "names.txt").write_text("\n".join(NAMES))

    def run(*words: str, **environment: str) -> subprocess.CompletedProcess[str]:
        program = ("--verbose", "build-taxonomy", "--classes", "names.txt")
        return semsplat(*program, *words, cwd=tmp_path, env=environment)

    return run


def test_a_tree_is_built_recorded_and_replayed_and_the_key_is_nowhere(build, fake, tmp_path):
    fake.behaviours = [fails(429, f"{KEY} is too eager", Retry_After="0"), moody]
    done = build(
        *(*MODEL, "--out", "tree.yaml", "--cache", "cache", "--record", "record.json"),
        SEMSPLAT_LLM_BASE_URL=fake.url,
        SEMSPLAT_LLM_MODEL="fake-1",
        SEMSPLAT_LLM_API_KEY=KEY,
    )
    assert done.returncode == 0, done.stderr
    assert fake.headers["authorization"] == f"Bearer {KEY}"
    tree = Taxonomy.load(tmp_path / "tree.yaml")
    assert tree.classes == NAMES
    assert "*** is too eager" in done.stderr

    asked = len(fake.requests)
    words = (*MODEL, "--base-url", fake.url, "--model", "fake-1", "--cache", "cache")
    assert build(*words, "--out", "again.yaml").returncode == 0
    offline = build(*MODEL, "--replay", "record.json", "--out", "replayed.yaml")
    assert offline.returncode == 0, offline.stderr
    assert len(fake.requests) == asked
    assert Taxonomy.load(tmp_path / "again.yaml") == tree
    assert Taxonomy.load(tmp_path / "replayed.yaml") == tree

    written = [file.read_text() for file in tmp_path.rglob("*") if file.is_file()]
    assert len(written) > 6
    for text in (*written, done.stdout, done.stderr, offline.stderr):
        assert KEY not in text


def test_without_a_model_it_ends_or_falls_back_where_asked(build, fake, tmp_path):
    fake.behaviours = [fails(401, f"Incorrect API key provided: {KEY}")]
    words = (*MODEL, "--base-url", fake.url, "--model", "m", "--out", "tree.yaml")
    done = build(*words, SEMSPLAT_LLM_API_KEY=KEY)
    assert done.returncode == 2
    assert done.stderr.splitlines()[-1].startswith(
        f"semsplat: error: m at {fake.url} refused, status 401"
    )
    assert "check the key in SEMSPLAT_LLM_API_KEY" in done.stderr
    assert KEY not in done.stderr + done.stdout
    assert not (tmp_path / "tree.yaml").exists()
    done = build(*words, "--fall-back")
    assert done.returncode == 0
    assert "the taxonomy is built by rules instead" in done.stderr
    assert Taxonomy.load(tmp_path / "tree.yaml").classes == NAMES


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ((), "needs --base-url or SEMSPLAT_LLM_BASE_URL"),
        (("--base-url", "{url}"), "needs --model or SEMSPLAT_LLM_MODEL"),
        (("--base-url", "localhost", "--model", "m"), "must be http://"),
        (("--replay", "none.json"), "none.json: cannot be read"),
        (("--replay", "names.txt"), "names.txt is not a recording of a language model"),
        (("--replay", "none.json", "--cache", "c"), "--cache cannot be used with it"),
        (("--base-url", "{url}", "--model", "m", "--record", "none/r"), "cannot write none/r"),
    ],
)
def test_bad_options_end_in_one_line(tmp_path, monkeypatch, fake, capsys, words, message):
    pytest.importorskip("openai")
    monkeypatch.chdir(tmp_path)
    for name in ("BASE_URL", "MODEL", "API_KEY"):
        monkeypatch.delenv(f"SEMSPLAT_LLM_{name}", raising=False)
    Path("names.txt").write_text("\n".join(NAMES), encoding="utf-8")
    given = [word.format(url=fake.url) for word in words]
    assert main(["build-taxonomy", "--classes", "names.txt", "--review", *MODEL, *given]) == 2
    printed = capsys.readouterr()
    assert message in printed.err
    assert len(printed.err.strip().splitlines()) == 1
    assert fake.requests == []


def test_a_replay_of_other_classes_is_an_error(tmp_path, monkeypatch, fake, capsys):
    monkeypatch.chdir(tmp_path)
    fake.behaviours = [says("{}")]
    Path("names.txt").write_text("\n".join(NAMES), encoding="utf-8")
    words = ["build-taxonomy", "--classes", "names.txt", "--review", *MODEL]
    source = ["--base-url", fake.url, "--model", "m", "--record", "record.json"]
    assert main([*words, *source]) == 0
    assert main([*words, "--replay", "record.json"]) == 0
    Path("names.txt").write_text("\n".join(NAMES[1:]), encoding="utf-8")
    capsys.readouterr()
    assert main([*words, "--replay", "record.json"]) == 2
    assert "record.json has no answer" in capsys.readouterr().err
    record = Path("record.json").read_bytes()
    for damaged in (record[: len(record) // 2], b'{"messages": []}', b"\x1f\x8b" + record):
        Path("record.json").write_bytes(damaged)
        assert main([*words, "--replay", "record.json"]) == 2
        (line,) = capsys.readouterr().err.strip().splitlines()
        assert "record.json is not a recording of a language model" in line
