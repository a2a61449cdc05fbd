"""The page of `semsplat view` in Chromium: maps that change, other pages, and hostile names."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import numpy as np
import pytest
from browser_pages import WatchedPage, chromium, mean_colour
from painted_scenes import two_panels

from toolkit.io.addresses import bind
from toolkit.tools.viewer.html import write_page
from toolkit.tools.viewer.scene import ShownNode, ShownObject, ShownTree, ViewerScene
from toolkit.tools.viewer.server import MapServer
from toolkit.tools.viewer.streaming import ServedMap, StreamedMap, WholeMap

# Pixels on the table and on the wall, in the first view.
TABLE, WALL = (350, 280), (570, 280)


@pytest.fixture
def server():
    started = MapServer(bind("127.0.0.1", 0))
    yield started
    started.stop()


@pytest.fixture(scope="module")
def browser():
    with chromium() as started:
        yield started


@pytest.fixture
def watched(browser):
    opened = WatchedPage(browser, evaluate=True)
    yield opened
    assert opened.errors == []
    opened.page.close()


def show(server: MapServer, watched: WatchedPage, shown: ViewerScene | ServedMap) -> None:
    """Show a map, and wait until the page has drawn it."""
    server.show(WholeMap(shown) if isinstance(shown, ViewerScene) else shown)
    if watched.page.url == "about:blank":
        watched.page.goto(server.url)
    watched.page.wait_for_selector(f"#view[data-version='{server.state.version}']", timeout=20_000)


def with_objects(*objects: ShownObject, **changes: object) -> ViewerScene:
    return replace(two_panels(), objects=objects, **changes)


def table(number: int, left: float, room: str = "room 1") -> ShownObject:
    """The half of the table of `two_panels` right of -0.5 m, or left of it, with its voxels."""
    x, y = np.meshgrid(np.arange(left, left + 0.4, 0.05), np.arange(-0.7, 0.7, 0.05))
    voxels_m = np.stack([x, y, np.full_like(x, 2.01)], axis=-1).reshape(-1, 3)
    unit = np.array([[i & 1, i >> 1 & 1, i >> 2] for i in range(8)])
    corners_m = unit * (0.4, 1.4, 0.02) + (left, -0.7, 2.0)
    name, path = f"table {number}", ("furniture", "table")
    return ShownObject(number, name, room, corners_m, path=path, voxels_m=voxels_m)


def pressed(watched: WatchedPage) -> list[str]:
    return watched.page.locator('#graph button[aria-pressed="true"]').all_text_contents()


def test_a_page_waits_for_the_first_map_and_tells_when_the_server_is_gone(server, watched):
    page = watched.page
    server.report("Waiting for the first frames of the run.")
    page.goto(server.url)
    page.locator("#message", has_text="Waiting for the first frames").wait_for()
    assert page.locator("#panel").is_hidden()
    show(server, watched, two_panels())
    assert page.locator("#panel").is_visible() and page.locator("#message").is_hidden()
    assert page.title() == "two panels </script>" and page.locator("#status").is_hidden()
    server.stop()
    page.get_by_text("semsplat view does not answer").wait_for()
    assert page.locator("#panel").is_visible()
    watched.errors.clear()  # Chromium names the failed request


def test_a_new_state_of_the_map_keeps_view_and_choices(server, watched):
    page = watched.page
    show(server, watched, with_objects())
    for layer in ("path", "keyframes"):
        page.uncheck(f"#layer-{layer}")
    page.mouse.move(500, 300)
    page.mouse.down()
    page.mouse.move(560, 320, steps=3)
    page.mouse.up()
    page.locator("#level-slider").fill("0")
    page.fill("#query", "furniture")
    view = "[...semsplatViewer.camera.view.rows.flat(), ...semsplatViewer.camera.eye]"
    before = page.evaluate(view)
    few = two_panels()
    growing = replace(few, splats=few.splats.select(np.arange(60)), title="frame 7", loops=())
    show(server, watched, growing)
    assert page.evaluate(view) == pytest.approx(before, abs=1e-9)
    assert page.inner_text("#title") == "frame 7" and "60 of 800" in page.inner_text("#counts")
    assert page.inner_text("#level-name") == "1 of 2: group"
    assert page.input_value("#query") == "furniture"
    assert page.inner_text("#query-result") == "furniture: 30 Gaussians"
    assert not page.is_checked("#layer-path") and page.is_checked("#layer-loops")
    assert page.locator("#layer-loops").is_hidden(), "there are no loops now"
    page.fill("#query", "")
    page.get_by_role("button", name="structure").click()
    show(server, watched, with_objects())
    chosen = page.locator('#legend button[aria-pressed="true"] span').all_text_contents()
    assert chosen == ["structure"], "the choice in the legend was lost"


def test_labels_may_appear_later_and_their_tree_may_be_renumbered(server, watched):
    page, scene = watched.page, two_panels()
    plain = replace(scene.splats, levels=None, confidence=None)
    show(server, watched, replace(scene, tree=None, splats=plain))
    assert page.locator("#level").is_hidden()
    show(server, watched, scene)
    page.get_by_role("radio", name="Classes").click()
    assert page.inner_text("#level-name") == "2 of 2: class"
    page.get_by_role("button", name="wall").click()
    last = len(scene.tree.nodes) - 1
    splats = replace(scene.splats, levels=last - scene.splats.levels)
    tree = replace(scene.tree, nodes=scene.tree.nodes[::-1])
    show(server, watched, replace(scene, splats=splats, tree=tree))
    chosen = page.locator('#legend button[aria-pressed="true"] span').all_text_contents()
    assert chosen == ["wall"]
    show(server, watched, replace(scene, tree=None, splats=plain))
    assert page.evaluate("semsplatViewer.colouring.observed"), "colours as without labels"


def test_the_tree_of_objects_grows_and_keeps_open_rooms_and_the_choice(server, watched):
    page = watched.page
    left, right = table(4, -0.9), table(6, -0.5, "room 2")
    show(server, watched, with_objects())
    assert page.locator("#graph").is_hidden()
    show(server, watched, with_objects(left, right))
    page.get_by_text("room 2 (1)").click()
    page.get_by_role("button", name="table 6").click()
    page.evaluate("window.before = document.querySelector('#graph button[aria-pressed=true]')")
    third = replace(table(8, 0.2, "room 2"), name="chair 8")
    renamed = replace(right, name="desk 6", relations=("on <b>floor</b> 2",))
    show(server, watched, with_objects(left, third, renamed))
    assert page.get_by_text("room 2 (2)").is_visible()
    assert page.get_by_role("button", name="chair 8").is_visible(), "the room was closed"
    assert pressed(watched) == ["desk 6"]
    assert page.get_by_text("on <b>floor</b> 2").is_visible()
    same = "before === document.querySelector('#graph button[aria-pressed=true]')"
    assert page.evaluate(same), "a click between two states would be lost"
    assert page.evaluate("semsplatViewer.lines.groups.object.count") == 12
    show(server, watched, with_objects(left))
    assert pressed(watched) == [] and page.get_by_text("room 2").count() == 0
    assert page.evaluate("semsplatViewer.lines.groups.object.count") == 0


def test_a_click_chooses_the_object_with_the_nearest_voxels(server, watched):
    page = watched.page
    halves = (table(4, -0.9), table(9, -0.5))
    show(server, watched, with_objects(*halves))
    for layer in ("path", "keyframes", "loops"):
        page.uncheck(f"#layer-{layer}")
    page.mouse.click(380, 280)
    assert pressed(watched) == ["table 9"] and "furniture > table" in page.inner_text("#picked")
    x, y, _ = page.evaluate("semsplatViewer.camera.project([-0.55, 0, 2])")
    page.mouse.click(x, y)
    assert pressed(watched) == ["table 4"]
    show(server, watched, with_objects(halves[0]))
    assert pressed(watched) == ["table 4"]
    page.mouse.click(*WALL)
    assert pressed(watched) == [], "the wall is no object"


def test_the_chosen_keyframe_stays_and_follows_corrections(server, watched):
    page = watched.page
    show(server, watched, two_panels())
    page.evaluate("semsplatViewer.camera.zoom(3); semsplatViewer.moved()")
    x, y, _ = page.evaluate("semsplatViewer.camera.project([0, 0, 0.015])")
    page.mouse.click(x, y)
    assert page.locator("#keyframe img").is_visible()
    scene = two_panels()
    corrected = scene.keyframes[0].T_map_camera.copy()
    corrected[1, 3] = 0.4
    later = replace(scene.keyframes[0], T_map_camera=corrected, image=None)
    show(server, watched, replace(scene, keyframes=(scene.keyframes[1], later)))
    assert page.locator("#keyframe img").is_visible(), "the image was lost"
    page.get_by_role("button", name="View from here").click()
    assert page.evaluate("semsplatViewer.camera.eye") == pytest.approx([0.0, 0.4, 0.0], abs=1e-6)
    show(server, watched, replace(scene, keyframes=scene.keyframes[1:]))
    assert page.locator("#keyframe").is_hidden()


def test_colours_of_the_last_state_are_drawn(server, watched):
    scene = two_panels()
    show(server, watched, scene)
    for layer in ("path", "keyframes", "loops"):
        watched.page.uncheck(f"#layer-{layer}")
    swapped = replace(scene.splats, rgb=scene.splats.rgb[:, ::-1].copy())
    for splats, red_table in ((swapped, False), (scene.splats, True)):
        show(server, watched, replace(scene, splats=splats))
        watched.page.wait_for_timeout(300)
        red, _, blue = mean_colour(watched.picture(), *TABLE)
        assert (red > 120 > blue) == red_table


def test_a_live_map_may_become_a_streamed_one_and_a_small_one_again(server, watched):
    page = watched.page
    large = StreamedMap.build(two_panels(3000), 1500, node_size=200, root_size=200)
    show(server, watched, two_panels())
    for shown in (large, two_panels(), large):
        show(server, watched, shown)
        if shown is large:
            page.wait_for_selector("#view[data-complete=true]", timeout=20_000)
            assert "at most 1,500 at once" in page.inner_text("#counts")
            assert page.evaluate("semsplatViewer.detail.loadedBytes") > 0
        page.mouse.click(*TABLE)
        assert "furniture > table" in page.inner_text("#picked")


def test_a_part_that_the_server_no_longer_has_leads_to_its_new_map(server, watched):
    """A page does not ask for new states of a finished map."""
    large = StreamedMap.build(two_panels(3000), 1500, node_size=200, root_size=200)
    server.show(large, finished=True)
    watched.page.goto(server.url)
    watched.page.wait_for_selector("#view[data-complete=true]", timeout=20_000)
    asked = len(watched.requests)
    server.show(WholeMap(replace(two_panels(), title="another")), finished=True)
    watched.page.wait_for_timeout(1500)
    assert len(watched.requests) == asked
    watched.page.evaluate("semsplatViewer.detail.request(2)")
    watched.page.locator("#title", has_text="another").wait_for()
    watched.errors.clear()  # Chromium names the missing part


@contextmanager
def other_site(content: str) -> Iterator[str]:
    """The address of another page on this computer."""

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(200)
            self.send_header("Content-Type", "text/html")
            self.end_headers()
            self.wfile.write(content.encode())

        def log_message(self, *words: object) -> None:
            pass

    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as site:
        threading.Thread(target=site.serve_forever, daemon=True).start()
        yield f"http://localhost:{site.server_address[1]}/"
        site.shutdown()


READ = """async (url) => {
  const outcome = {};
  for (const path of ["", "state", "scene"]) {
    for (const mode of ["cors", "no-cors"]) {
      outcome[`${mode} ${path}`] = await fetch(url + "/" + path, { mode }).then(
        async (answer) => (await answer.text()).length, () => "refused");
    }
  }
  const loaded = (name, properties) => new Promise((done) => {
    const created = Object.assign(document.createElement(name), properties);
    created.onload = () => done("loaded");
    created.onerror = () => done("refused");
    document.body.append(created);
  });
  outcome.script = await loaded("script", { src: url + "/scene" });
  outcome.image = await loaded("img", { src: url + "/scene" });
  outcome.socket = await new Promise((done) => {
    const socket = new WebSocket(url.replace("http", "ws") + "/state");
    socket.onopen = () => done("open");
    socket.onerror = () => done("refused");
  });
  const frame = document.createElement("iframe");
  frame.src = url;
  document.body.append(frame);
  await new Promise((done) => { frame.onload = done; });
  const opened = window.open(url);
  // The handle of an empty window is valid until the page arrives, which takes longer under load.
  for (let wait = 0; wait < 100 && !opened.closed; wait++) {
    await new Promise((done) => setTimeout(done, 100));
  }
  try { outcome.window = opened.document.body?.innerText ?? "refused"; }
  catch { outcome.window = "refused"; }
  outcome.control = opened.closed ? "refused" : "possible";
  return outcome;
}"""


def test_other_pages_cannot_read_or_embed_the_map(server, browser):
    server.show(WholeMap(two_panels()), finished=True)
    with other_site("<p>elsewhere</p>") as address:
        page = browser.new_page()
        page.goto(address)
        urls = (server.url, server.url.replace("127.0.0.1", "localhost"))
        for url in urls:
            outcome = page.evaluate(READ, url)
            assert set(outcome.values()) == {"refused"}, (url, outcome)
            assert "<canvas" not in page.frames[-1].content(), "the map is embedded"
        page.close()


HOSTILE = "<img src=x onerror=document.title=1></script><script>document.title=1</script>"


def hostile_scene() -> ViewerScene:
    scene = two_panels()
    nodes = tuple(
        ShownNode(tuple(f"{name} {HOSTILE}" for name in node.path), node.level, node.rgb)
        for node in scene.tree.nodes
    )
    levels = tuple(f"{name} {HOSTILE}" for name in scene.tree.levels)
    relation = (f"on {HOSTILE}",)
    one = replace(table(4, -0.9, HOSTILE), name=HOSTILE, relations=relation, storey=HOSTILE)
    one = replace(one, path=nodes[int(scene.splats.levels[0, 1])].path)
    tree = ShownTree(levels, nodes)
    return replace(
        scene, title=HOSTILE, tree=tree, objects=(one,), notes=(HOSTILE,), length=HOSTILE
    )


@pytest.mark.parametrize("kind", ["served", "offline"])
def test_names_are_never_markup(server, browser, tmp_path, kind):
    watched = WatchedPage(browser)
    page = watched.page
    page.add_init_script("window.addEventListener('error', () => { window.failed = true; }, true)")
    if kind == "served":
        server.show(WholeMap(hostile_scene()), HOSTILE, finished=True)
        page.goto(server.url)
    else:
        write_page(tmp_path / "page.html", hostile_scene())
        page.goto((tmp_path / "page.html").as_uri())
    page.wait_for_selector("#view[data-frames]", timeout=20_000)
    page.get_by_role("radio", name="Classes").click()
    page.fill("#query", "table")
    page.locator("#graph summary").first.wait_for()
    page.mouse.click(*TABLE)
    page.locator("#graph button").first.click()
    assert page.title() == HOSTILE
    shown = page.inner_text("body")
    # Title, status, level, search, legend, storey, room, object, size, relation, note, class, unit.
    assert shown.count("<img src=x") >= (13 if kind == "served" else 12)
    assert page.locator("img").count() == 0
    assert watched.errors == []
    page.close()


def test_injected_scripts_do_not_run(server, browser):
    """Even if a name became markup, the policy of the page lets nothing else run."""
    server.show(WholeMap(two_panels()), finished=True)
    watched = WatchedPage(browser)
    watched.page.goto(server.url)
    watched.page.wait_for_selector("#view[data-frames]", timeout=20_000)
    watched.page.locator("#help").evaluate(
        """(help) => {
          help.innerHTML = "<img src='data:,' onerror='window.ran = 1'>";
          const script = document.createElement("script");
          script.textContent = "window.ran = 1";
          help.append(script);
        }"""
    )
    watched.page.wait_for_timeout(300)
    assert watched.page.evaluate("window.ran") is None
    assert all("Content Security Policy" in error for error in watched.errors)
    assert len(watched.errors) == 2
    watched.page.close()
