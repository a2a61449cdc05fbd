"""`semsplat run --depth none --depth-prior.kind maps`: priors that complete or replace depth."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from moving_camera import film, turn, walk
from test_finished_run_programs import one_line_of_error
from test_monocular_runs import arguments, write_film

from toolkit.base.frame import Frame
from toolkit.slam.result import FrameResult
from toolkit.slam.system import Slam
from toolkit.tools.cli.main import main

PRIORS = ["--depth-prior.kind", "maps"]


def write_priors(folder: Path, poses: np.ndarray) -> Path:
    """Depth maps whose scale and shift differ from the true depth."""
    folder.mkdir()
    for frame in film(poses):
        np.save(folder / f"{frame.index:03d}.npy", (frame.depth_m - 0.2) / 0.4)
    return folder


@pytest.fixture(scope="module")
def recording(tmp_path_factory) -> Path:
    root = tmp_path_factory.mktemp("film")
    write_priors(root / "priors", walk(12))
    return write_film(root / "walk", walk(12))


def maps(recording: Path) -> list[str]:
    folder = str(recording.parent / "priors")
    return [*PRIORS, "--depth-prior.maps.values", "affine", "--depth-prior.maps.folder", folder]


def run(recording: Path, out: Path, *more: str) -> dict:
    assert main(arguments(recording, out, "--depth", "none", *maps(recording), *more)) == 0
    return json.loads((out / "metrics.json").read_text())


def test_priors_complete_the_depth_of_keyframes(recording, tmp_path):
    metrics = run(recording, tmp_path / "run")
    assert 2.0 < metrics["depth_prior"]["inferred_percent"] < 60.0
    assert metrics["depth_prior"]["model"].startswith("maps in ")
    assert metrics["depth_prior"]["licence"] == "unknown"
    assert metrics["images"]["mapped"]["psnr_db"] > 20.0


def test_corrected_priors_replace_the_depth_of_keyframes(recording, tmp_path):
    words = ["--depth-prior.use", "correct"]
    metrics = run(recording, tmp_path / "run", *words)
    assert metrics["depth_prior"]["inferred_percent"] == 100.0
    assert metrics["frames"]["lost"] == 0
    assert metrics["images"]["mapped"]["psnr_db"] > 20.0
    assert metrics["monocular"]["reliable"]
    again = run(recording, tmp_path / "again", *words)
    assert again["images"]["mapped"]["psnr_db"] == metrics["images"]["mapped"]["psnr_db"]
    for name in ("trajectory.txt", "map.ply"):
        assert (tmp_path / "again" / name).read_bytes() == (tmp_path / "run" / name).read_bytes()


def test_priors_declared_as_another_kind_make_the_run_unreliable(recording, tmp_path, caplog):
    words = ["--depth-prior.maps.values", "affine-inverse", "--max-frames", "8"]
    metrics = run(recording, tmp_path / "run", *words)
    assert not metrics["monocular"]["reliable"]
    assert "shows that they are depth up to scale" in metrics["monocular"]["doubts"]
    last = [record.getMessage() for record in caplog.records][-4:]
    assert any(
        f"not reliable: the depth priors are declared as {words[1]}" in line for line in last
    )


def test_a_prior_needs_a_recording_without_depth(recording, tmp_path, capsys):
    words = ["--depth-prior.kind", "maps", "--depth-prior.maps.folder", str(tmp_path)]
    assert main(arguments(recording, tmp_path / "run", *words)) == 2
    assert "--depth none" in one_line_of_error(capsys)


def test_a_missing_folder_is_reported_before_the_motion_is_estimated(tmp_path, capsys):
    recording = write_film(tmp_path / "turn", turn(4))
    words = ["--depth", "none", "--depth-prior.kind", "maps"]
    assert main(arguments(recording, tmp_path / "run", *words)) == 2
    assert "--depth-prior.maps.folder" in one_line_of_error(capsys)
    assert not (tmp_path / "run").exists()


TRACKED = [
    *("--preset", "hier-slam-mono", "--depth-prior.maps.scope", "sequence"),
    *("--depth-prior.correction.share", "scope"),
    *("--tracking.first-order.iterations", "12", "--semantics.code.kind", "none"),
    *("--max-frames", "8", "--checkpoint.every-keyframes", "3"),
]


def tracked(recording: Path, out: Path, *more: str) -> dict:
    assert main(arguments(recording, out, *TRACKED, *maps(recording), *more)) == 0
    return json.loads((out / "metrics.json").read_text())


@pytest.fixture(scope="module")
def tracked_run(recording, tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("tracked") / "run"
    tracked(recording, out)
    return out


def test_the_papers_monocular_system_runs_without_odometry(tracked_run):
    metrics = json.loads((tracked_run / "metrics.json").read_text())
    assert "monocular" not in metrics  # no motion was estimated in advance
    assert metrics["trajectory"]["alignment"] == "sim3"
    assert metrics["trajectory"]["ate_rmse_cm"] < 5.0  # of 33 cm
    assert metrics["depth_prior"]["inferred_percent"] == 100.0
    assert metrics["frames"]["lost"] == 0
    # The scale of the prior is unknown.
    assert json.loads((tracked_run / "frames.json").read_text())["metric"] is False
    assert main(["evaluate", str(tracked_run)]) == 0


def test_tracking_on_priors_continues_after_an_interruption(
    recording, tracked_run, tmp_path, monkeypatch
):
    part = tmp_path / "part"
    with monkeypatch.context() as patch:
        process = Slam.process_frame

        def killed(slam: Slam, frame: Frame, may_map: bool = True) -> FrameResult:
            if frame.index == 5:
                raise KeyboardInterrupt
            return process(slam, frame, may_map)

        patch.setattr(Slam, "process_frame", killed)
        assert main(arguments(recording, part, *TRACKED, *maps(recording))) == 130
    tracked(recording, part, "--resume")
    for name in ("trajectory.txt", "map.ply"):
        assert (part / name).read_bytes() == (tracked_run / name).read_bytes()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--depth-prior.use", "track"], "set --depth-prior.kind"),
        (["--tracking.kind", "first-order"], "--depth-prior.use track"),
        ([*PRIORS, "--depth-prior.use", "track", "--poses", "given"], "nothing to track"),
        ([*PRIORS, "--depth-prior.use", "track", "--pace", "30"], "--pace"),
        (
            [*PRIORS, "--depth-prior.use", "track", "--scale.camera-height-m", "1.5"],
            "needs visual odometry",
        ),
    ],
    ids=["no prior", "no depth", "given poses", "real time", "metric scale"],
)
def test_what_tracking_on_priors_excludes_is_refused(recording, tmp_path, capsys, words, message):
    capsys.readouterr()
    assert main(arguments(recording, tmp_path / "run", "--depth", "none", *words)) == 2
    assert message in one_line_of_error(capsys)
    assert not (tmp_path / "run").exists()
