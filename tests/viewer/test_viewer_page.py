"""The offline page in Chromium: it draws, reacts to its controls, and needs no network."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from browser_pages import WatchedPage, chromium, mean_colour
from painted_scenes import two_panels

from toolkit.io.splat_shapes import relative_covariances
from toolkit.splatting.gaussians.ellipsoids import harmonic_basis
from toolkit.tools.cli.main import main
from toolkit.tools.viewer.html import link_from_report, write_page
from toolkit.tools.viewer.scene import (
    HARMONIC_STEPS,
    ShownKeyframe,
    ShownObject,
    ShownSplats,
    ViewerScene,
)

# Pixels on the table and on the wall, in the first view.
TABLE, WALL = (350, 280), (570, 280)


@pytest.fixture(scope="module")
def page_file(tmp_path_factory):
    path = tmp_path_factory.mktemp("page") / "viewer.html"
    write_page(path, two_panels())
    return path


@pytest.fixture(scope="module")
def browser():
    with chromium() as started:
        yield started


@pytest.fixture
def opened(browser, page_file):
    """The page after its first picture, without camera path and frusta."""
    watched = WatchedPage(browser)
    watched.page.goto(page_file.as_uri())
    drawn(watched)
    for layer in ("path", "keyframes", "loops"):
        watched.page.uncheck(f"#layer-{layer}")
    yield watched
    assert watched.errors == []
    watched.page.close()


def drawn(watched: WatchedPage) -> None:
    watched.page.wait_for_selector("#view[data-frames]", timeout=30_000)


def settled(watched: WatchedPage) -> np.ndarray:
    """Return the picture once it no longer changes."""
    last = watched.picture()
    for _ in range(40):
        watched.page.wait_for_timeout(50)
        now = watched.picture()
        if (now == last).all():
            break
        last = now
    return last


def test_the_gaussians_are_drawn_without_any_request(opened, page_file):
    picture = settled(opened)
    red, blue = mean_colour(picture, *TABLE), mean_colour(picture, *WALL)
    assert red[0] > 120 > red[2], red
    assert blue[2] > 120 > blue[0], blue
    # Only the page itself, and the worker that it contains.
    assert opened.requests[0] == page_file.as_uri()
    assert all(url.startswith("blob:") for url in opened.requests[1:])
    assert opened.page.title() == "two panels </script>"
    assert "400 of 800 Gaussians" in opened.page.inner_text("#counts")


def test_the_level_slider_changes_colours_and_legend(opened):
    before = settled(opened)
    opened.page.locator("#level-slider").fill("0")
    coarse = settled(opened)
    assert opened.page.inner_text("#level-name") == "1 of 2: group"
    names = opened.page.locator("#legend span").all_inner_texts()
    assert set(names) == {"furniture", "structure"}
    assert np.abs(mean_colour(before, *TABLE) - mean_colour(coarse, *TABLE)).max() > 20
    opened.page.locator("#level-slider").fill("1")
    fine = settled(opened)
    assert set(opened.page.locator("#legend span").all_inner_texts()) == {"table", "wall"}
    assert (fine != coarse).any()


@pytest.mark.parametrize("mode", ["Submaps", "Confidence", "Source"])
def test_other_colours(opened, mode):
    before = settled(opened)
    opened.page.get_by_role("radio", name=mode).click()
    after = settled(opened)
    assert np.abs(mean_colour(before, *WALL) - mean_colour(after, *WALL)).max() > 20


def test_a_click_shows_the_class_path(opened):
    opened.page.mouse.click(*TABLE)
    text = opened.page.inner_text("#picked")
    assert "furniture > table" in text and "90 %" in text and "measured" in text
    opened.page.mouse.click(*WALL)
    text = opened.page.inner_text("#picked")
    assert "structure > wall" in text and "40 %" in text and "inferred" in text
    opened.page.mouse.click(890, 12)
    assert opened.page.locator("#picked").is_hidden()


def test_a_query_and_the_legend_highlight(opened):
    before = settled(opened)
    opened.page.fill("#query", "table")
    found = settled(opened)
    assert opened.page.inner_text("#query-result") == "table: 200 Gaussians"
    assert mean_colour(found, *WALL).max() < 0.6 * mean_colour(before, *WALL).max()
    assert mean_colour(found, *TABLE).max() > 70
    opened.page.fill("#query", "sofa")
    assert opened.page.inner_text("#query-result") == "No class has this name."
    opened.page.fill("#query", "")
    opened.page.get_by_role("button", name="wall").click()
    chosen = settled(opened)
    assert mean_colour(chosen, *TABLE).max() < 0.6 * mean_colour(before, *TABLE).max()
    assert mean_colour(chosen, *WALL).max() > 70


def test_navigation_moves_the_view(opened):
    before = settled(opened)
    opened.page.mouse.move(400, 300)
    opened.page.mouse.down()
    opened.page.mouse.move(460, 320, steps=3)
    opened.page.mouse.up()
    turned = settled(opened)
    assert (turned[:, 290:] != before[:, 290:]).any()
    assert opened.page.locator("#picked").is_hidden(), "a drag is not a click"
    opened.page.click("#reset")
    assert np.abs(settled(opened) - before)[:, 290:].max() <= 2
    opened.page.click("#navigation")
    assert "W A S D" in opened.page.inner_text("#help")
    opened.page.mouse.wheel(0, -300)
    opened.page.click("#overview")
    overview = settled(opened)
    assert np.abs(overview - before).max() > 20
    opened.page.keyboard.down("w")
    opened.page.wait_for_timeout(200)
    opened.page.keyboard.up("w")
    assert (settled(opened) != overview).any()


def test_a_keyframe_shows_its_image(browser, page_file):
    watched = WatchedPage(browser, evaluate=True)
    watched.page.goto(page_file.as_uri())
    drawn(watched)
    watched.page.evaluate("semsplatViewer.camera.zoom(3); semsplatViewer.moved()")
    # The middle of the first frustum, which is 3 cm long.
    x, y, _ = watched.page.evaluate("semsplatViewer.camera.project([0, 0, 0.015])")
    watched.page.mouse.click(x, y)
    assert "Keyframe 0" in watched.page.inner_text("#keyframe")
    assert watched.page.locator("#keyframe img").is_visible()
    before = settled(watched)
    watched.page.get_by_role("button", name="View from here").click()
    assert (settled(watched)[:, 290:] != before[:, 290:]).any()
    assert watched.errors == []
    watched.page.close()


def test_anisotropic_gaussians_without_labels(browser, tmp_path):
    """One ellipsoid that is five times as wide as high, in front of the camera."""
    scales_m = np.array([[0.5, 0.1, 0.1]])
    splats = ShownSplats(
        means_m=np.array([[0.0, 0.0, 3.0]], np.float32),
        sigmas_m=np.exp(np.log(scales_m).mean(axis=1)).astype(np.float32),
        opacities=np.ones(1, np.float32),
        rgb=np.full((1, 3), 255, np.uint8),
        shapes=relative_covariances(scales_m, np.array([[1.0, 0.0, 0.0, 0.0]])),
    )
    keyframe = ShownKeyframe(0, np.eye(4))
    file = tmp_path / "one.html"
    write_page(file, ViewerScene("one", splats, 1, keyframes=(keyframe,)))
    watched = WatchedPage(browser)
    watched.page.goto(file.as_uri())
    drawn(watched)
    for name in ("#level", "#class-search", "#legend-section", "#modes"):
        assert watched.page.locator(name).is_hidden()
    watched.page.mouse.click(450, 250)
    assert "class" not in watched.page.inner_text("#picked")
    watched.page.uncheck("#layer-keyframes")
    bright = settled(watched).max(axis=2) > 128
    bright[:, :290] = False
    rows, columns = np.nonzero(bright)
    # Over the dark background, half brightness is at 1.22 standard deviations; the focal length is
    # 480 pixels. The panel covers the left end.
    assert np.ptp(rows) == pytest.approx(2 * 1.22 * 0.1 * 480 / 3, abs=3)
    assert columns.max() - 450 == pytest.approx(1.22 * 0.5 * 480 / 3, abs=3)
    assert watched.errors == []
    watched.page.close()


def test_a_browser_without_webgl2_gets_a_message(browser, page_file):
    watched = WatchedPage(browser)
    watched.page.add_init_script(
        "HTMLCanvasElement.prototype.getContext = () => null",
    )
    watched.page.goto(page_file.as_uri())
    assert "WebGL2" in watched.page.inner_text("#message")
    assert watched.page.locator("#panel").is_hidden()
    assert watched.errors == []


def test_export_writes_a_page_that_the_report_links(tiny_run, tmp_path, browser, capsys):
    import shutil

    run = tmp_path / "run"
    shutil.copytree(tiny_run, run)
    page = run / "viewer.html"
    words = ["--to", str(page), "--viewer.max-gaussians", "300", "--viewer.images", "1"]
    assert main(["export", str(run), *words]) == 0
    assert "300 of" in capsys.readouterr().out
    assert main(["export", str(run), *words]) == 0
    assert (run / "report.html").read_text().count('href="viewer.html"') == 1
    watched = WatchedPage(browser)
    watched.page.goto(page.as_uri())
    drawn(watched)
    assert watched.errors == []
    watched.page.goto((run / "report.html").as_uri())
    watched.page.click("text=Open the map in 3D")
    drawn(watched)


def test_a_page_elsewhere_is_not_linked(tiny_run, tmp_path):
    before = (tiny_run / "report.html").read_bytes()
    assert not link_from_report(tmp_path / "viewer.html", tiny_run / "report.html")
    assert (tiny_run / "report.html").read_bytes() == before


def test_colours_depend_on_the_view(browser, tmp_path):
    """One sphere with harmonics of each degree, seen from two sides."""
    rng = np.random.default_rng(0)
    for count in (3, 8, 15):
        harmonics = rng.integers(-40, 40, (1, count, 3)).astype(np.int8)
        splats = ShownSplats(
            means_m=np.array([[0.0, 0.0, 3.0]], np.float32),
            sigmas_m=np.full(1, 0.2, np.float32),
            opacities=np.ones(1, np.float32),
            rgb=np.full((1, 3), 128, np.uint8),
            harmonics=harmonics,
        )
        file = tmp_path / f"{count}.html"
        keyframe = ShownKeyframe(0, np.eye(4))
        write_page(file, ViewerScene("one", splats, 1, keyframes=(keyframe,)))
        watched = WatchedPage(browser, evaluate=True)
        watched.page.goto(file.as_uri())
        drawn(watched)
        for yaw in (0.0, 1.1):
            watched.page.evaluate(
                f"Object.assign(semsplatViewer.camera, {{ target: [0, 0, 3], distance: 2, "
                f"yaw: {yaw}, pitch: -0.4 }}); semsplatViewer.moved()"
            )
            forward = torch.tensor(watched.page.evaluate("semsplatViewer.camera.forward"))
            basis = harmonic_basis(forward[None].double(), count).numpy()[0]
            expected = 128 + 255 * basis @ harmonics[0] / HARMONIC_STEPS
            middle = mean_colour(settled(watched), 450, 250, half=1)
            assert middle == pytest.approx(expected.clip(0, 255), abs=4), (count, yaw)
        assert watched.errors == []
        watched.page.close()


def test_the_tree_of_objects_marks_the_chosen_one(browser, tmp_path):
    scene = two_panels()
    low, high = scene.splats.means_m.min(axis=0), scene.splats.means_m.max(axis=0)
    corners = np.array([[(low, high)[i >> a & 1][a] for a in range(3)] for i in range(8)])
    hostile = "<img src=x onerror=alert(1)>"
    objects = (
        ShownObject(0, "table 0", "room 1", corners, ("next to lamp 1",)),
        ShownObject(1, hostile, "room 1", corners + 100.0),
    )
    write_page(tmp_path / "viewer.html", replace(scene, objects=objects))
    watched = WatchedPage(browser)
    watched.page.goto((tmp_path / "viewer.html").as_uri())
    drawn(watched)
    entries = watched.page.locator("#graph button")
    assert entries.all_text_contents() == ["table 0", hostile]
    before = settled(watched)
    entries.first.click()
    assert entries.first.get_attribute("aria-pressed") == "true"
    assert watched.page.locator("#graph li:visible").all_text_contents() == [
        "1.79 x 1.39 x 0.02 m",
        "next to lamp 1",
    ]
    marked = settled(watched)[:, 300:]
    yellow = (marked[..., 0] > 200) & (marked[..., 1] > 150) & (marked[..., 2] < 120)
    assert yellow.sum() > 50 and (marked != before[:, 300:]).any()
    entries.first.click()
    assert entries.first.get_attribute("aria-pressed") == "false"
    unmarked = settled(watched)[:, 300:]
    assert (unmarked[yellow] != marked[yellow]).any(axis=1).mean() > 0.9
    assert watched.errors == []
    watched.page.close()


def test_a_click_on_gaussians_chooses_the_object_of_their_class(browser, tmp_path):
    """The box of the sofa is around all, that of the cabinet around the one of the table."""
    scene = two_panels()
    low, high = scene.splats.means_m.min(axis=0), scene.splats.means_m.max(axis=0)
    whole = np.array([[(low, high)[i >> a & 1][a] for a in range(3)] for i in range(8)])
    left = np.minimum(whole, (0.0, np.inf, np.inf))
    behind = np.where(np.arange(3) == 2, whole + 0.05, whole)
    table, wall = ("furniture", "table"), ("structure", "wall")
    objects = (
        ShownObject(3, "sofa 3", "room 1", whole, path=("furniture", "sofa")),
        ShownObject(4, "cabinet 4", "room 1", behind, path=table),
        ShownObject(5, "table 5", "room 2", left, path=table),
        ShownObject(6, "wall 6", "room 2", whole + 0.5, path=wall),
    )
    write_page(tmp_path / "viewer.html", replace(scene, objects=objects))
    watched = WatchedPage(browser)
    watched.page.goto((tmp_path / "viewer.html").as_uri())
    drawn(watched)
    for layer in ("path", "keyframes", "loops"):
        watched.page.uncheck(f"#layer-{layer}")
    before = settled(watched)
    watched.page.mouse.click(*TABLE)
    pressed = watched.page.locator('#graph button[aria-pressed="true"]')
    assert pressed.all_text_contents() == ["table 5"]
    assert pressed.is_visible(), "its room was closed"
    seen = settled(watched)[:, 300:]
    changed = (np.abs(seen - before[:, 300:]) > 10).any(axis=2).mean()
    assert 0 < changed < 0.05, "the box is drawn, the view stays"
    watched.page.mouse.click(*WALL)
    assert pressed.count() == 0 and "structure > wall" in watched.page.inner_text("#picked")
    watched.page.mouse.click(*TABLE)
    watched.page.mouse.click(890, 12)
    assert pressed.count() == 0, "the background is no object"
    assert watched.errors == []
    watched.page.close()


def test_the_tree_of_objects_begins_with_storeys_if_there_are_several(browser, tmp_path):
    corners = np.zeros((8, 3))
    objects = tuple(
        ShownObject(number, f"table {number}", room, corners, storey=storey)
        for number, (storey, room) in enumerate(
            [("storey 1", "room 1"), ("storey 1", "room 3"), ("storey 2", "room 2")]
        )
    )
    write_page(tmp_path / "viewer.html", replace(two_panels(), objects=objects))
    watched = WatchedPage(browser)
    watched.page.goto((tmp_path / "viewer.html").as_uri())
    drawn(watched)
    storeys = watched.page.locator("#graph > details")
    tops = storeys.locator("> summary").all_text_contents()
    assert tops == ["storey 1 (2)", "storey 2 (1)"]
    rooms = [one.locator("> details > summary").all_text_contents() for one in storeys.all()]
    assert rooms == [["room 1 (1)", "room 3 (1)"], ["room 2 (1)"]]
    assert watched.page.locator("#graph button:visible").all_text_contents() == ["table 2"]
    assert watched.errors == []
    watched.page.close()
