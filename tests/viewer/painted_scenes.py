"""Small scenes with known content for tests of the viewers."""

from __future__ import annotations

import numpy as np

from toolkit.base.geometry.camera import Camera
from toolkit.semantics.taxonomy import Taxonomy
from toolkit.tools.viewer.scene import ShownKeyframe, ShownLoop, ShownSplats, ShownTree, ViewerScene

CAMERA = Camera(fx=80.0, fy=80.0, cx=39.5, cy=29.5, width=80, height=60)


def tree() -> ShownTree:
    """Two groups; table and chair in the first, wall in the second."""
    taxonomy = Taxonomy.from_json(
        {
            "name": "small",
            "levels": ["group", "class"],
            "classes": ["table", "chair", "wall"],
            "tree": {"furniture": ["table", "chair"], "structure": ["wall"]},
        }
    )
    return ShownTree.from_taxonomy(taxonomy)


def node(shown: ShownTree, name: str) -> int:
    return next(i for i, n in enumerate(shown.nodes) if n.path[-1] == name)


def two_panels(count: int = 400) -> ViewerScene:
    """A red table to the left of a blue wall, 2 m in front of the camera at the origin."""
    rng = np.random.default_rng(0)
    shown = tree()
    left = np.arange(count) % 2 == 0
    means_m = rng.uniform((-0.9, -0.7, 2.0), (-0.1, 0.7, 2.02), (count, 3))
    means_m[~left, 0] += 1.0
    table = (node(shown, "furniture"), node(shown, "table"))
    wall = (node(shown, "structure"), node(shown, "wall"))
    splats = ShownSplats(
        means_m=means_m.astype(np.float32),
        sigmas_m=np.full(count, 0.06, np.float32),
        opacities=np.full(count, 0.95, np.float32),
        rgb=np.where(left[:, None], [200, 40, 40], [40, 40, 200]).astype(np.uint8),
        levels=np.where(left[:, None], table, wall).astype(np.int32),
        confidence=np.where(left, 0.9, 0.4).astype(np.float32),
        submap=np.where(left, 0, 1).astype(np.int32),
        inferred=~left,
    )
    path = np.tile(np.eye(4), (3, 1, 1))
    path[:, 0, 3] = (0.0, 0.1, 0.2)
    image = np.full((60, 80, 3), (30, 120, 60), np.uint8)
    return ViewerScene(
        title="two panels </script>",
        splats=splats,
        total=2 * count,
        tree=shown,
        path=path,
        keyframes=(ShownKeyframe(0, np.eye(4), 0, image), ShownKeyframe(2, path[2], 1)),
        camera=CAMERA,
        loops=(ShownLoop(0, 2, path[[0, 2], :3, 3]),),
    )
