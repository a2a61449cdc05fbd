"""The scene graph in the panel of the server: rooms, and the objects in them."""

from __future__ import annotations

import threading
from dataclasses import dataclass
from html import escape
from typing import Any

from toolkit.viewer.scene import ShownObject
from toolkit.viewer.server_scene import ServerScene

_COLOUR, _CHOSEN_COLOUR = "gray", "yellow"
# Place of what lies above all rooms, where a click in the view is seen to have an effect.
_FIRST = -1.0
# Its height does not change, or the entries below would move away under the pointer.
_CARD_STYLE = "font-size:13px;padding:4px 8px;height:100px;overflow-y:auto"
_NOTHING = "No object is chosen. Click one here or in the view."


@dataclass
class _Entry:
    """An object in the tree, with its button."""

    shown: ShownObject
    button: Any


class ObjectTree:
    """Folders of rooms with a button for each object, which marks the object in the view.

    While a map grows, entries are only added, renamed, moved and removed: open folders stay open,
    and the chosen object stays chosen.

    Args:
        server: a viser server.
        view: the 3D content, whose objects are shown.
    """

    def __init__(self, server: Any, view: ServerScene) -> None:
        self._server, self._view = server, view
        self._folder = server.gui.add_folder("Objects", visible=False)
        with self._folder:
            self._details = server.gui.add_html("", order=_FIRST)
        self._rooms: dict[str, Any] = {}
        self._entries: dict[int, _Entry] = {}
        self._chosen: int | None = None
        # Browsers choose in threads of their own while the thread that follows a run updates.
        self._lock = threading.RLock()
        self.update()

    def update(self) -> None:
        """Show the objects of the scene."""
        with self._lock, self._server.atomic():
            objects = {one.number: one for one in self._view.scene.objects}
            for number, entry in list(self._entries.items()):
                one = objects.get(number)
                if one is None or _place(one) != _place(entry.shown):
                    self._entries.pop(number).button.remove()
            self._update_rooms([_place(one) for one in objects.values()])
            for one in objects.values():
                self._update_entry(one)
            self._folder.visible = bool(objects)
            self._show_chosen()

    def choose(self, number: int | None) -> None:
        """Mark an object in the view and list its relations; None for no object."""
        with self._lock, self._server.atomic():
            self._chosen = number
            self._show_chosen()

    def _update_rooms(self, rooms: list[str]) -> None:
        for room in [name for name in self._rooms if name not in rooms]:
            self._rooms.pop(room).remove()
        for place, room in enumerate(dict.fromkeys(rooms)):
            label = f"{room} ({rooms.count(room)})"
            if room not in self._rooms:
                with self._folder:
                    self._rooms[room] = self._server.gui.add_folder(
                        label, expand_by_default=not self._rooms
                    )
            folder = self._rooms[room]
            if folder.label != label:
                folder.label = label
            if folder.order != place:
                folder.order = place

    def _update_entry(self, one: ShownObject) -> None:
        entry = self._entries.get(one.number)
        if entry is None:
            with self._rooms[_place(one)]:
                button = self._server.gui.add_button(one.name, color=_COLOUR, order=one.number)
            button.on_click(lambda event: self._clicked(one.number, event.client))
            self._entries[one.number] = _Entry(one, button)
            return
        if entry.shown.name != one.name:
            entry.button.label = one.name
        entry.shown = one

    def _clicked(self, number: int, client: Any) -> None:
        with self._lock:
            entry = self._entries.get(number)
            if entry is None:
                return  # removed meanwhile
            self.choose(None if number == self._chosen else number)
            if self._chosen == number and client is not None:
                self._view.look_at(entry.shown, client)

    def _show_chosen(self) -> None:
        """Mark the chosen object; one that is no longer in the graph is not chosen."""
        if self._chosen not in self._entries:
            self._chosen = None
        for number, entry in self._entries.items():
            colour = _CHOSEN_COLOUR if number == self._chosen else _COLOUR
            if entry.button.color != colour:
                entry.button.color = colour
        chosen = None if self._chosen is None else self._entries[self._chosen].shown
        self._view.mark(chosen)
        self._details.content = _card_html(chosen, self._view.scene.length)


def _place(one: ShownObject) -> str:
    """Name of the folder of an object."""
    room = one.room or "no room"
    return f"{one.storey}, {room}" if one.storey else room


def _card_html(chosen: ShownObject | None, length: str) -> str:
    """Name, place, size and relations of the chosen object."""
    if chosen is None:
        return f'<div style="{_CARD_STYLE}">{_NOTHING}</div>'
    about = f"{_place(chosen)}, {' x '.join(f'{edge:.2f}' for edge in chosen.size_m)} {length}"
    lines = "".join(f"<li>{escape(relation)}</li>" for relation in chosen.relations)
    text = f"<b>{escape(chosen.name)}</b><br>{escape(about)}<ul style='margin:0'>{lines}</ul>"
    return f'<div style="{_CARD_STYLE}">{text}</div>'
