"""Textures with content: paintings, screens, windows, books, dials, leaves."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from toolkit.datasets.synthetic_rooms.canvas import Canvas, Image, mix
from toolkit.datasets.synthetic_rooms.textures import Colour, Texture


def painting(palette: NDArray[np.float64]) -> Texture:
    """A framed abstract painting: layers of shapes with colours of a palette [K, 3]."""

    def paint(canvas: Canvas) -> Image:
        rng = canvas.rng
        image = canvas.flat(palette[0])
        corner = np.array(canvas.size, dtype=float)
        for _ in range(26):
            centre = rng.random(2) * corner
            angles = np.sort(rng.random(5)) * 2 * np.pi
            reach = rng.uniform(0.06, 0.3) * corner.min()
            outline = centre + reach * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
            colour = palette[rng.integers(len(palette))] * rng.uniform(0.7, 1.2)
            _fill(image, outline, colour)
        image *= (1.0 + 0.07 * canvas.noise(0.04, 2))[..., None]
        return _framed(canvas, image, (0.16, 0.12, 0.1))

    return paint


def _random_colour(rng: np.random.Generator, low: float, high: float) -> Colour:
    red, green, blue = rng.uniform(low, high, 3)
    return float(red), float(green), float(blue)


def _fill(image: Image, outline: NDArray[np.float64], colour: NDArray[np.float64]) -> None:
    """Fill an antialiased polygon [K, 2] (texels) in place."""
    fixed = np.round(outline * 16).astype(np.int32)
    mask = np.zeros(image.shape[:2], dtype=np.uint8)
    cv2.fillPoly(mask, [fixed], 255, cv2.LINE_AA, shift=4)
    weight = (mask / np.float32(255))[..., None]
    image += (np.clip(colour, 0, 1).astype(np.float32) - image) * weight


def _framed(canvas: Canvas, image: Image, colour: Colour, width_m: float = 0.025) -> Image:
    u, v = canvas.coordinates()
    width, height = canvas.size_m
    border = np.minimum(np.minimum(u, width - u), np.minimum(v, height - v))
    return mix(image, colour, canvas.inside(width_m - border))


def screen() -> Texture:
    """A switched-on display: windows with lines of text on a dark desktop."""

    def paint(canvas: Canvas) -> Image:
        rng = canvas.rng
        u, v = canvas.coordinates()
        image = canvas.flat((0.1, 0.16, 0.3)) * (1.0 + 0.25 * canvas.noise(0.2, 2))[..., None]
        width, height = canvas.size_m
        for _ in range(3):
            x, y = rng.uniform(0.04, 0.5) * width, rng.uniform(0.06, 0.4) * height
            w, h = rng.uniform(0.3, 0.45) * width, rng.uniform(0.35, 0.5) * height
            window = np.minimum(np.minimum(u - x, x + w - u), np.minimum(v - y, y + h - v))
            image = mix(image, (0.86, 0.87, 0.88), canvas.inside(window))
            ink = canvas.pulse(v - y, 0.026, 0.011) * (canvas.noise((0.05, 0.026)) > -0.2)
            text = ink * canvas.inside(window - 0.015)
            image = mix(image, _random_colour(rng, 0.1, 0.6), text)
        return _framed(canvas, image, (0.07, 0.07, 0.08), 0.015)

    return paint


def leaf(colour: Colour = (0.2, 0.45, 0.16)) -> Texture:
    """A leaf with a midrib along v and veins."""

    def paint(canvas: Canvas) -> Image:
        u, v = canvas.coordinates()
        side = np.abs(u - canvas.size_m[0] / 2)
        veins = 0.5 * canvas.pulse(v + side, 0.04, 0.008)
        image = mix(canvas.flat(colour), (0.5, 0.68, 0.32), np.maximum(veins, side < 0.005))
        return image * (1.0 + 0.1 * canvas.noise(0.05, 2))[..., None]

    return paint


def landscape(bar_m: float = 0.05) -> Texture:
    """Sky with clouds and hills behind window bars of the given width."""

    def paint(canvas: Canvas) -> Image:
        u, v = canvas.coordinates()
        width, height = canvas.size_m
        sky = mix(canvas.flat((0.5, 0.68, 0.9)), (0.92, 0.94, 0.97), v / height)
        sky = mix(sky, (0.97, 0.97, 0.97), np.clip(canvas.noise((0.7, 0.25), 3) * 0.5, 0, 0.9))
        hills = v - height * (0.6 + 0.06 * np.sin(u * 5.0) + 0.03 * np.sin(u * 13.0 + 1.0))
        image = mix(sky, (0.36, 0.5, 0.28), canvas.inside(hills))
        image *= (1.0 + 0.12 * canvas.inside(hills) * canvas.noise(0.08, 3))[..., None]
        if bar_m == 0.0:
            return image
        bars = np.maximum(
            canvas.inside(bar_m / 2 - np.abs(u - width / 2)),
            canvas.inside(bar_m / 2 - np.abs(v - height * 0.4)),
        )
        return _framed(canvas, mix(image, (0.9, 0.9, 0.88), bars), (0.9, 0.9, 0.88), bar_m)

    return paint


def keys() -> Texture:
    """A keyboard seen from above."""

    def paint(canvas: Canvas) -> Image:
        u, v = canvas.coordinates()
        gaps = np.maximum(canvas.pulse(u, 0.022, 0.006), canvas.pulse(v, 0.022, 0.006))
        caps = canvas.flat((0.75, 0.75, 0.73)) * (1.0 + 0.1 * canvas.noise(0.03))[..., None]
        return mix(caps, (0.2, 0.2, 0.22), gaps)

    return paint


def spine() -> Texture:
    """The back of a book: two bands and a title."""

    def paint(canvas: Canvas) -> Image:
        rng = canvas.rng
        _, v = canvas.coordinates()
        height = canvas.size_m[1]
        image = canvas.flat(_random_colour(rng, 0.15, 0.75))
        accent = _random_colour(rng, 0.3, 0.9)
        for place in rng.uniform(0.08, 0.92, 3) * height:
            image = mix(image, accent, canvas.inside(0.008 - np.abs(v - place)))
        return image * (1.0 + 0.07 * canvas.noise(0.04, 2))[..., None]

    return paint


def dial() -> Texture:
    """A clock's face, centred on the chart."""

    def paint(canvas: Canvas) -> Image:
        u, v = canvas.coordinates()
        x, y = u - canvas.size_m[0] / 2, v - canvas.size_m[1] / 2
        radius, reach = np.hypot(x, y), min(canvas.size_m) / 2
        image = canvas.flat((0.93, 0.91, 0.86)) * (1 + 0.03 * canvas.noise(0.05, 2))[..., None]
        around_m = np.arctan2(y, x) * 0.8 * reach
        tick = canvas.pulse(around_m, np.pi / 6 * 0.8 * reach, 0.02)
        band = canvas.inside(0.02 - np.abs(radius - 0.8 * reach))
        hands = np.maximum(
            canvas.inside(0.008 - np.abs(x)) * (y < 0) * (y > -0.6 * reach),
            canvas.inside(0.01 - np.abs(y)) * (x > 0) * (x < 0.45 * reach),
        )
        image = mix(image, (0.1, 0.1, 0.12), np.maximum(tick * band, hands))
        return mix(image, (0.25, 0.16, 0.1), canvas.inside(radius - 0.92 * reach))

    return paint
