"""Annotated images: stretched, in colour, with circles and names of stars."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import cv2
import numpy as np
import numpy.typing as npt

from starid.catalog.star_names import STAR_NAMES
from starid.imaging.background import estimate_background

MARK_BGR: Final = (70, 190, 105)
MISS_BGR: Final = (70, 90, 240)
_TEXT_BGR: Final = (235, 215, 160)
_SHADOW_BGR: Final = (20, 16, 12)
_FRAME_BGR: Final = (110, 110, 110)
_FONT: Final = cv2.FONT_HERSHEY_SIMPLEX
_SUB_PIXEL_BITS: Final = 4
_DARK: Final = 0.06
RADIUS_PX: Final = 8.0
"""Radius of the circles, pixels."""
_LEGEND: Final = ((MARK_BGR, "identified"), (MISS_BGR, "detected, not identified"))


def stretch(image: npt.NDArray[np.uint8] | npt.NDArray[np.uint16]) -> npt.NDArray[np.uint8]:
    """Stretch an image (h, w) to 8 bits so that faint stars show: background subtracted, gamma 2.2.

    Areas that are brighter than the typical background (a limb, glare) stay visible as grey.
    """
    background = estimate_background(image)
    height, width = image.shape
    sky = cv2.resize(background.level, (width, height), interpolation=cv2.INTER_LINEAR)
    typical, noise = background.median_level, background.median_noise
    above = image.astype(np.float32) - sky
    high = max(float(np.percentile(above, 99.97)), 20.0 * noise)
    stars = np.clip((above - noise) / high, 0.0, 1.0) ** 0.45
    veil = np.clip((sky - typical) / max(float(image.max()) - typical, 1.0), 0.0, 1.0) ** 0.6
    return np.asarray(255.0 * np.clip(_DARK + stars + 0.7 * veil, 0.0, 1.0) + 0.5, dtype=np.uint8)


def star_label(hip: int, magnitude: float, numbers_to: float) -> str:
    """Return the name of a star, or its Hipparcos number if it is bright enough, or an empty text."""
    if hip in STAR_NAMES:
        return STAR_NAMES[hip]
    return f"HIP {hip}" if magnitude <= numbers_to else ""


def annotate(
    image: npt.NDArray[np.uint8] | npt.NDArray[np.uint16],
    xy_px: npt.NDArray[np.float64],
    labels: Sequence[str],
    *,
    missed_xy_px: npt.NDArray[np.float64] | None = None,
) -> npt.NDArray[np.uint8]:
    """Draw circles and names on an image.

    Parameters
    ----------
    image : ndarray (h, w)
        Counts; stretched for display.
    xy_px : ndarray (n, 2)
        Centres of the circles, pixels.
    labels : sequence of n str
        Labels of the circles; empty for none.
    missed_xy_px : ndarray (m, 2), optional
        Detections without a star, to mark in another colour, which a legend explains if there is room.

    Returns
    -------
    ndarray (h, w, 3), uint8
        Blue-green-red.
    """
    canvas: npt.NDArray[np.uint8] = np.repeat(stretch(image)[:, :, None], 3, axis=2)
    height, width = image.shape
    size = max(0.32, min(width, height) / 2600.0)
    taken: list[tuple[int, int, int, int]] = []
    missed = np.empty((0, 2)) if missed_xy_px is None else missed_xy_px
    for centres, colour in ((xy_px, MARK_BGR), (missed, MISS_BGR)):
        for x, y in centres:
            _circle(canvas, x, y, RADIUS_PX, colour)
            taken.append(
                (round(x - RADIUS_PX), round(y - RADIUS_PX), round(x + RADIUS_PX), round(y + RADIUS_PX))
            )
    if len(missed):
        _draw_legend(canvas, size, taken)
    for (x, y), label in zip(xy_px, labels, strict=True):
        if not label:
            continue
        (text_width, text_height), _ = cv2.getTextSize(label, _FONT, size, 1)
        positions = _label_positions(x, y, RADIUS_PX, text_width, text_height)
        for forced, (left, base) in [*((False, position) for position in positions), (True, positions[0])]:
            box = (left, base - text_height, left + text_width, base + 2)
            inside = box[0] >= 0 and box[1] >= 0 and box[2] < width and box[3] < height
            if inside and (forced or not any(_overlap(box, other) for other in taken)):
                taken.append(box)
                _write(canvas, label, (left, base), size)
                break
    return canvas


def _write(canvas: npt.NDArray[np.uint8], text: str, at: tuple[int, int], size: float) -> None:
    """Write a text with a dark edge; `at` is the left end of its baseline."""
    cv2.putText(canvas, text, at, _FONT, size, _SHADOW_BGR, 3, cv2.LINE_AA)
    cv2.putText(canvas, text, at, _FONT, size, _TEXT_BGR, 1, cv2.LINE_AA)


def _draw_legend(canvas: npt.NDArray[np.uint8], size: float, taken: list[tuple[int, int, int, int]]) -> None:
    """Explain the colours of the circles at the edge where that covers the fewest, as near to a corner as possible."""
    texts = [cv2.getTextSize(text, _FONT, size, 1)[0] for _, text in _LEGEND]
    line = round(max(2.0 * RADIUS_PX, *(height for _, height in texts)) + 6.0)
    indent = round(2.0 * RADIUS_PX) + 12
    width, height = indent + max(width for width, _ in texts) + 6, line * len(_LEGEND) + 4
    right, bottom = canvas.shape[1] - width - 1, canvas.shape[0] - height - 1
    if right < 0 or bottom < 0:
        return

    def badness(at: tuple[int, int]) -> tuple[int, int]:
        box = (at[0], at[1], at[0] + width, at[1] + height)
        covered = sum(_overlap(box, other) for other in taken)
        return covered, min(at[0], right - at[0]) + min(at[1], bottom - at[1])

    across, down = ([*range(0, end, 8), end] for end in (right, bottom))
    places = [*((x, y) for x in across for y in (bottom, 0)), *((x, y) for y in down for x in (0, right))]
    left, top = min(places, key=badness)
    taken.append((left, top, left + width, top + height))
    cv2.rectangle(canvas, (left, top), (left + width, top + height), _SHADOW_BGR, cv2.FILLED)
    cv2.rectangle(canvas, (left, top), (left + width, top + height), _FRAME_BGR, 1)
    for row, ((colour, text), (_, text_height)) in enumerate(zip(_LEGEND, texts, strict=True)):
        middle = top + 2 + line * row + line // 2
        _circle(canvas, left + 6 + RADIUS_PX, middle, RADIUS_PX, colour)
        _write(canvas, text, (left + indent, middle + text_height // 2), size)


def _circle(
    canvas: npt.NDArray[np.uint8], x: float, y: float, radius: float, colour: tuple[int, int, int]
) -> None:
    """Draw a smooth circle at a sub-pixel position."""
    scale = 1 << _SUB_PIXEL_BITS
    centre = (round(x * scale), round(y * scale))
    cv2.circle(canvas, centre, round(radius * scale), colour, 1, cv2.LINE_AA, _SUB_PIXEL_BITS)


def _label_positions(x: float, y: float, radius: float, width: int, height: int) -> list[tuple[int, int]]:
    """Return candidate positions (left end, baseline) of a label around a circle, best first."""
    gap = radius + 3.0
    middle = round(y + height / 2.0)
    return [
        (round(x + gap), middle),
        (round(x - gap - width), middle),
        (round(x + 0.7 * gap), round(y - 0.7 * gap)),
        (round(x + 0.7 * gap), round(y + 0.7 * gap + height)),
        (round(x - width / 2.0), round(y + gap + height)),
        (round(x - width / 2.0), round(y - gap)),
    ]


def _overlap(a: tuple[int, int, int, int], b: tuple[int, int, int, int]) -> bool:
    """Whether two boxes (left, top, right, bottom) share a pixel."""
    return a[0] <= b[2] and b[0] <= a[2] and a[1] <= b[3] and b[1] <= a[3]
