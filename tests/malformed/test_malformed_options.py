"""Options out of range or in contradiction: one line, status 2, nothing changed."""

from __future__ import annotations

import pytest

RUN = "run --dataset.kind folder --dataset.path data --out out "
BAD_OPTIONS = {
    RUN: [
        *("--max-frames 0", "--max-frames -1", "--max-frames many", "--max-frames 1.5"),
        *("--hold-out 1", "--hold-out 0", "--hold-out -3"),
        *("--seed -1", "--seed x"),
        *("--pace -1", "--pace nan", "--pace inf", "--pace 1001", "--pace fast", "--pace"),
        *("--pacing.max-delay-s 0", "--pacing.max-delay-s -1", "--pacing.max-delay-s nan"),
        *("--image-size 100000 100000", "--image-size 0 0", "--image-size -5 5"),
        *("--image-size 64", "--image-size a b", "--image-size 1 100000000"),
        *("--poses nowhere", "--backend abacus", "--device abacus", "--backend gsplat"),
        *("--mapping.iterations -1", "--mapping.iterations nan", "--checkpoint.every-s 0"),
        *("--checkpoint.every-s nan", "--checkpoint.every-s inf", "--checkpoint.every-keyframes 0"),
        *("--unknown 1", "--mapping.unknown 1", "extra", "--map nothing", "--map data"),
        *("--map other --poses given", "--dataset.kind abacus", "--dataset.path nothing"),
        *("--dataset.path names.txt", "--dataset.kind tum", "--dataset.kind replica"),
        *("--dataset.kind scannet", "--dataset.kind seven-scenes", "--out full", "--out run"),
        *("--out names.txt", "--out names.txt/out", "--out /proc/out", "--resume", "--out"),
        *("--out other/map.ply", "--out full --resume", "--out run --resume --seed 7"),
        *("--config nothing.yaml", "--config data", "--config names.txt", "--config"),
        *("--semantics.taxonomy nothing.yaml", "--semantics.taxonomy names.txt"),
        *("--segmenter.kind images", "--segmenter.kind model"),
        "--segmenter.kind images --segmenter.images.folder nothing",
        "--segmenter.kind model --segmenter.model.folder full",
        *("--semantics.ignore unicorn", "--evaluation.lpips-weights nothing.pth"),
    ],
    "run --out out ": ["--dataset.kind tum", "--seed -1"],
    "run ": ["--dataset.kind folder --dataset.path data"],
    "render run --out out ": [
        *("--every 0", "--every -1", "--every x", "--image-size 100000 100000", "--image-size 0 9"),
        *("--camera 0 1 1 1", "--camera nan 1 1 1", "--camera 1 1 1", "--camera 9 9 1e9 1e9"),
        *("--view nan 0 0 0 0", "--view 0 0 0 0", "--view 0 0 0 0 0 --trajectory x.txt"),
        *("--what nothing", "--trajectory nothing.txt", "--trajectory full"),
        *("--trajectory names.txt", "--out names.txt", "--out names.txt/out", "--unknown"),
    ],
    "render ": ["", "nothing", "nothing.ply", "full", "names.txt", "run/map.ply --what labels"],
    "export run ": [
        *("", "--to out.obj", "--to out", "--to nothing/out.ply", "--to full", "--to .ply/x.ply"),
        *(
            "--to out.ply --mesh --points",
            "--to out.ply --keep unicorn",
            "--to out.ply --drop root",
        ),
        *("--to out.mesh.ply --voxel-m 0", "--to out.mesh.ply --voxel-m -1"),
        *("--to out.mesh.ply --voxel-m nan", "--to out.mesh.ply --voxel-m inf"),
        *("--to out.mesh.ply --voxel-m 1e-9", "--to out.mesh.ply --max-depth-m nan"),
        *("--to out.mesh.ply --max-depth-m 0", "--to out.mesh.ply --every 0"),
    ],
    "export ": ["nothing --to out.ply", "full --to out.ply", "run/map.ply --to out.ply --keep x"],
    "query run ": [
        *("unicorn", "wall --list", "--min-confidence 2", "--min-confidence nan"),
        *("--link-m 0", "--link-m nan", "--link-m inf", "--min-gaussians 0", "--floor unicorn"),
        *(
            "wall --cloud out.obj",
            "wall --mesh nothing/out.ply",
            "--mesh out.ply",
            "--cloud out.ply",
        ),
        *("--summary out.txt", "--summary full/no/out.json", "wall --mesh out.ply --voxel-m 0"),
    ],
    "query ": ["", "nothing", "full"],
    "evaluate run ": [
        *("--max-views 0", "--max-views x", "--dataset.path nothing", "--dataset.path full"),
        *("--lpips-weights nothing.pth", "--lpips-weights names.txt"),
    ],
    "evaluate ": ["", "nothing", "full"],
    "explain-loops ": ["", "nothing", "full", "run --unknown"],
    "register ": [
        *("run", "run nothing --out out", "run full --out out", "run other --out full"),
        *("run other --out out --pairs 0", "run other --out names.txt", "run other"),
        "run other --out out --registration.voxel-m -1",
    ],
    "check-data ": [
        *("--kind folder", "--kind abacus --path data", "--kind folder --path nothing"),
        *("--kind folder --path names.txt", "--kind tum --path data"),
        "--kind folder --path data --image-size 0 0",
        "--kind folder --path data --image-size 100000 100000",
    ],
    "make-room --out out ": [
        *("--frames 0", "--frames -2", "--share 0", "--share 2", "--share nan", "--seed -1"),
        *("--image-size 0 5", "--image-size 100000 100000", "--unseen -1", "--layout castle"),
        *("--out full", "--out names.txt"),
    ],
    "build-taxonomy ": [
        *("", "--classes nothing.txt --review", "--classes full --review", "--classes names.txt"),
        "--classes names.txt --out nothing/tree.yaml",
    ],
    "train-head ": ["", "--dataset.kind folder --dataset.path data --model full --out head"],
    "doctor ": ["--unknown", "extra"],
}
CASES = [job + options for job, many in BAD_OPTIONS.items() for options in many]


@pytest.mark.parametrize("command", CASES)
def test_bad_options_are_refused(refused, command):
    assert len(refused(*command.split())) > 10
