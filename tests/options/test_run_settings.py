"""The settings of a run: read from YAML, written to it, each option documented."""

from __future__ import annotations

from dataclasses import replace

import pytest

from toolkit.base.errors import SettingsError
from toolkit.base.options import nested_options
from toolkit.datasets.options import DatasetOptions
from toolkit.runs.settings import (
    RunSettings,
    dump_settings,
    load_settings,
)
from toolkit.slam.tracking.options import TrackingOptions
from toolkit.tools.cli.run import RunProgram


def test_settings_survive_a_yaml_file(tmp_path):
    settings = RunSettings(
        dataset=DatasetOptions(kind="tum", path=tmp_path),
        image_size=(320, 240),
        tracking=TrackingOptions(kind="first-order"),
    )
    file = tmp_path / "config.yaml"
    file.write_text(dump_settings(settings))
    assert load_settings(file) == settings
    assert dump_settings(load_settings(file)) == dump_settings(replace(settings))


def test_absent_keys_keep_their_defaults(tmp_path):
    file = tmp_path / "config.yaml"
    file.write_text("")
    assert load_settings(file) == RunSettings()
    file.write_text("tracking: {dense: {max_width: 320}}\n")
    assert load_settings(file).tracking.dense.max_width == 320
    assert load_settings(file).tracking.first_order == RunSettings().tracking.first_order


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("- 1", "must contain keys and values, not list"),
        ("a: [", "is not YAML"),
        ("sed: 3", "unknown option 'sed'; did you mean option 'seed'?"),
        ("seed: x", "option 'seed': input should be a valid integer"),
        ("mapping: {loss: {min_silhouete: 1}}", "option 'mapping.loss.min_silhouette'?"),
    ],
)
def test_an_invalid_file_is_named_with_the_key(tmp_path, text, message):
    file = tmp_path / "config.yaml"
    file.write_text(text)
    with pytest.raises(SettingsError) as error:
        load_settings(file)
    assert str(error.value).startswith(str(file))
    assert message in str(error.value)


def test_an_unreadable_file_is_an_error(tmp_path):
    with pytest.raises(SettingsError, match=r"cannot read settings .*: No such file"):
        load_settings(tmp_path / "config.yaml")


def test_every_option_is_described_by_a_complete_phrase():
    for option in nested_options(RunSettings):
        assert option.description.endswith("."), option.key
        assert option.description[:1].isupper(), option.key


def test_a_run_has_few_options_of_short_names():
    keys = [option.key for option in nested_options(RunProgram)]
    # The last one, dataset.intrinsics: whoever trusts a calibration does not want another one.
    assert len(keys) <= 209
    assert [key for key in keys if key.count(".") > 2] == []
