"""The benchmark of presets: settings of its rows, the plot of its results."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks import presets
from benchmarks.tables import Metrics


@pytest.mark.parametrize("row", presets.ROWS.values(), ids=list(presets.ROWS))
def test_rows_have_the_settings_of_their_preset(row, monkeypatch, tmp_path):
    for recording in presets.RECORDINGS.values():
        (tmp_path / recording.folder).mkdir(exist_ok=True)
    monkeypatch.setenv("SEMSPLAT_DATA", str(tmp_path))
    monkeypatch.setattr(presets, "room", lambda name: Path(name))
    settings = presets.settings_of(row.sequence, row.preset, 12, 3)
    assert (settings.max_frames, settings.seed) == (12, 3)
    assert settings.mapping == presets.load_settings(preset=row.preset).mapping


def metrics(index: int) -> Metrics:
    return {
        "trajectory.ate_rmse_cm": 1.0 + index,
        "images.mapped.psnr_db": 20.0 + index,
        presets.TOTAL: 100.0 * (1 + index),
    }


def test_the_plot_has_every_sequence_and_preset_and_is_reproducible(tmp_path):
    rows = {name: [metrics(index)] for index, name in enumerate(presets.ROWS)}
    del rows["room, gausem"][0]["images.mapped.psnr_db"]  # a metric may be missing
    presets.plot(rows, tmp_path / "one.svg")
    presets.plot(rows, tmp_path / "other.svg")
    text = (tmp_path / "one.svg").read_text()
    assert text == (tmp_path / "other.svg").read_text()
    for name in (*presets.SEQUENCES, *presets.PRESETS):
        assert f">{name}</text>" in text
