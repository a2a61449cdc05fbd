"""What assistants can ask about a map of two storeys."""

from __future__ import annotations

import pytest
from two_storeys import AREAS_M2, house_run

from toolkit.exports.mapped_scene import map_scene
from toolkit.exports.options import ObjectGraphOptions
from toolkit.exports.selection import select
from toolkit.scene.graph.paths import NoPathError
from toolkit.tools.serving.map_tools import MapTools
from toolkit.tools.serving.served_run import ServedRun


@pytest.fixture(scope="module")
def tools(tmp_path_factory) -> MapTools:
    folder = house_run(tmp_path_factory.mktemp("house") / "run")
    run = ServedRun(folder, max_pixels=300_000)
    # The default options would separate Gaussians with this spacing.
    scene = map_scene(select(folder), ObjectGraphOptions(link_m=0.2, min_gaussians=20))
    tools = MapTools(run)
    vars(run)["scene"] = scene
    return tools


def test_storeys_are_described(tools):
    overview = tools.describe(None, None)
    assert overview["storeys"] == 2
    assert [room["storey"] for room in overview["rooms"]] == [1, 2, 2, 1]
    areas_m2 = [room["area_m2"] for room in overview["rooms"]]
    assert areas_m2 == pytest.approx(AREAS_M2, rel=0.15)
    assert tools.describe(None, 2)["objects_by_name"]["table"] == 1
    found = tools.find("table", None, None, 0, 10)["objects"]
    assert sorted((one["storey"], *one["rooms"]) for one in found) == [(1, 4), (2, 2)]


def test_paths_and_widths_exist_on_one_storey_only(tools):
    table = {o["storey"]: o["object_id"] for o in tools.find("table", None, None, 0, 9)["objects"]}
    lamp = {o["storey"]: o["object_id"] for o in tools.find("lamp", None, None, 0, 9)["objects"]}
    assert tools.path(lamp[1], table[1], 0.4)["rooms"] == [1, 4]
    assert tools.path(lamp[2], table[2], 0.4)["rooms"] == [3, 2]
    with pytest.raises(NoPathError, match="stairs are not known: choose two places on one storey"):
        tools.path(table[1], table[2], 0.4)
    centre_m = tools.find("table", None, None, 0, 9)["objects"][0]["centre_m"]
    storey = tools.find("table", None, None, 0, 9)["objects"][0]["storey"]
    assert tools.path(tuple(centre_m), lamp[storey], 0.4)["length_m"] > 3.0
    assert tools.measure(table[1], table[2])["free_width_m"] is None
