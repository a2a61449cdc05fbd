"""Procedural textures; each function returns a callable that paints charts.

Colours are RGB in [0, 1] and lengths are in metres. Like real surfaces, every texture has detail at
several scales, down to about a centimetre.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from toolkit.datasets.synthetic_rooms.canvas import Canvas, Image, mix

Colour = tuple[float, float, float]
Texture = Callable[[Canvas], Image]


def weakened(texture: Texture, contrast: float) -> Texture:
    """The same texture with a fraction of its contrast; the mean colour of a chart is kept."""

    def paint(canvas: Canvas) -> Image:
        image = texture(canvas)
        mean = image.mean(axis=(0, 1))
        return mean + contrast * (image - mean)

    return paint


def darkened(texture: Texture, factor: float) -> Texture:
    """The same texture with all colours multiplied by a factor."""
    return lambda canvas: texture(canvas) * np.float32(factor)


def plaster(colour: Colour, contrast: float = 0.03) -> Texture:
    """Painted plaster: faint clouds and fine grain."""

    def paint(canvas: Canvas) -> Image:
        clouds = canvas.noise(0.6, 4) * contrast * 0.5
        grain = canvas.noise(0.035, 2) * contrast
        return canvas.flat(colour) * (1.0 + clouds + grain)[..., None]

    return paint


def wood(colour: Colour, contrast: float = 0.08) -> Texture:
    """Wood with its grain along the longer side."""

    def paint(canvas: Canvas) -> Image:
        along_u = canvas.size[0] >= canvas.size[1]
        long, short = 0.5, 0.03
        fibre = canvas.noise((long, short) if along_u else (short, long), 2)
        rings = canvas.noise((1.2, 0.15) if along_u else (0.15, 1.2), 1)
        value = 1.0 + contrast * (0.6 * fibre + 0.7 * np.sin(5.0 * rings))
        return canvas.flat(colour) * value[..., None]

    return paint


def planks(colour: Colour, board_m: float = 0.14, length_m: float = 1.1) -> Texture:
    """Floor boards in staggered rows."""

    def paint(canvas: Canvas) -> Image:
        u, v = canvas.coordinates()
        row = np.floor(v / board_m).astype(int)
        shift = canvas.rng.random(row.max() + 1).astype(np.float32)[row] * length_m
        board = np.floor((u + shift) / length_m).astype(int)
        tones = canvas.rng.normal(1.0, 0.08, (row.max() + 1, board.max() + 1))
        grain = canvas.noise((0.4, 0.035), 2) * 0.06
        value = tones.astype(np.float32)[row, board] * (1.0 + grain)
        joints = np.maximum(
            canvas.pulse(v, board_m, 0.006), canvas.pulse(u + shift, length_m, 0.006)
        )
        return canvas.flat(colour) * (value * (1.0 - 0.4 * joints))[..., None]

    return paint


def brick(colour: Colour, mortar: Colour = (0.66, 0.58, 0.52)) -> Texture:
    """Brickwork, 24 x 8 cm."""
    width_m, height_m = 0.24, 0.08

    def paint(canvas: Canvas) -> Image:
        u, v = canvas.coordinates()
        row = np.floor(v / height_m).astype(int)
        shifted = u + (row % 2) * width_m / 2
        column = np.floor(shifted / width_m).astype(int)
        tones = canvas.rng.normal(1.0, 0.08, (row.max() + 1, column.max() + 1))
        value = tones.astype(np.float32)[row, column] * (1.0 + 0.05 * canvas.noise(0.05, 2))
        joints = np.maximum(canvas.pulse(v, height_m, 0.014), canvas.pulse(shifted, width_m, 0.014))
        return mix(canvas.flat(colour) * value[..., None], mortar, joints)

    return paint


def tiles(light: Colour, dark: Colour, size_m: float = 0.3) -> Texture:
    """Checkered tiles with joints and marbling."""

    def paint(canvas: Canvas) -> Image:
        u, v = canvas.coordinates()
        # Soft checkerboard: the product of two soft square waves.
        wave_u = 2 * canvas.pulse(u - size_m / 2, 2 * size_m, size_m) - 1
        wave_v = 2 * canvas.pulse(v - size_m / 2, 2 * size_m, size_m) - 1
        image = mix(canvas.flat(light), dark, (1 + wave_u * wave_v) / 2)
        image *= (1.0 + 0.1 * np.sin(3 * canvas.noise(0.3, 3)))[..., None]
        joints = np.maximum(canvas.pulse(u, size_m, 0.008), canvas.pulse(v, size_m, 0.008))
        return mix(image, (0.55, 0.54, 0.52), joints)

    return paint


def weave(colour: Colour, thread_m: float = 0.014, contrast: float = 0.09) -> Texture:
    """Coarse cloth: crossing threads, uneven in tone."""

    def paint(canvas: Canvas) -> Image:
        u, v = canvas.coordinates()
        threads = np.sin(np.pi * u / thread_m) * np.sin(np.pi * v / thread_m)
        # With less than two texels per thread the pattern is averaged.
        visible = float(np.clip(thread_m / canvas.texel_m - 2.0, 0.0, 1.0))
        value = 1.0 + contrast * (0.6 * visible * threads + 0.5 * canvas.noise(0.08, 3))
        return canvas.flat(colour) * value[..., None]

    return paint


def plaid(ground: Colour, bands: tuple[Colour, ...], period_m: float = 0.2) -> Texture:
    """Woven checks of several band colours."""

    def paint(canvas: Canvas) -> Image:
        u, v = canvas.coordinates()
        image = canvas.flat(ground)
        for number, colour in enumerate(bands):
            offset = period_m * number / len(bands)
            width = period_m * (0.32 if number == 0 else 0.12)
            for axis in (u, v):
                image = mix(image, colour, 0.45 * canvas.pulse(axis - offset, period_m, width))
        return image * (1.0 + 0.06 * canvas.noise(0.03, 2))[..., None]

    return paint


def carpet(colour: Colour, second: Colour | None = None) -> Texture:
    """Long pile: strong grain; with a second colour, a bordered diamond pattern."""

    def paint(canvas: Canvas) -> Image:
        u, v = canvas.coordinates()
        image = canvas.flat(colour)
        if second is not None:
            diamond = 0.12 - np.abs((u + v) % 0.36 - 0.18) - np.abs((u - v) % 0.36 - 0.18)
            image = mix(image, second, canvas.inside(diamond))
            width, height = canvas.size_m
            border = np.minimum(np.minimum(u, width - u), np.minimum(v, height - v))
            image = mix(image, second, canvas.inside(0.03 - np.abs(border - 0.08)))
        return image * (1.0 + 0.08 * canvas.noise(0.05, 3))[..., None]

    return paint


def cladding(
    colour: Colour,
    joint: Colour,
    size_m: tuple[float, float],
    joint_m: float,
    blank_m: tuple[float, float] = (0.0, 0.0),
) -> Texture:
    """Uniform panels with thin joints, half a panel at each edge of the chart.

    Args:
        colour, joint: of the panels and of the joints between them.
        size_m: width and height of a panel.
        joint_m: width of a joint.
        blank_m: stretch of the chart from left to right, between two joints, that has none.
    """

    def paint(canvas: Canvas) -> Image:
        u, v = canvas.coordinates()
        left, right = blank_m
        joints = np.maximum(
            canvas.lines(u, size_m[0], joint_m), canvas.lines(v, size_m[1], joint_m)
        )
        blank = (u > left + joint_m) & (u < right - joint_m)
        return mix(canvas.flat(colour), joint, np.where(blank, 0.0, joints))

    return paint


def stripes(first: Colour, second: Colour, period_m: float = 0.12, grain: float = 0.03) -> Texture:
    """Vertical stripes, as on wallpaper and curtains; without grain, they repeat exactly."""

    def paint(canvas: Canvas) -> Image:
        u, _ = canvas.coordinates()
        image = mix(canvas.flat(first), second, canvas.pulse(u, period_m, period_m / 2))
        thin = canvas.pulse(u - period_m / 2, period_m, period_m / 10)
        image = mix(image, second, 0.7 * thin)
        return image * (1.0 + grain * canvas.noise(0.06, 3))[..., None]

    return paint


def speckled(colour: Colour, contrast: float = 0.05) -> Texture:
    """Plastic, painted metal and ceramics: fine specks and faint clouds."""

    def paint(canvas: Canvas) -> Image:
        value = 1.0 + contrast * (canvas.noise(0.03, 2) + 0.7 * canvas.noise(0.25, 2))
        return canvas.flat(colour) * value[..., None]

    return paint


def banded(colour: Colour, band: Colour, period_m: float = 0.06) -> Texture:
    """Horizontal bands, as on vases and baskets."""

    def paint(canvas: Canvas) -> Image:
        _, v = canvas.coordinates()
        wavy = v + 0.006 * canvas.noise(0.1, 1)
        image = mix(canvas.flat(colour), band, canvas.pulse(wavy, period_m, period_m / 3))
        return image * (1.0 + 0.06 * canvas.noise(0.04, 2))[..., None]

    return paint


def panels(colour: Colour, size_m: float = 0.6) -> Texture:
    """A ceiling of square acoustic panels with dark pits."""

    def paint(canvas: Canvas) -> Image:
        u, v = canvas.coordinates()
        pits = np.clip(canvas.noise(0.03, 2) - 0.9, 0.0, 0.8)
        image = canvas.flat(colour) * (1.0 + 0.03 * canvas.noise(0.5, 3) - 0.2 * pits)[..., None]
        joints = np.maximum(canvas.pulse(u, size_m, 0.025), canvas.pulse(v, size_m, 0.025))
        return mix(image, (0.5, 0.5, 0.5), 0.7 * joints)

    return paint


def damask(ground: Colour, figure: Colour, period_m: float = 0.24, grain: float = 0.03) -> Texture:
    """Wallpaper with a staggered ornament of rings and dots; without grain, it repeats exactly.

    Rows are `period_m` apart, so it repeats after two of them, and sideways after one.
    """
    scale = period_m / 0.24

    def paint(canvas: Canvas) -> Image:
        u, v = canvas.coordinates()
        row = np.floor(v / period_m)
        x = (u / period_m + 0.5 * (row % 2)) % 1.0 - 0.5
        y = (v / period_m) % 1.0 - 0.5
        radius, angle = np.hypot(x, y) * period_m, np.arctan2(y, x)
        petals = scale * (0.065 + 0.022 * np.cos(6 * angle))
        ornament = np.maximum(
            canvas.inside(scale * 0.009 - np.abs(radius - petals)),
            canvas.inside(scale * 0.022 - radius),
        )
        image = mix(canvas.flat(ground), figure, ornament)
        return image * (1.0 + grain * canvas.noise(0.05, 3))[..., None]

    return paint
