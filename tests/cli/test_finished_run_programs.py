"""render, export and evaluate: as users call them, and what they say to bad input."""

from __future__ import annotations

import json
import shutil

import pytest
from programs import semsplat

from toolkit.io.images import read_rgb, write_rgb
from toolkit.runs.maps.splat_clouds import read_cloud
from toolkit.tools.cli.main import main


def one_line_of_error(capsys, *words: object) -> str:
    """What a program says that must fail: its exit status is checked here."""
    assert main([str(word) for word in words]) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1
    return lines[0]


def test_render_draws_the_runs_own_path(run):
    done = semsplat("render", run, "--every", 4, "--what", "colour", "depth", "strip")
    assert done.returncode == 0, done.stderr
    files = sorted(p.name for p in (run / "renders/views").iterdir())
    assert files == [
        f"{kind}_{n:06d}.png" for kind in ("colour", "depth", "strip") for n in (0, 4, 8)
    ]
    assert read_rgb(run / "renders/views/colour_000004.png").shape == (48, 64, 3)
    # Input, render, depth and silhouette stand side by side.
    assert read_rgb(run / "renders/views/strip_000004.png").shape[1] > 4 * 64


def test_render_draws_views_and_other_sizes_without_the_data(run, tmp_path, capsys):
    words = ["--view", "0", "0", "0", "0", "0", "0", "0", "-0.5", "-20", "5"]
    words += ["--camera", "40", "40", "31.5", "23.5", "--what", "colour"]
    assert main(["render", str(run), *words, "--out", str(tmp_path / "a")]) == 0
    assert main(["render", str(run / "map.ply"), *words, "--out", str(tmp_path / "b")]) == 0
    # The first camera of the run is no identity, a bare file's own axes are.
    one, other = (read_rgb(tmp_path / name / "colour_000000.png") for name in "ab")
    assert one.shape == other.shape == (48, 64, 3)
    assert abs(one - other).max() > 0.1
    assert (tmp_path / "a/colour_000001.png").is_file()


def test_render_takes_a_trajectory_file(run, tmp_path):
    words = ["--trajectory", str(run / "trajectory.txt"), "--what", "colour"]
    assert main(["render", str(run), *words, "--out", str(tmp_path / "path")]) == 0
    assert main(["render", str(run), "--what", "colour"]) == 0
    for n in (0, 8):
        name = f"colour_{n:06d}.png"
        own, given = run / "renders/views" / name, tmp_path / "path" / name
        assert own.read_bytes() == given.read_bytes()


def test_a_bare_splat_file_is_shown_whole(run, tmp_path):
    file = run / "map.ply"
    assert main(["render", str(file), "--image-size", "80", "60"]) == 0
    silhouette = read_rgb(run / "map_views/silhouette_000000.png")
    empty = (abs(silhouette - silhouette[0, 0]).max(axis=2) < 0.02).mean()
    # The border is empty, so all of the map is inside, and it fills a fair part.
    assert 0.2 < empty < 0.9


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["render", "RUN/nothing"], "does not exist"),
        (["render", "RUN/nothing.ply"], "does not exist"),
        (["render", "RUN", "--every", "0"], "--every"),
        (["render", "RUN", "--image-size", "0", "9"], "--image-size"),
        (["render", "RUN", "--trajectory", "RUN/nothing.txt"], "nothing.txt"),
        (["render", "RUN/map.ply", "--camera", "0", "1", "1", "1"], "fx, fy > 0"),
        (["render", "RUN", "--out", "RUN/map.ply"], "map.ply"),
        (["export", "RUN", "--to", "RUN/map.obj"], ".ply or .splat or .spz or .sog"),
        (["export", "RUN", "--to", "RUN/no/map.ply"], "RUN/no"),
        (["export", "RUN", "--to", "RUN/a.ply", "--mesh", "--points"], "not both"),
        (["export", "RUN", "--to", "RUN/a.mesh.ply", "--voxel-m", "0"], "--voxel-m"),
        (["export", "RUN/renders", "--to", "a.ply"], "no run"),
        (["evaluate", "RUN/renders"], "no run"),
        (["evaluate", "RUN", "--dataset.path", "RUN/nothing"], "RUN/nothing"),
        (["evaluate", "RUN", "--max-views", "0"], "--max-views"),
    ],
)
def test_bad_input_is_reported_in_one_line(run, capsys, words, said):
    line = one_line_of_error(capsys, *(word.replace("RUN", str(run)) for word in words))
    assert said.replace("RUN", str(run)) in line


@pytest.mark.parametrize("job", ["evaluate", "render"])
def test_an_unfinished_or_damaged_run_says_what_to_do(run, capsys, job):
    (run / "frames.json").write_text('{"frames": [{}], "lost": [], "keyframes": []}')
    assert "frames.json is damaged" in one_line_of_error(capsys, job, run)
    (run / "frames.json").write_text("{")
    assert "frames.json is not JSON" in one_line_of_error(capsys, job, run)
    for name in ("map.ply", "metrics.json"):
        (run / name).unlink()
    assert "--resume" in one_line_of_error(capsys, job, run)


def test_evaluate_takes_the_new_path_of_a_moved_dataset(run, capsys, recording):
    config = run / "config.yaml"
    config.write_text(config.read_text().replace(str(recording), "/gone"))
    assert "/gone" in one_line_of_error(capsys, "evaluate", run)
    assert main(["evaluate", str(run), "--dataset.path", str(recording)]) == 0


def test_evaluate_says_that_semantics_are_missing(tiny_run, tmp_path, caplog):
    run = tmp_path / "run"
    shutil.copytree(tiny_run, run)
    shutil.rmtree(run / "semantics")
    assert main(["evaluate", str(run)]) == 0
    assert f"{run / 'semantics'} is missing: labels are not evaluated" in caplog.text


def test_another_recording_is_not_taken_for_that_of_the_run(
    tiny_run, tiny_recording, tmp_path, capsys
):
    run, other = tmp_path / "run", tmp_path / "other"
    shutil.copytree(tiny_run, run)
    shutil.copytree(tiny_recording, other)
    assert main(["evaluate", str(run), "--dataset.path", str(other)]) == 0
    metrics = (run / "metrics.json").read_bytes()
    for file in (other / "rgb").iterdir():
        write_rgb(file, read_rgb(file)[:, ::-1])
    capsys.readouterr()
    line = one_line_of_error(capsys, "evaluate", run, "--dataset.path", other)
    assert f"{other} is not the recording of {run}" in line and str(tiny_recording) in line
    assert (run / "metrics.json").read_bytes() == metrics
    config = run / "config.yaml"
    config.write_text(config.read_text().replace(str(tiny_recording), str(other)))
    words = ["export", run, "--to", tmp_path / "views", "--format", "nerfstudio"]
    assert "is not the recording" in one_line_of_error(capsys, *words, "--images", "copy")


@pytest.mark.parametrize("suffix", [".ply", ".splat", ".spz", ".sog", ".compressed.ply"])
def test_export_writes_splats(run, tmp_path, suffix):
    file = tmp_path / f"map{suffix}"
    assert main(["export", str(run), "--to", str(file)]) == 0
    assert len(read_cloud(file)) == len(read_cloud(run / "map.ply"))


def test_export_writes_a_mesh_on_the_walls_and_points(run, tmp_path, capsys):
    mesh = tmp_path / "box.mesh.ply"
    done = semsplat("export", run, "--to", mesh, "--voxel-m", "0.05", "--every", "2")
    assert done.returncode == 0, done.stderr
    assert "triangles" in done.stdout
    assert mesh.read_bytes().startswith(b"ply")
    assert main(["export", str(run), "--to", str(tmp_path / "p.ply"), "--points"]) == 0
    assert "points" in capsys.readouterr().out


def test_evaluate_measures_again_and_keeps_the_times(run):
    done = semsplat("evaluate", run)
    assert done.returncode == 0, done.stderr
    metrics = json.loads((run / "metrics.json").read_text())
    assert metrics["time"]["tracking_ms_per_frame"] == 12.5
    # Eight bits a channel are worth some 59 dB.
    assert 50.0 < metrics["images"]["mapped"]["psnr_db"] < 70.0
    assert metrics["images"]["unseen"]["psnr_db"] > 45.0
    assert metrics["trajectory"]["ate_rmse_cm"] < 0.001
    frames = metrics["frames"]
    assert (frames["total"], frames["lost"], frames["keyframes"]) == (10, 1, 2)
    assert metrics["images"]["unseen"]["views"] == 3


def test_evaluate_does_without_earlier_metrics(run):
    (run / "metrics.json").unlink()
    assert main(["evaluate", str(run), "--max-views", "1"]) == 0
    assert json.loads((run / "metrics.json").read_text())["images"]["mapped"]["views"] == 1


@pytest.mark.parametrize("name", ["map.ply", "config.yaml", "report.html", "scene_graph.jsonld"])
def test_no_output_replaces_a_file_of_a_run(run, capsys, name):
    """Also of runs that lack the file: it would be taken for the run's own."""
    before = {path: path.read_bytes() for path in run.iterdir() if path.is_file()}
    line = one_line_of_error(capsys, "export", run, "--to", run / name)
    assert f"{run / name} is a file of the run" in line
    assert "choose another name" in line
    assert {path: path.read_bytes() for path in run.iterdir() if path.is_file()} == before
    (run / "parts/1").mkdir(parents=True)
    assert "is a file of the run" in one_line_of_error(
        capsys, "export", run, "--to", run / "parts/1/map.ply"
    )


def test_outputs_of_a_runs_name_are_written_elsewhere(run, tmp_path):
    (tmp_path / "config.yaml").touch()
    assert main(["export", str(run), "--to", str(tmp_path / "map.ply")]) == 0
    assert main(["export", str(run), "--to", str(run / "room.ply")]) == 0


def test_a_run_without_a_map_is_not_called_unfinished(run, capsys):
    (run / "map.ply").unlink()
    line = one_line_of_error(capsys, "render", run)
    assert "ended without a map" in line
    assert str(run / "log.txt") in line
    (run / "metrics.json").unlink()
    assert "--resume" in one_line_of_error(capsys, "render", run)


def test_the_map_of_a_folder_that_is_no_run_is_named(run, tmp_path, capsys):
    (tmp_path / "edited").mkdir()
    file = (run / "map.ply").rename(tmp_path / "edited/map.ply")
    line = one_line_of_error(capsys, "query", tmp_path / "edited", "chair")
    assert f"export and run --map take {file}" in line
