"""JSON and YAML of other people: what is silently wrong, or costs too much, is an error."""

from __future__ import annotations

import math
import os
from pathlib import Path

import pytest

from toolkit.io.guarded.content import DamagedError, read_content
from toolkit.io.guarded.documents import parse_json, parse_yaml, read_json, read_yaml


def laughs(levels: int) -> str:
    """A YAML text of a few lines whose aliases stand for 9 ** levels values."""
    lines = ["a0: &a0 [1, 1]"]
    lines += [f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]" for i in range(1, levels + 1)]
    return "\n".join(lines)


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ('{"fx": 1, "fx": 2}', "'fx' is given twice"),
        ("[" * 100_000, "nests too deeply"),
        ("[" * 200 + "]" * 200, "nests more than 100"),
        ('{"a": ' * 200 + "1" + "}" * 200, "nests more than 100"),
        (f"[{'9' * 400}]", "400 digits"),
        (f"[{'9' * 6000}]", "6000 digits"),
        ('["a\\u0000b"]', "NUL"),
        ('{"a\\ud800": 1}', "surrogate"),
        ('{"a": ', "Expecting value"),
        (b"\xff\xfe\x00", "decode"),
    ],
)
def test_json_that_cannot_be_used(text: str | bytes, fault: str):
    with pytest.raises(DamagedError, match=fault):
        parse_json(text)


def test_json_keeps_its_values():
    digits = "1" * 50
    text = f'{{"a": [1, -2.5e3, null, true, "x{digits}"], "b": {{"ä": {"1" * 30}}}, "c": NaN}}'
    values = parse_json(text)
    assert values["a"] == [1, -2500.0, None, True, f"x{digits}"]
    assert values["b"] == {"ä": int("1" * 30)}
    assert math.isnan(values["c"])
    assert parse_json(b'\xef\xbb\xbf{"a": 1}') == {"a": 1}
    assert parse_json("[NaN]", constant=lambda _: None) == [None]


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("fx: 1\nfy: 2\nfx: 3", "'fx' is given twice"),
        ("a: {b: 1, b: 2}", "'b' is given twice"),
        ("a: " + "[" * 5000, "nests too deeply"),
        ("a: " + "[" * 150 + "]" * 150, "nests more than 100"),
        (f"a: {'9' * 400}", "400 digits"),
        ('a: "\\0"', "NUL"),
        ("a: !!python/object/apply:os.system [true]", "could not determine"),
        ("? [a]\n: 1", r"\['a'\] cannot be a key"),
        ("a: &a [*a]", "nests more than 100"),
        (laughs(9), "more than 1,000,000 values"),
    ],
)
def test_yaml_that_cannot_be_used(text: str, fault: str):
    with pytest.raises(DamagedError, match=fault):
        parse_yaml(text)


def test_numbers_of_yaml_are_what_people_read():
    text = "a: 1:30\nb: 040\nc: 0x10\nd: -1.5e-3\ne: .inf\nf: 2020-01-01\ng: +12\nh: 0\ni: 089"
    values = parse_yaml(text)
    assert values == {
        "a": "1:30",
        "b": 40,
        "c": 16,
        "d": -0.0015,
        "e": math.inf,
        "f": "2020-01-01",
        "g": 12,
        "h": 0,
        "i": "089",
    }
    assert [type(values[k]) for k in "bcdgh"] == [int, int, float, int, int]


def test_texts_that_yaml_writes_without_quotation_marks_stay_texts():
    import yaml

    words = ["089", "1e3", "0o17", "1:30", "040", "1_000", "2020-01-01", "yes", "12e45", "~", "=x"]
    assert parse_yaml(yaml.safe_dump(words)) == words


def test_merged_mappings_may_be_overridden():
    merged = parse_yaml("x: &x {a: 1, b: 2}\ny:\n  <<: *x\n  b: 3")
    assert merged["y"] == {"a": 1, "b": 3}


def test_what_is_no_file_is_refused(tmp_path: Path):
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    for path in (pipe, Path("/dev/zero")):
        for read in (read_json, read_yaml, read_content):
            with pytest.raises(DamagedError, match="a device or a pipe"):
                read(path)
    with pytest.raises(IsADirectoryError):
        read_json(tmp_path)
    with pytest.raises(FileNotFoundError):
        read_yaml(tmp_path / "missing")


def test_large_files_are_not_read(tmp_path: Path):
    path = tmp_path / "huge.yaml"
    with path.open("wb") as file:
        file.truncate(2**30)  # without content on disk
    with pytest.raises(DamagedError, match=r"1 GB, more than 4 MB"):
        read_yaml(path)


def test_reasons_are_short_and_printable():
    with pytest.raises(DamagedError) as caught:
        parse_yaml("a: [\x1b[31m" + "x" * 10_000)
    text = str(caught.value)
    assert len(text) <= 203 and text.isprintable()


def test_answers_of_models_may_contain_any_character():
    assert parse_json('["\\u0000 \\ud800"]', any_characters=True) == ["\0 \ud800"]
