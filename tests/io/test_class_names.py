"""Names of classes in `classes.json`."""

from __future__ import annotations

import json

import pytest

from toolkit.base.errors import DatasetError
from toolkit.io.class_names import read_class_names


def test_a_file_without_classes_is_refused(tmp_path):
    path = tmp_path / "classes.json"
    path.write_text(json.dumps({"void": 0, "classes": {}}))
    with pytest.raises(DatasetError, match=r"classes\.json names no classes; add those"):
        read_class_names(path)


@pytest.mark.parametrize(
    ("name", "fault"),
    [
        ("<img src=x>", "'>' separates the parts of a path"),
        ("\x1b[31mred", "control characters"),
        ("\u202egnp", "control characters"),
        ("x" * 10_000, "10000 characters; shorten it to 100"),
    ],
)
def test_names_that_cannot_be_shown_are_reported_with_their_file(tmp_path, name, fault):
    path = tmp_path / "classes.json"
    path.write_text(json.dumps({"void": 0, "classes": {"1": "wall", "2": name}}))
    with pytest.raises(DatasetError, match=r"classes\.json: class 2 is called") as raised:
        read_class_names(path)
    assert fault in str(raised.value)
    assert str(raised.value).isprintable() and len(str(raised.value)) < 400
