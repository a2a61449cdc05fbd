"""Declared options: ranges, validation, documentation, errors."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import pytest

from toolkit.base.errors import SettingsError
from toolkit.base.options import (
    PositiveFloat,
    PositiveInt,
    Range,
    as_plain,
    field_docstrings,
    nested_options,
    validated,
)


@dataclass(frozen=True)
class _Tracking:
    """A nested group."""

    levels: Annotated[int, Range(ge=1, le=7)] = 4
    """Number of levels."""
    width: PositiveFloat | None = None
    """Width, in metres.
    It may be unset."""
    kind: Literal["dense", "sparse"] = "dense"
    """Which one."""


@dataclass(frozen=True)
class _Extended(_Tracking):
    levels: Annotated[int, Range(ge=1, le=7)] = 3
    folder: Path | None = None
    """Folder of data."""
    names: tuple[str, ...] = ()
    """Names of classes."""


@dataclass(frozen=True)
class _Settings:
    size: tuple[PositiveInt, PositiveInt] | None = None
    """Width and height."""
    tracking: _Extended = _Extended()


@pytest.mark.parametrize(
    ("interval", "text"),
    [
        (Range(ge=1), ">= 1"),
        (Range(gt=0), "> 0"),
        (Range(gt=0, lt=1), "(0, 1)"),
        (Range(ge=1, le=7), "[1, 7]"),
        (Range(lt=2), "(-inf, 2)"),
    ],
)
def test_a_range_is_shown_as_an_interval(interval, text):
    assert str(interval) == text


def test_content_becomes_options_and_options_plain_content():
    content = {"size": [4, 3], "tracking": {"folder": "data", "names": ["chair"], "width": 2}}
    settings = validated(_Settings, content)
    tracking = _Extended(width=2.0, folder=Path("data"), names=("chair",))
    assert settings == _Settings((4, 3), tracking)
    plain = as_plain(settings)
    assert plain["size"] == [4, 3]
    assert plain["tracking"]["folder"] == "data"
    assert plain["tracking"]["levels"] == 3
    assert validated(_Settings, plain) == settings


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (
            {"tracking": {"levels": 8}},
            "option 'tracking.levels': input should be less than or equal to 7, got 8",
        ),
        (
            {"tracking": {"width": float("nan")}},
            "option 'tracking.width': input should be a finite",
        ),
        ({"tracking": {"width": 0}}, "option 'tracking.width': input should be greater than 0"),
        ({"tracking": {"kind": "dens"}}, "option 'tracking.kind': input should be 'dense' or"),
        ({"tracking": 3}, "option 'tracking': input should be a dictionary"),
        ({"size": [1, 0]}, "option 'size.1': input should be greater than or equal to 1, got 0"),
        (
            {"tracking": {"level": 3}},
            "unknown option 'tracking.level'; did you mean option 'tracking.levels'?",
        ),
        ({"levels": 3}, "unknown option 'levels'; did you mean option 'tracking.levels'?"),
        ({"nothing_like_it": 3}, "unknown option 'nothing_like_it'"),
        (
            {"size": 1, "tracking": 2},
            "option 'size': input should be a valid tuple, got 1 (and 1 more)",
        ),
    ],
)
def test_invalid_content_is_named_in_one_line(content, message):
    with pytest.raises(SettingsError) as error:
        validated(_Settings, content, "config.yaml")
    assert str(error.value).startswith(f"config.yaml: {message}")
    assert "\n" not in str(error.value)


def test_an_instance_is_validated_with_all_that_it_contains():
    invalid = _Settings(tracking=_Extended(levels=0))
    with pytest.raises(SettingsError, match=r"^--tracking\.levels: input should be greater"):
        validated(_Settings, invalid, shown=lambda key: f"--{key}")


def test_docstrings_of_fields_describe_them_also_where_they_are_inherited():
    assert field_docstrings(_Extended) == {
        "levels": "Number of levels.",
        "width": "Width, in metres. It may be unset.",
        "kind": "Which one.",
        "folder": "Folder of data.",
        "names": "Names of classes.",
    }


def test_nested_options_have_dotted_keys_descriptions_and_ranges():
    options = {option.key: option for option in nested_options(_Settings)}
    assert list(options)[:3] == ["size", "tracking.levels", "tracking.width"]
    assert options["tracking.width"].description == "Width, in metres. It may be unset."
    assert options["tracking.width"].range == Range(gt=0)
    assert options["tracking.folder"].range is None


def test_paths_start_in_the_home_folder(monkeypatch):
    monkeypatch.setenv("HOME", "/home/ada")
    content = {"tracking": {"folder": "~/room", "names": ["~/name"]}}
    options = validated(_Settings, content)
    assert options.tracking.folder == Path("/home/ada/room")
    assert options.tracking.names == ("~/name",)
    for other in ("room~", "a/~/b", "~no-such-user/room"):
        content["tracking"]["folder"] = other
        assert validated(_Settings, content).tracking.folder == Path(other)
