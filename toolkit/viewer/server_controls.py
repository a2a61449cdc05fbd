"""The controls of the server: colours, level of the class tree, search, layers and picking."""

from __future__ import annotations

from html import escape
from typing import Any

import numpy as np

from toolkit.viewer.colouring import CLASSES, COLOUR, LegendRow, colour_modes, legend
from toolkit.viewer.object_tree import ObjectTree
from toolkit.viewer.picking import object_at, pick
from toolkit.viewer.scene import ShownKeyframe, ViewerScene
from toolkit.viewer.server_scene import ServerScene

_LAYERS = {"path": "Camera path", "keyframes": "Keyframes", "loops": "Loops"}
_NOTHING = "none"
_CLICK = "Click a Gaussian or the image of a keyframe."


class Controls:
    """The panel beside the view; all browsers share its state.

    Args:
        server: a viser server.
        view: the 3D content.
        highlight: text of the search at the start.
    """

    def __init__(self, server: Any, view: ServerScene, highlight: str = "") -> None:
        self._view, self._gui = view, server.gui
        self._keyframe: ShownKeyframe | None = None
        self._layers: dict[str, Any] = {}
        self._add_widgets(highlight)
        self._objects = ObjectTree(server, view)
        view.keyframe_clicked = self._show_keyframe
        server.scene.on_click()(self._clicked)
        self._repaint()

    @property
    def _scene(self) -> ViewerScene:
        return self._view.scene

    def replaced(self) -> None:
        """Adapt the controls to a new scene."""
        self._counts.content = _counts(self._scene)
        modes = colour_modes(self._scene)
        if tuple(modes) != tuple(self._mode.options):
            chosen = self._mode.value
            self._mode.options = modes
            self._mode.value = chosen if chosen in modes else COLOUR
        self._objects.update()
        self._repaint()

    def _add_widgets(self, highlight: str) -> None:
        gui, scene = self._gui, self._scene
        self._counts = gui.add_markdown(_counts(scene))
        modes = colour_modes(scene)
        start = CLASSES if highlight and CLASSES in modes else COLOUR
        self._mode = gui.add_dropdown("Colours", modes, initial_value=start)
        self._mode.on_update(lambda _event: self._repaint())
        depth = 0 if scene.tree is None else len(scene.tree.levels)
        labelled = CLASSES in modes
        self._level = gui.add_slider("Level", 1, max(depth, 2), 1, max(depth, 1), visible=labelled)
        self._level.on_update(lambda _event: self._level_moved())
        self._level_name = gui.add_markdown("", visible=labelled)
        self._search = gui.add_text("Find class", highlight, visible=labelled)
        self._search.on_update(lambda _event: self._repaint())
        self._choice = gui.add_dropdown("Highlight", [_NOTHING], visible=labelled)
        self._choice.on_update(lambda _event: self._repaint_splats())
        self._found = gui.add_markdown("", visible=labelled)
        with gui.add_folder("Legend"):
            self._legend = gui.add_html("")
        for layer, name in _LAYERS.items():
            self._add_layer(layer, name)
        with gui.add_folder("Selection"):
            self._picked = gui.add_markdown(_CLICK)
            self._image = gui.add_image(np.zeros((3, 4, 3), np.uint8), visible=False)
            self._go = gui.add_button("View from here", visible=False)
            self._go.on_click(self._view_from_keyframe)

    def _add_layer(self, layer: str, name: str) -> None:
        box = self._gui.add_checkbox(name, initial_value=True)
        box.on_update(lambda _event: self._view.show_layer(layer, box.value))
        self._layers[layer] = box

    def _level_moved(self) -> None:
        # The assignment repaints if it changes the value.
        if self._mode.value != CLASSES:
            self._mode.value = CLASSES
        else:
            self._repaint()

    def _repaint(self) -> None:
        """Show the chosen colours and their legend."""
        tree, level = self._scene.tree, self._level.value - 1
        if tree is not None:
            self._level_name.content = f"{self._level.value} of {len(tree.levels)}: " + (
                f"**{tree.levels[level]}**"
            )
        rows = legend(self._scene, self._mode.value, level)
        self._legend.content = _legend_html(rows)
        names = [row.name for row in rows] if self._mode.value == CLASSES else []
        options = [_NOTHING, *(name for name in names if name != "no class")]
        if tuple(options) != tuple(self._choice.options):
            self._choice.options = options
        self._repaint_splats()

    def _repaint_splats(self) -> None:
        nodes = self._highlighted()
        self._view.paint(self._mode.value, self._level.value - 1, nodes or None)

    def _highlighted(self) -> list[int]:
        """Return the nodes of the search, or of the choice in the legend."""
        tree, text = self._scene.tree, self._search.value.strip()
        if tree is None:
            return []
        if text:
            nodes = tree.matching(text)
            self._found.content = self._found_text(nodes)
            return nodes
        self._found.content = ""
        if self._choice.value == _NOTHING:
            return []
        level = self._level.value - 1
        return [
            i
            for i, node in enumerate(tree.nodes)
            if node.level == level and node.path[-1] == self._choice.value
        ]

    def _found_text(self, nodes: list[int]) -> str:
        tree, levels = self._scene.tree, self._scene.splats.levels
        if not nodes or tree is None or levels is None:
            return "No class has this name."
        members = np.zeros(len(levels), bool)
        for node in nodes:
            members |= levels[:, tree.nodes[node].level] == node
        names = [tree.nodes[node].path[-1] for node in nodes]
        more = ", ..." if len(names) > 3 else ""
        return f"{', '.join(names[:3])}{more}: {members.sum():,} Gaussians"

    def _clicked(self, event: Any) -> None:
        """Describe the Gaussian at a click, and choose its object; none if it has none."""
        scene = self._scene  # may be replaced meanwhile, by the thread that follows a run
        origin, direction = np.array(event.ray_origin), np.array(event.ray_direction)
        splat, number = pick(scene.splats, origin, direction), None
        if splat is not None:
            point_m, path = scene.splats.means_m[splat], scene.class_path(splat)
            number = object_at(scene.objects, point_m, path)
        self._picked.content = _CLICK if splat is None else describe(scene, splat)
        self._objects.choose(number)

    def _show_keyframe(self, keyframe: ShownKeyframe, _client: Any) -> None:
        self._keyframe = keyframe
        if keyframe.image is not None:
            self._image.image = keyframe.image
        self._image.label = f"Keyframe {keyframe.index}"
        self._image.visible = self._go.visible = True

    def _view_from_keyframe(self, event: Any) -> None:
        if self._keyframe is not None and event.client is not None:
            # The images of the neighbouring keyframes would cover the map.
            self._layers["keyframes"].value = False
            self._view.view_from(self._keyframe, event.client)


def describe(scene: ViewerScene, splat: int) -> str:
    """Return what is known about a Gaussian, as Markdown."""
    splats = scene.splats
    rows = []
    if scene.tree is not None:
        rows.append(("class", " > ".join(scene.class_path(splat)) or "unknown"))
    if splats.confidence is not None:
        rows.append(("confidence", f"{100.0 * splats.confidence[splat]:.0f} %"))
    if splats.inferred is not None:
        rows.append(("depth", "inferred" if splats.inferred[splat] else "measured"))
    if splats.submap is not None:
        rows.append(("submap", str(splats.submap[splat])))
    rows.append(
        ("position", " ".join(f"{v:.2f}" for v in splats.means_m[splat]) + f" {scene.length}")
    )
    return "  \n".join(f"**{name}** {value}" for name, value in rows)


def _counts(scene: ViewerScene) -> str:
    shown = f"{len(scene.splats):,}"
    of = f" of {scene.total:,}" if len(scene.splats) < scene.total else ""
    notes = "".join(f"\n- {note}" for note in scene.notes)
    return f"**{scene.title}**  \n{shown}{of} Gaussians\n{notes}"


def _legend_html(rows: list[LegendRow]) -> str:
    """Return the legend; viser's panel has no list of its own."""
    lines = []
    for row in rows:
        colour = "rgb({}, {}, {})".format(*row.rgb)
        lines.append(
            '<div style="display:flex;gap:8px;align-items:center;font-size:13px;padding:1px 8px">'
            f'<i style="width:12px;height:12px;border-radius:3px;background:{colour}"></i>'
            f'<span style="flex:1">{escape(row.name)}</span>'
            f"<small>{100.0 * row.fraction:.1f} %</small></div>"
        )
    return f'<div style="max-height:220px;overflow-y:auto">{"".join(lines)}</div>'
