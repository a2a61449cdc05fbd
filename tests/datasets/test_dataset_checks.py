"""`check-data` finds each defect that is inserted into a valid recording, and no others."""

import json

import numpy as np
import pytest
from programs import semsplat

from toolkit.datasets.checks import check_recording
from toolkit.datasets.registry import describe
from toolkit.io import images
from toolkit.tools.cli import check_data
from toolkit.tools.cli.programs import CheckDataOptions


def test_valid_recording_has_no_faults(make_replica):
    report = check_recording(describe("replica", make_replica(labels=True)))
    assert report.good, report.faults
    assert report.summary[0].startswith("room: 4 frames over 0.1 s, 32x24, f 30.0 31.0")
    assert report.summary[1].startswith("ground truth: 4 poses")
    assert report.summary[3] == "labels: 2 of 2 classes occur"


def only_fault(kind: str, folder) -> str:
    report = check_recording(describe(kind, folder))
    assert len(report.faults) == 1, report.faults
    return report.faults[0]


def test_missing_pairs(make_replica):
    folder = make_replica()
    (folder / "results/depth000002.png").unlink()
    assert only_fault("replica", folder) == "1 colour image(s) without depth: frame000002.png"


@pytest.mark.parametrize(
    ("scale", "median"), [(1e6, "1.65 mm"), (1.0, "1.65 km")], ids=["too large", "too small"]
)
def test_wrong_depth_scale(make_replica, scale, median):
    folder = make_replica()
    values = json.loads((folder / "cam_params.json").read_text())
    values["camera"]["scale"] = scale
    (folder / "cam_params.json").write_text(json.dumps(values))
    fault = only_fault("replica", folder)
    assert f"the median depth is {median}" in fault
    assert "1000 would give 1.65 m" in fault


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"cx": 64.0, "cy": 48.0}, "the principal point (64.0, 48.0) is far from the centre"),
        ({"fx": 3.0, "fy": 3.0}, "cover 158.8 degrees"),
        ({"fx": 3e4, "fy": 3e4}, "cover 0.1 degrees"),
        ({"fx": 90.0}, "focal lengths 90.0 and 31.0 of the 32x24 images differ"),
    ],
)
def test_intrinsics_of_another_resolution(make_replica, change, words):
    folder = make_replica()
    (folder / "traj.txt").unlink()
    values = json.loads((folder / "cam_params.json").read_text())
    values["camera"] |= change
    (folder / "cam_params.json").write_text(json.dumps(values))
    assert words in only_fault("replica", folder)


def test_a_pose_far_from_its_neighbours(make_folder):
    folder = make_folder(frames=8)
    lines = (folder / "trajectory.txt").read_text().splitlines()
    words = lines[4].split()
    words[1] = "5.5"
    (folder / "trajectory.txt").write_text("\n".join([*lines[:4], " ".join(words), *lines[5:]]))
    flaws = describe("folder", folder).flaws
    assert len(flaws) == 1
    assert flaws[0].startswith("1 ground-truth pose(s) are up to 4.99 m") and "4.png" in flaws[0]


def test_a_pose_after_a_pause_is_no_outlier(make_folder):
    folder = make_folder(frames=8)
    lines = [line.split() for line in (folder / "trajectory.txt").read_text().splitlines()]
    for words in lines[4:]:
        words[1] = str(float(words[1]) + 5.0)
    (folder / "trajectory.txt").write_text("\n".join(map(" ".join, lines)))
    assert describe("folder", folder).flaws == ()


def test_non_finite_and_non_rigid_poses(make_replica):
    folder = make_replica()
    rows = (folder / "traj.txt").read_text().splitlines()
    rows[1] = " ".join(["nan"] * 16)
    rows[2] = " ".join(["2"] * 16)
    (folder / "traj.txt").write_text("\n".join(rows))
    faults = check_recording(describe("replica", folder)).faults
    assert faults == (
        "1 frame(s) with a non-finite ground-truth pose: frame000001.png",
        "1 frame(s) whose ground-truth pose is not a rigid motion: frame000002.png",
    )


def test_timestamps_out_of_order(make_tum):
    folder = make_tum(frames=3)
    lines = (folder / "depth.txt").read_text().splitlines()
    (folder / "depth.txt").write_text("\n".join([*lines[:2], lines[3], lines[2]]))
    assert only_fault("tum", folder) == (
        "depth.txt: timestamps out of order at 1341840000.110000.png"
    )


def test_pauses_are_noted(make_tum):
    folder = make_tum(frames=6)
    assert not any("pause" in note for note in check_recording(describe("tum", folder)).notes)
    for name in ("rgb.txt", "depth.txt"):
        lines = (folder / name).read_text().splitlines()
        head = [line for line in lines if line.startswith("#")]
        rows = [line.split() for line in lines if not line.startswith("#")]
        later = [
            f"{float(time) + 7.0 * (k >= 4):.6f} {file}" for k, (time, file) in enumerate(rows)
        ]
        (folder / name).write_text("\n".join([*head, *later]) + "\n")
    report = check_recording(describe("tum", folder))
    (note,) = [note for note in report.notes if "pause" in note]
    assert note.startswith("1 pause(s) of up to 7.") and "frames are usually" in note


def test_colour_and_depth_of_different_size(make_replica):
    folder = make_replica()
    images.write_rgb(folder / "results/frame000003.png", np.full((48, 64, 3), 0.5))
    assert "frame 3: " in only_fault("replica", folder)
    assert "frame000003.png is 64x48" in only_fault("replica", folder)


def test_empty_depth(make_replica):
    folder = make_replica()
    images.write_png(folder / "results/depth000001.png", np.zeros((24, 32), np.uint16))
    assert "1 depth image(s) are empty" in only_fault("replica", folder)


def test_truncated_images_are_listed_or_counted(make_replica):
    folder = make_replica(frames=8)
    for i in range(1, 8):
        file = folder / f"results/frame{i:06d}.png"
        file.write_bytes(file.read_bytes()[:-30])
    faults = check_recording(describe("replica", folder)).faults
    assert len(faults) == 6
    assert "frame000001.png is truncated" in faults[0]
    assert faults[5] == "2 more frame(s) cannot be read"


def test_jpeg_with_decoder_warnings(make_replica):
    folder = make_replica()
    for i in range(4):
        png = folder / f"results/frame{i:06d}.png"
        images.write_rgb(png.with_suffix(".jpg"), images.read_rgb(png))
        png.unlink()
    assert check_recording(describe("replica", folder)).good
    file = folder / "results/frame000001.jpg"
    content = bytearray(file.read_bytes())
    scan = content.rfind(b"\xff\xda")
    content[scan + 200 : scan + 240] = bytes(b ^ 0x5A for b in content[scan + 200 : scan + 240])
    file.write_bytes(content)
    assert "1 colour image(s) are corrupt" in only_fault("replica", folder)


def test_unknown_class_ids(make_replica):
    folder = make_replica(labels=True)
    for file in (folder / "labels").glob("*.png"):
        images.write_png(file, np.zeros((24, 32), np.uint8))
    assert only_fault("replica", folder).startswith("all labels are void (0)")
    images.write_png(folder / "labels/label000000.png", np.full((24, 32), 77, np.uint8))
    assert only_fault("replica", folder).endswith("missing in classes.json: 77")


def test_single_frame_is_a_fault(make_replica):
    assert "only one frame" in only_fault("replica", make_replica(frames=1))


def test_program_prints_the_report_and_sets_the_exit_status(make_replica, capsys):
    folder = make_replica()
    arguments = CheckDataOptions("replica", folder, image_size=(16, 12))
    assert check_data.main(arguments) == 0
    assert "16x12" in capsys.readouterr().out
    (folder / "results/depth000002.png").unlink()
    assert check_data.main(arguments) == 1
    assert "error: 1 colour image(s) without depth" in capsys.readouterr().out


def test_program_reports_a_wrong_path_in_one_line(tmp_path):
    done = semsplat("check-data", "--kind", "tum", "--path", "no", cwd=tmp_path)
    assert done.returncode == 2
    assert done.stderr == "semsplat: error: no does not exist; check the path\n"
