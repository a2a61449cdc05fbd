"""Times in other units than seconds are named, and refused where nothing could work with them."""

import logging

import numpy as np
import pytest

from toolkit.base.errors import DatasetError
from toolkit.datasets.checks import check_recording
from toolkit.datasets.registry import describe, open_dataset
from toolkit.datasets.times import is_impossible, unit_fault

TIMES_S = 1403636579.7635 + np.arange(6) / 30


def write_times(folder, unit: float) -> None:
    stems = sorted(path.stem for path in (folder / "rgb").iterdir())
    lines = [f"{stem} {unit * k / 30}" for k, stem in enumerate(stems)]
    (folder / "timestamps.txt").write_text("\n".join(lines) + "\n")


@pytest.mark.parametrize(
    ("unit", "name"), [(1e9, "nanoseconds"), (1e6, "microseconds"), (1e3, "milliseconds")]
)
def test_the_unit_is_found_from_the_usual_interval(unit, name):
    fault = unit_fault(unit * TIMES_S)
    assert name in fault and fault.endswith(f"by 1e{round(np.log10(unit))}")
    assert is_impossible(unit * TIMES_S) == (unit > 1e3)


@pytest.mark.parametrize("fps", [0.5, 1.0, 30.0, 200.0])
def test_seconds_are_accepted(fps):
    times_s = np.arange(9) / fps
    times_s[5:] += 600.0  # a pause of ten minutes
    assert not unit_fault(times_s)
    assert not unit_fault(times_s[:1])


def test_a_time_lapse_is_no_error_of_a_run():
    assert "specify the times in seconds" in unit_fault(1e5 * np.arange(4.0) / 30)
    assert not is_impossible(60.0 * np.arange(4.0))


def test_a_run_refuses_nanoseconds_and_check_data_reports_them(make_folder):
    folder = make_folder()
    write_times(folder, 1e9)
    with pytest.raises(DatasetError, match=r"look like nanoseconds: divide .* by 1e9"):
        open_dataset("folder", folder)
    assert any(
        "nanoseconds" in fault for fault in check_recording(describe("folder", folder)).faults
    )


def test_a_run_warns_of_milliseconds(make_folder, caplog):
    folder = make_folder()
    write_times(folder, 1e3)
    with caplog.at_level(logging.WARNING):
        open_dataset("folder", folder)
    assert "milliseconds" in caplog.text
