"""Families of large furniture, each with ranges of shape instead of one size.

Every piece rests on z = 0 with its back at y = 0 and its front towards -y.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.random import Generator

from data_tools.training_rooms import clutter
from data_tools.training_rooms.solids import (
    Piece,
    Solid,
    box,
    cylinder,
    extent,
    lathe,
    placed,
    rounded,
    sheet,
    tilted,
)

Maker = Callable[[Generator], Piece]


def chance(rng: Generator, probability: float) -> bool:
    """Whether an event of this probability happens."""
    return bool(rng.random() < probability)


def _legs(name: str, width: float, depth: float, height: float, thick: float) -> Piece:
    """Four legs under a rectangle whose back is at y = 0."""
    places = [
        (x, y)
        for x in (thick / 2 - width / 2, width / 2 - thick / 2)
        for y in (-thick / 2, thick / 2 - depth)
    ]
    return [box(name, (thick, thick, height), (x, y, 0.0)) for x, y in places]


def table(rng: Generator, low: bool | None = None) -> Piece:
    """A table on legs, panels, a trestle or a column, or a solid low one; often laid."""
    lows, highs = ["coffee", "coffee", "side"], ["dining", "conference", "round"]
    kinds = lows if low else lows + highs
    kind = rng.choice(kinds)
    low = kind in ("coffee", "side")
    height = rng.uniform(0.28, 0.55) if low else rng.uniform(0.7, 0.78)
    ranges = {
        "dining": ((0.9, 2.2), (0.7, 1.0)),
        "coffee": ((0.6, 1.4), (0.45, 0.9)),
        "side": ((0.35, 0.6), (0.35, 0.6)),
        "conference": ((1.6, 3.2), (0.9, 1.4)),
        "round": ((0.6, 1.3), (0.6, 1.3)),
    }
    width, depth = (rng.uniform(*limits) for limits in ranges[str(kind)])
    thick = rng.uniform(0.015, 0.06)
    base = height - thick
    if kind == "round" or (low and chance(rng, 0.3)):
        depth = width
        piece = [cylinder("table", width / 2, thick, (0.0, -depth / 2, base))]
    else:
        piece = [box("table", (width, depth, thick), (0.0, -depth / 2, base))]
    piece += _table_base(rng, width, depth, base, low)
    count = rng.poisson(0.8 if low else 2.5 * width)
    return piece + clutter.scattered(rng, (width, depth), height, count)


def _table_base(rng: Generator, width: float, depth: float, height: float, low: bool) -> Piece:
    kinds = ["legs", "legs", "column", "panels"] + (["solid", "shelf"] if low else ["trestle"])
    kind = rng.choice(kinds)
    inner_w, inner_d = width * rng.uniform(0.75, 0.98), depth * rng.uniform(0.75, 0.98)
    thick = rng.uniform(0.025, 0.09)
    back = -(depth - inner_d) / 2
    if kind == "column":
        foot = min(width, depth) * rng.uniform(0.5, 0.8)
        return [
            cylinder("table", thick, height, (0.0, -depth / 2, 0.0)),
            cylinder("table", foot / 2, 0.03, (0.0, -depth / 2, 0.0)),
        ]
    if kind == "solid":
        return [box("table", (inner_w, inner_d, height), (0.0, -depth / 2, 0.0))]
    sides: Piece = []
    if kind in ("panels", "trestle"):
        at = (inner_w - thick) / 2 * (1.0 if kind == "panels" else 0.7)
        sides = [box("table", (thick, inner_d, height), (x, -depth / 2, 0.0)) for x in (-at, at)]
    else:
        sides = placed(_legs("table", inner_w, inner_d, height, thick), (0.0, back, 0.0))
    if kind == "shelf" or chance(rng, 0.15):
        level = height * rng.uniform(0.2, 0.5)
        sides.append(box("table", (inner_w, inner_d, 0.02), (0.0, -depth / 2, level)))
    return sides


def desk(rng: Generator) -> Piece:
    """A desk with drawers or panels, in a line or at an angle, with screens and things."""
    width, depth = rng.uniform(1.0, 1.9), rng.uniform(0.55, 0.9)
    height, thick = rng.uniform(0.68, 0.78), rng.uniform(0.018, 0.04)
    base = height - thick
    piece = [box("desk", (width, depth, thick), (0.0, -depth / 2, base))]
    piece += _legs("desk", width * 0.97, depth * 0.95, base, rng.uniform(0.03, 0.07))
    if chance(rng, 0.5):
        x = (width / 2 - 0.25) * rng.choice([-1.0, 1.0])
        drawers = (0.4, depth * 0.85, base - (0.0 if chance(rng, 0.6) else 0.25))
        piece.append(box("desk", drawers, (x, -depth / 2, base - drawers[2])))
    if chance(rng, 0.4):
        drop = base * rng.uniform(0.3, 1.0)
        piece.append(box("desk", (width * 0.95, 0.02, drop), (0.0, -0.05, base - drop)))
    if chance(rng, 0.2):
        arm = rng.uniform(0.5, 0.9)
        x = (width / 2 - 0.3) * rng.choice([-1.0, 1.0])
        piece.append(box("desk", (0.6, arm, thick), (x, -depth - arm / 2, base)))
        piece += placed(_legs("desk", 0.55, arm, base, 0.05), (x, -depth, 0.0))
    for x in (-0.3 * width, 0.3 * width) if chance(rng, 0.4) else (0.0,):
        if chance(rng, 0.8):
            maker = clutter.monitor if chance(rng, 0.75) else clutter.laptop
            shift = (x + rng.normal(0, 0.05), -rng.uniform(0.1, 0.25), height)
            piece += placed(maker(rng), shift, rng.normal(0, 0.2))
    if chance(rng, 0.6):
        keys = box("thing", (0.44, 0.14, 0.02))
        piece += placed([keys], (0.0, -depth * 0.7, height), rng.normal(0, 0.1))
    return piece + clutter.scattered(rng, (width, depth), height, rng.poisson(3.0))


def chair(rng: Generator) -> Piece:
    """A wooden, swivel, cantilever or shell chair, an armchair without much volume, or a stool."""
    kind = rng.choice(["wooden", "swivel", "swivel", "shell", "stool", "padded"])
    width, depth = rng.uniform(0.38, 0.55), rng.uniform(0.38, 0.52)
    seat = rng.uniform(0.4, 0.5)
    if kind == "stool":
        return _stool(rng, width, rng.uniform(0.4, 0.78))
    piece: Piece = []
    back = seat + rng.uniform(0.3, 0.6)
    thick = rng.uniform(0.02, 0.09) if kind != "wooden" else 0.03
    piece.append(rounded("chair", (width, depth, 2 * thick), (0.0, -depth / 2, seat - thick), 6.0))
    piece += _chair_base(rng, "star" if kind == "swivel" else "legs", width, depth, seat)
    lean = rng.uniform(0.05, 0.3)
    gap = rng.uniform(0.05, 0.2) if kind in ("swivel", "wooden") else 0.0
    plate = _chair_back(rng, kind == "wooden", width, back - seat - gap)
    piece += tilted(plate, -lean, (0.0, -0.05, seat + gap))
    if kind in ("swivel", "padded") and chance(rng, 0.6):
        for x in (-width / 2 - 0.03, width / 2 + 0.03):
            piece.append(box("chair", (0.05, depth * 0.6, 0.03), (x, -depth / 2, seat + 0.2)))
            piece.append(box("chair", (0.03, 0.06, 0.24), (x, -depth / 2, seat - 0.03)))
    return piece


def _chair_back(rng: Generator, slats: bool, width: float, height: float) -> Piece:
    if not slats:
        thick = rng.uniform(0.02, 0.08)
        return [rounded("chair", (width, thick, height), (0.0, -thick / 2, 0.0), 6.0)]
    size = (0.035, 0.035, height)
    posts = [box("chair", size, (x * width, -0.02, 0.0)) for x in (-0.46, 0.46)]
    bars = int(rng.integers(2, 5))
    return posts + [
        box("chair", (width * 0.92, 0.02, 0.05), (0.0, -0.02, height * (k + 0.6) / bars))
        for k in range(bars)
    ]


def _chair_base(rng: Generator, kind: str, width: float, depth: float, seat: float) -> Piece:
    if kind == "legs":
        return _legs("chair", width * 0.95, depth * 0.95, seat, rng.uniform(0.02, 0.045))
    base: Piece = [cylinder("chair", 0.03, seat - 0.08, (0.0, -depth / 2, 0.08))]
    arm = [box("chair", (0.3, 0.05, 0.04), (0.15, 0.0, 0.05))]
    for k in range(5):
        base += placed(arm, (0.0, -depth / 2, 0.0), 2 * np.pi * k / 5)
    return base


def _stool(rng: Generator, width: float, height: float) -> Piece:
    centre = (0.0, -width / 2, 0.0)
    if chance(rng, 0.3):
        return [rounded("chair", (width, width, height * 0.6), centre, 5.0)]
    seat = cylinder("chair", width / 2, 0.05, (0.0, -width / 2, height - 0.05))
    if chance(rng, 0.5):
        return [seat, *_legs("chair", width * 0.8, width * 0.8, height, 0.03)]
    return [seat, cylinder("chair", 0.03, height, centre), cylinder("chair", 0.2, 0.03, centre)]


def sofa(rng: Generator) -> Piece:
    """A sofa of two to four seats, straight or with a corner; with cushions."""
    return _upholstered(rng, "sofa", int(rng.choice([2, 2, 3, 3, 4])), rng.uniform(0.5, 0.75))


def armchair(rng: Generator) -> Piece:
    """An armchair or a low lounge chair, which is a chair."""
    return _upholstered(rng, "chair", 1, rng.uniform(0.45, 0.75))


def _upholstered(rng: Generator, name: str, seats: int, place: float) -> Piece:
    arm = rng.uniform(0.06, 0.28) if chance(rng, 0.85 if seats > 1 else 0.6) else 0.0
    depth, seat, back = rng.uniform(0.7, 1.05), rng.uniform(0.33, 0.48), rng.uniform(0.6, 0.95)
    inner = seats * place
    width = inner + 2 * arm
    thick, foot = rng.uniform(0.08, 0.26), rng.uniform(0.0, 0.18)
    power = rng.uniform(5.0, 14.0)
    body = [box(name, (width, depth, seat * 0.6 - foot), (0.0, -depth / 2, foot))]
    body.append(rounded(name, (width, thick, back - foot), (0.0, -thick / 2, foot), power))
    if arm:
        high = rng.uniform(seat + 0.08, back)
        for x in (-(inner + arm) / 2, (inner + arm) / 2):
            size = (arm, depth, high - foot)
            body.append(rounded(name, size, (x, -depth / 2, foot), power))
    if foot:
        body += _legs(name, width * 0.95, depth * 0.95, foot, 0.05)
    loose = chance(rng, 0.5)
    for k in range(seats):
        x = (k + 0.5) * place - inner / 2
        size = (place, depth - thick, 0.5 * seat)
        body.append(rounded(name, size, (x, -thick / 2 - depth / 2, 0.5 * seat), 8.0))
        if loose:
            upright = [rounded(name, (place, 0.18, back - seat), power=4.0)]
            body += tilted(upright, -0.2, (x, -thick - 0.05, seat))
    if seats > 1 and chance(rng, 0.3):
        x = (inner / 2 - place / 2) * rng.choice([-1.0, 1.0])
        reach = rng.uniform(0.5, 0.9)
        size = (place, reach, seat - foot)
        body.append(rounded(name, size, (x, -depth - reach / 2, foot), power))
    for _ in range(rng.poisson(0.6 * seats)):
        x = rng.uniform(-inner / 2 + 0.2, inner / 2 - 0.2)
        lean = tilted(clutter.cushion(rng), rng.uniform(-0.5, -0.1) + np.pi / 2)
        body += placed(lean, (x, -thick - 0.15, seat + 0.2), rng.normal(0, 0.3))
    return body


def bed(rng: Generator) -> Piece:
    """A single or double bed or a mattress, with a headboard or none, made or not."""
    width, length = rng.choice([0.9, 1.2, 1.4, 1.6, 1.8]), rng.uniform(1.95, 2.15)
    height = rng.uniform(0.3, 0.62)
    mattress = rng.uniform(0.15, 0.28)
    piece = [rounded("bed", (width, length, mattress), (0.0, -length / 2, height - mattress), 9.0)]
    if chance(rng, 0.85):
        size = (width + 0.06, length + 0.05, height - 0.6 * mattress)
        foot = rng.uniform(0.0, 0.2)
        piece.append(box("bed", (size[0], size[1], size[2] - foot), (0.0, -length / 2, foot)))
        piece += _legs("bed", width, length, foot + 0.02, 0.06)
    if chance(rng, 0.7):
        piece.append(box("bed", (width + 0.1, 0.06, rng.uniform(0.75, 1.2)), (0.0, 0.02, 0.0)))
    if chance(rng, 0.3):
        size = (width + 0.06, 0.05, height + rng.uniform(0.05, 0.3))
        piece.append(box("bed", size, (0.0, -length - 0.03, 0.0)))
    for x in (-0.25, 0.25) if width > 1.3 else (0.0,):
        size = (0.6, 0.4, 0.16)
        piece.append(rounded("cushion", size, (x * width, -0.3, height - 0.03), 3.0))
    if chance(rng, 0.8):
        piece.append(_cover(rng, width, length, height))
    for _ in range(rng.poisson(0.4)):
        x, y = rng.uniform(-0.3, 0.3) * width, -rng.uniform(0.5, length - 0.3)
        piece += placed(clutter.cushion(rng), (x, y, height), rng.uniform(0, 6))
    return piece


def _cover(rng: Generator, width: float, length: float, height: float) -> Solid:
    """A blanket with folds that hangs down at the sides."""
    x = np.linspace(-width / 2 - 0.05, width / 2 + 0.05, 14)
    y = np.linspace(-length - 0.02, -rng.uniform(0.4, 1.0), 12)
    grid_x, grid_y = np.meshgrid(x, y)
    waves = rng.uniform(0.005, 0.04) * np.sin(grid_x * rng.uniform(4, 12) + rng.uniform(0, 6))
    waves *= np.sin(grid_y * rng.uniform(3, 9))
    hanging = np.abs(grid_x) > width / 2
    z = height + 0.03 + waves - hanging * rng.uniform(0.1, 0.3)
    return sheet("bed", np.stack([grid_x, grid_y, z], axis=-1))


def cabinet(rng: Generator) -> Piece:
    """A sideboard, chest of drawers, wardrobe, nightstand, locker or a wall cupboard."""
    kind = rng.choice(["low", "low", "wardrobe", "nightstand", "locker", "wall"])
    ranges = {
        "low": ((0.6, 2.0), (0.35, 0.55), (0.5, 1.1)),
        "wardrobe": ((0.8, 2.4), (0.5, 0.65), (1.8, 2.3)),
        "nightstand": ((0.35, 0.55), (0.35, 0.45), (0.4, 0.65)),
        "locker": ((0.3, 0.6), (0.35, 0.6), (1.0, 1.9)),
        "wall": ((0.4, 1.6), (0.28, 0.4), (0.4, 0.9)),
    }
    width, depth, height = (rng.uniform(*limits) for limits in ranges[str(kind)])
    piece = cabinet_body(rng, width, depth, height)
    if kind == "wall":
        return placed(piece, (0.0, 0.0, rng.uniform(1.2, 1.6)))
    if height < 1.3:
        if chance(rng, 0.25):
            at = (0.0, -depth / 2, height)
            piece += placed(clutter.monitor(rng), at)
        piece += clutter.scattered(rng, (width, depth), height, rng.poisson(1.8 * width))
    elif chance(rng, 0.3):
        piece += clutter.scattered(rng, (width, depth), height, rng.poisson(1.5))
    return piece


def cabinet_body(
    rng: Generator, width: float, depth: float, height: float, columns: int | None = None
) -> Piece:
    """A closed body with doors or drawers, handles, a plinth or feet."""
    foot = rng.uniform(0.0, 0.12)
    piece = [box("cabinet", (width, depth, height - foot), (0.0, -depth / 2, foot))]
    if foot and chance(rng, 0.6):
        size = (width * 0.97, depth * 0.9, foot)
        piece.append(box("cabinet", size, (0.0, -depth * 0.45, 0.0)))
    elif foot:
        piece += _legs("cabinet", width, depth, foot, 0.04)
    columns = columns or max(1, round(width / rng.uniform(0.4, 0.65)))
    rows = int(rng.integers(1, 5)) if height < 1.3 else 1
    gap, cell_w, cell_h = 0.012, width / columns, (height - foot) / rows
    depth_of_fronts = rng.uniform(0.008, 0.025)
    for column in range(columns):
        x = (column + 0.5) * cell_w - width / 2
        for row in range(rows):
            z = foot + row * cell_h
            size = (cell_w - gap, depth_of_fronts, cell_h - gap)
            piece.append(box("cabinet", size, (x, -depth - depth_of_fronts / 2, z + gap / 2)))
            if chance(rng, 0.7):
                handle = (0.12, 0.03, 0.015) if rows > 1 else (0.015, 0.03, 0.15)
                at = (x, -depth - depth_of_fronts - 0.015, z + cell_h * (0.5 if rows > 1 else 0.55))
                piece.append(box("cabinet", handle, at))
    return piece


def shelf(rng: Generator) -> Piece:
    """An open shelf, a rack, or boards on the wall, with books, boxes and things, or bare."""
    kind = rng.choice(["case", "case", "case", "rack", "boards", "cubes"])
    width, depth = rng.uniform(0.4, 2.0), rng.uniform(0.22, 0.45)
    height = rng.uniform(0.7, 2.3)
    board = rng.uniform(0.015, 0.04)
    levels = np.linspace(0.05, height - board, max(2, round(height / rng.uniform(0.25, 0.45))))
    if kind == "boards":
        step = rng.uniform(0.25, 0.4)
        levels = rng.uniform(0.9, 1.5) + step * np.arange(float(rng.integers(1, 4)))
    piece = [box("shelf", (width, depth, board), (0.0, -depth / 2, float(z))) for z in levels]
    if kind == "rack":
        piece += _legs("shelf", width, depth, height, 0.035)
    elif kind != "boards":
        count = 2 if kind == "case" else round(width / 0.35) + 1
        uprights = np.linspace(-width / 2, width / 2, count)
        side = (board, depth, height)
        piece += [box("shelf", side, (float(x), -depth / 2, 0.0)) for x in uprights]
        if chance(rng, 0.7):
            piece.append(box("shelf", (width, 0.01, height), (0.0, -0.005, 0.0)))
    filling = rng.uniform(0.0, 1.0)
    step = float(levels[1] - levels[0]) if len(levels) > 1 else 0.35
    for z in levels:
        piece += clutter.row(rng, width - 0.06, depth, float(z) + board, step - board, filling)
    return piece


def kitchen(rng: Generator) -> Piece:
    """A row of base cabinets with a worktop, sink, stove, wall cupboards and tall units."""
    height, depth = rng.uniform(0.84, 0.94), rng.uniform(0.55, 0.68)
    wall_base, wall_height = height + rng.uniform(0.45, 0.65), rng.uniform(0.5, 0.9)
    wall_depth = rng.uniform(0.3, 0.38)
    piece: Piece = []
    x, units = 0.0, int(rng.integers(3, 8))
    for _ in range(units):
        unit = rng.choice(["base", "base", "base", "sink", "stove", "washer", "tall", "fridge"])
        width = rng.uniform(0.4, 0.9) if unit == "base" else 0.6
        at = (x + width / 2, 0.0, 0.0)
        x += width
        if unit in ("tall", "fridge"):
            tall = rng.uniform(1.4, 2.2)
            closed = cabinet_body(rng, width, depth, tall, columns=1)
            piece += placed(fridge(rng) if unit == "fridge" else closed, at)
            continue
        piece += placed(_base_unit(rng, str(unit), width, depth, height), at)
        if chance(rng, 0.7):
            above = cabinet_body(rng, width, wall_depth, wall_height, columns=1)
            if unit == "stove":
                above = [
                    box("appliance", (width, 0.45, 0.12), (0.0, -0.225, 0.0)),
                    box("appliance", (0.3, 0.3, 0.7), (0.0, -0.15, 0.12)),
                ]
            piece += placed(above, (at[0], 0.0, wall_base))
    return placed(piece, (-x / 2, 0.0, 0.0))


def _base_unit(rng: Generator, unit: str, width: float, depth: float, height: float) -> Piece:
    top = box("cabinet", (width, depth + 0.02, 0.04), (0.0, -depth / 2, height - 0.04))
    if unit in ("stove", "washer"):
        body = box("appliance", (width - 0.01, depth, height - 0.04), (0.0, -depth / 2, 0.0))
        piece = [body, top]
        if unit == "stove":
            piece.append(box("appliance", (0.56, 0.5, 0.01), (0.0, -depth / 2, height), dark=True))
            piece.append(box("appliance", (0.5, 0.03, 0.02), (0.0, -depth - 0.02, height * 0.8)))
            if chance(rng, 0.4):
                pot = cylinder("thing", rng.uniform(0.08, 0.14), rng.uniform(0.06, 0.2))
                piece += placed([pot], (0.12, -depth / 2 + 0.1, height + 0.01))
        return piece
    piece = cabinet_body(rng, width, depth - 0.02, height - 0.04, columns=1)
    if unit == "sink":
        piece += _sunken(width, depth, height)
    else:
        piece.append(top)
        count = rng.poisson(3.0 * width)
        piece += clutter.scattered(rng, (width, depth), height, count)
    return piece


def _sunken(width: float, depth: float, height: float) -> Piece:
    """A basin in a worktop, with a tap."""
    edge = 0.08
    inner_w, inner_d = width - 2 * edge, depth - 2 * edge - 0.04
    back, front = -edge - 0.02, -edge - 0.02 - inner_d
    worktop = [
        box("cabinet", (width, -back, 0.04), (0.0, back / 2, height - 0.04)),
        box("cabinet", (width, depth + front, 0.04), (0.0, (front - depth) / 2, height - 0.04)),
    ]
    for x in (-(inner_w + edge) / 2, (inner_w + edge) / 2):
        at = (x, (back + front) / 2, height - 0.04)
        worktop.append(box("cabinet", (edge, inner_d, 0.04), at))
    basin = box("sanitary", (inner_w, inner_d, 0.02), (0.0, (back + front) / 2, height - 0.2))
    tap = [
        cylinder("sanitary", 0.02, 0.25, (0.0, back / 2, height)),
        box("sanitary", (0.025, 0.18, 0.025), (0.0, back / 2 - 0.09, height + 0.23)),
    ]
    return [*worktop, basin, *tap]


def fridge(rng: Generator) -> Piece:
    """A refrigerator with one or two doors."""
    width, depth, height = rng.uniform(0.5, 0.9), rng.uniform(0.55, 0.75), rng.uniform(0.85, 2.0)
    split = height * rng.uniform(0.3, 0.7)
    piece = [box("appliance", (width, depth, height), (0.0, -depth / 2, 0.0))]
    for low, high in ((0.04, split), (split + 0.01, height)):
        piece.append(box("appliance", (width, 0.05, high - low), (0.0, -depth - 0.025, low)))
        handle = (0.025, 0.04, 0.3 * (high - low))
        piece.append(box("appliance", handle, (-width * 0.4, -depth - 0.07, low + 0.1)))
    return piece


def appliance(rng: Generator) -> Piece:
    """A washing machine, printer, dishwasher or stove that stands alone, or a radiator."""
    kind = rng.choice(["washer", "printer", "radiator", "fridge"])
    if kind == "fridge":
        return fridge(rng)
    if kind == "washer":
        piece = [box("appliance", (0.6, 0.58, 0.85), (0.0, -0.29, 0.0))]
        door = tilted([cylinder("appliance", 0.18, 0.05)], np.pi / 2, (0.0, -0.58, 0.42))
        return piece + door
    if kind == "printer":
        size = (rng.uniform(0.45, 0.7), rng.uniform(0.45, 0.7), rng.uniform(0.5, 1.2))
        top = box("appliance", (size[0] * 0.9, 0.3, 0.2), (0.0, -0.2, size[2]))
        return [box("appliance", size, (0.0, -size[1] / 2, 0.0)), top]
    width, height = rng.uniform(0.5, 1.8), rng.uniform(0.4, 0.7)
    ribs = np.arange(-width / 2, width / 2, rng.uniform(0.05, 0.12))
    return [box("appliance", (0.04, 0.08, height), (float(x), -0.08, 0.12)) for x in ribs] + [
        box("appliance", (width, 0.05, height * 0.9), (0.0, -0.07, 0.14))
    ]


def sanitary(rng: Generator) -> Piece:
    """A toilet, washbasin, bathtub or shower."""
    kind = rng.choice(["toilet", "basin", "bath", "shower"])
    if kind == "toilet":
        bowl = rounded("sanitary", (0.38, 0.5, 0.42), (0.0, -0.42, 0.0), 3.0)
        cistern = box("sanitary", (0.4, 0.18, rng.uniform(0.75, 0.95)), (0.0, -0.09, 0.0))
        lid = cylinder("sanitary", 0.2, 0.03, (0.0, -0.42, 0.4))
        return [bowl, cistern, lid]
    if kind == "basin":
        width, depth, height = rng.uniform(0.4, 0.7), rng.uniform(0.35, 0.5), 0.85
        rim = [
            box("sanitary", (width, 0.06, 0.18), (0.0, -0.03, height - 0.18)),
            box("sanitary", (width, 0.04, 0.18), (0.0, -depth + 0.02, height - 0.18)),
            box("sanitary", (width, depth, 0.03), (0.0, -depth / 2, height - 0.18)),
        ]
        for x in (0.02 - width / 2, width / 2 - 0.02):
            rim.append(box("sanitary", (0.04, depth, 0.18), (x, -depth / 2, height - 0.18)))
        foot = cylinder("sanitary", 0.09, height - 0.18, (0.0, -0.15, 0.0))
        return [*rim, foot] if chance(rng, 0.5) else rim
    width, depth = (rng.uniform(1.5, 1.8), rng.uniform(0.7, 0.85))
    height = rng.uniform(0.5, 0.6)
    if kind == "shower":
        width, depth, height = rng.uniform(0.8, 1.1), rng.uniform(0.8, 1.0), 0.12
    piece = [box("sanitary", (width, depth, height * 0.3), (0.0, -depth / 2, 0.0))]
    for x in (0.03 - width / 2, width / 2 - 0.03):
        piece.append(box("sanitary", (0.06, depth, height), (x, -depth / 2, 0.0)))
    for y in (-0.03, 0.03 - depth):
        piece.append(box("sanitary", (width, 0.06, height), (0.0, y, 0.0)))
    if kind == "shower":
        piece.append(
            box("sanitary", (0.01, depth, 1.9), (width / 2, -depth / 2, height), dark=True)
        )
    return piece


def floor_lamp(rng: Generator) -> Piece:
    """A standing lamp with a shade, or an arc."""
    height, radius = rng.uniform(1.2, 1.9), rng.uniform(0.1, 0.28)
    piece = [
        cylinder("lamp", rng.uniform(0.1, 0.18), 0.03, (0.0, -0.2, 0.0)),
        cylinder("lamp", rng.uniform(0.01, 0.025), height, (0.0, -0.2, 0.0)),
    ]
    return piece + placed([clutter.shade(rng, radius)], (0.0, -0.2, height - 0.15))


def board(rng: Generator) -> Piece:
    """A whiteboard on feet."""
    width, tall = rng.uniform(1.0, 2.0), rng.uniform(0.9, 1.2)
    base = rng.uniform(0.5, 0.9)
    piece = [box("picture", (width, 0.03, tall), (0.0, -0.25, base))]
    for x in (-width / 2, width / 2):
        piece.append(box("picture", (0.04, 0.04, base + tall), (x, -0.25, 0.05)))
        piece.append(box("picture", (0.05, 0.5, 0.05), (x, -0.25, 0.0)))
    return piece


def plant(rng: Generator) -> Piece:
    """A plant on the floor."""
    return placed(clutter.potted(rng, rng.uniform(0.6, 1.8)), (0.0, -0.3, 0.0))


def on_floor(rng: Generator) -> Piece:
    """Boxes, bags, bins or a heap of things on the floor."""
    kind = rng.choice(["boxes", "bin", "bin", "bag", "things"])
    if kind == "boxes":
        piece: Piece = []
        z = 0.0
        for _ in range(rng.integers(1, 4)):
            size = tuple(rng.uniform([0.25, 0.2, 0.15], [0.6, 0.5, 0.45]))
            piece += placed([box("box", size)], (rng.normal(0, 0.03), -0.3, z), rng.normal(0, 0.2))
            z += size[2]
        return piece
    if kind == "bin":
        # Open at the top; four sides make it a square one.
        radius, height = rng.uniform(0.12, 0.28), rng.uniform(0.25, 0.7)
        profile = [(0.0, 0.0), (rng.uniform(0.6, 1.0) * radius, 0.0), (radius, height)]
        bins = [lathe("thing", profile, (0.0, -radius, 0.0), int(rng.choice([4, 12])))]
        if chance(rng, 0.4):
            bins += placed(bins, (2.1 * radius, 0.0, 0.0))
        return bins
    if kind == "bag":
        size = tuple(rng.uniform([0.25, 0.15, 0.25], [0.5, 0.35, 0.5]))
        return [rounded("thing", size, (0.0, -0.25, 0.0), rng.uniform(2, 5))]
    return placed(clutter.scattered(rng, (0.8, 0.6), 0.0, int(rng.integers(2, 6))))


def with_chairs(rng: Generator) -> Piece:
    """A table with chairs around it, pushed in or not."""
    piece = table(rng)
    corners = extent([solid for solid in piece if solid.name == "table"])
    if corners[1, 2] < 0.6:
        return piece
    (x0, y0, _), (x1, y1, _) = corners
    one = chair(rng)
    for _ in range(rng.integers(1, 7)):
        along, out = rng.uniform(0.1, 0.9), rng.uniform(-0.15, 0.5)
        side = rng.integers(4)
        spots = [
            (x0 + along * (x1 - x0), y0 - out, np.pi),
            (x0 + along * (x1 - x0), y1 + out, 0.0),
            (x0 - out, y0 + along * (y1 - y0), np.pi / 2),
            (x1 + out, y0 + along * (y1 - y0), -np.pi / 2),
        ]
        x, y, yaw = spots[side]
        # The back of the chair is away from the table.
        piece += placed(one, (x, y, 0.0), yaw + rng.normal(0, 0.25))
    return piece


def office_place(rng: Generator) -> Piece:
    """A desk with a chair before it."""
    piece = desk(rng)
    reach = -float(extent(piece)[0, 1])
    at = (rng.normal(0, 0.2), -reach - rng.uniform(0.0, 0.5), 0.0)
    return piece + placed(chair(rng), at, np.pi + rng.normal(0, 0.6))


def lounge(rng: Generator) -> Piece:
    """A sofa with a low table before it, and often a lamp or an armchair."""
    piece = sofa(rng)
    reach = -float(extent(piece)[0, 1])
    low = table(rng, low=True)
    if chance(rng, 0.9):
        piece += placed(low, (rng.normal(0, 0.3), -reach - rng.uniform(0.1, 0.5), 0.0))
    right = float(extent(piece)[1, 0])
    if chance(rng, 0.3):
        piece += placed(floor_lamp(rng), (right + 0.2, 0.0, 0.0))
    elif chance(rng, 0.4):
        other = armchair(rng) if chance(rng, 0.6) else sofa(rng)
        piece += placed(other, (right + 0.6, -reach - 0.3, 0.0), -np.pi / 2)
    for _ in range(rng.poisson(0.6)):
        # Armchairs across the table, with their backs to the camera that looks at the sofa.
        at = (rng.uniform(-0.9, 0.9), -reach - rng.uniform(1.6, 2.4), 0.0)
        piece += placed(armchair(rng), at, np.pi + rng.normal(0, 0.4))
    return piece
