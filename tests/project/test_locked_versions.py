"""The files of `make lock`: every package has a version and hashes, the same ones in both."""

from __future__ import annotations

import configparser
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


def locked(name):
    """Hashes by package and version."""
    text = (ROOT / name).read_text(encoding="utf-8").replace("\\\n", " ")
    lines = [line for line in text.splitlines() if line and not line.startswith("#")]
    found = {}
    for line in lines:
        package, version = re.match(r"([a-z0-9-]+)==([^ ]+) ", line).groups()
        found[package, version] = set(re.findall(r"--hash=sha256:([0-9a-f]{64})", line))
    return found


def names_of(extra):
    settings = configparser.ConfigParser()
    settings.read(ROOT / "setup.cfg", encoding="utf-8")
    section, key = extra
    return {
        re.match(r"[\w.-]+", line)[0].lower().replace("_", "-").replace(".", "-")
        for line in settings[section][key].strip().splitlines()
    }


RUN = ("options", "install_requires")
EXTRAS = [("options.extras_require", key) for key in ("build", "dev", "docs", "server", "agents")]


@pytest.mark.parametrize(
    ("file", "needed"),
    [("requirements.txt", [RUN, EXTRAS[0]]), ("constraints.txt", [RUN, *EXTRAS])],
)
def test_every_package_is_locked_with_hashes(file, needed):
    packages = locked(file)
    assert all(packages.values())
    asked = set().union(*map(names_of, needed)) - {"torch"}
    assert asked <= {package for package, _ in packages}


def test_both_files_agree():
    everything = locked("constraints.txt")
    assert all(everything[key] == hashes for key, hashes in locked("requirements.txt").items())


def test_torch_has_one_version():
    texts = [
        (ROOT / name).read_text(encoding="utf-8")
        for name in ("Makefile", "README.md", "docs/getting-started.md")
    ]
    versions = [set(re.findall(r"torch==([\d.]+)", text)) for text in texts]
    assert len(versions[0]) == 1 and versions[0] == versions[1] == versions[2]
