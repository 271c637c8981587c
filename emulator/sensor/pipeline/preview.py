"""Previews: frames compressed for display, with an overlay of stars, bodies and covered areas.

The overlay is JSON; places in the image are pairs x, y, pixels:

- ``width``, ``height`` of the image;
- ``detections``: place, magnitude and signal-to-noise ratio of each, brightest first, and ``hips``: the Hipparcos number
  of each, 0 if the solution does not have it;
- ``unused``: Hipparcos number of the catalogue star at the place of each detection without one in ``hips``; 0 if there is
  none. With a slightly wrong calibration, the solution leaves out bright stars, which deviate by more than their small
  noise;
- ``catalogue``: Hipparcos number, place and V of the catalogue stars in the field, brightest first;
- ``false_stars``: their places;
- ``bodies``: ``name`` (`sun`, `moon`, `earth`, or that of a planet), ``ra_deg`` and ``dec_deg`` of the centre, ICRS, angular
  ``radius_deg`` (0 for a point), and ``outline_px`` of the disc, null where the lens maps no direction;
- ``features``: how an algorithm of the thesis worked, null for `geometric`: the fields of
  `starid.identification.solution.FeatureReport` that the page shows;
- ``covered``: polygons of the areas that are covered by something near the lens.
"""

from __future__ import annotations

import json
import math
from typing import Any, Final

import numpy as np

from starhil.emulator.errors import EmulatorError
from starhil.emulator.sensor.model import SensorModel
from starhil.emulator.sensor.pipeline.bodies import SEEN_PX
from starhil.emulator.sensor.pipeline.messages import Preview
from starhil.emulator.sensor.renderer import Frame
from starhil.emulator.sensor.sky.objects import CelestialBody, Obstruction, SkyObjects
from starid.arithmetic.arrays import Array, GreyImage, Indices32
from starid.attitude import Attitude
from starid.camera import Camera
from starid.identification.solution import FeatureReport, Solution
from starid.imaging.detection import Detections

JPEG_QUALITY: Final = 72
FAINTEST_V: Final = 6.5
"""Magnitude of the faintest catalogue star that is named in a preview."""
BLACK_SIGMA: Final = 1.5
"""Black level above the background, in sigma of its noise: noise takes bytes without showing anything."""
KNEE_SIGMA: Final = 4.0
"""Level above black up to which brightness is nearly linear, in sigma of the noise."""
OUTLINE_POINTS: Final = 96


def make_preview(
    frame: Frame,
    camera: Camera,
    sensor: SensorModel,
    sky: SkyObjects,
    detected: Detections | None = None,
    solution: Solution | None = None,
) -> Preview:
    """Make the preview of a frame, without detections if it was not solved."""
    background = float(np.median(frame.image[::16, ::16])) if detected is None else detected.background
    noise = max(1.0, 0.0 if detected is None else detected.noise)
    height, width = frame.image.shape
    stars, objects = frame.stars, frame.objects
    bright = stars.magnitude <= FAINTEST_V
    bright &= np.all((stars.xy_px > -0.5) & (stars.xy_px < (width - 0.5, height - 0.5)), axis=1)
    hip, xy_px = stars.hip[bright], stars.xy_px[bright]
    catalogue = zip(
        hip.tolist(), *xy_px.round(1).T.tolist(), stars.magnitude[bright].round(2).tolist(), strict=True
    )
    detections, hips = ([], []) if detected is None else _detections(detected, solution, sensor)
    overlay = {
        "width": width,
        "height": height,
        "detections": detections,
        "hips": hips,
        "unused": [] if detected is None else unused_stars(detected.xy_px, hips, hip, xy_px),
        "catalogue": list(catalogue),
        "false_stars": [] if objects is None else objects.false_xy_px.round(1).tolist(),
        "bodies": _bodies(sky, camera, frame.attitude),
        "features": None if solution is None else _features(solution.features),
        "covered": [_covered(obstruction, width, height) for obstruction in sky.obstructions],
    }
    content = json.dumps(overlay, separators=(",", ":")).encode()
    return Preview(compress(frame.image, background, noise, sensor.bits), content)


def compress(image: GreyImage, background: float, noise: float, bits: int) -> bytes:
    """Compress an image (h, w) as JPEG, on a scale linear for faint and logarithmic for bright pixels."""
    import cv2

    levels = np.arange(1 << bits, dtype=np.float64)
    above = np.clip(levels - background - BLACK_SIGMA * noise, 0.0, None) / (KNEE_SIGMA * noise)
    scale = 255.0 / max(math.asinh(float(above[-1])), 1e-9)
    table = np.rint(np.arcsinh(above) * scale).astype(np.uint8)
    done, data = cv2.imencode(".jpg", table[image], [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    if not done:
        raise EmulatorError("preview: the image cannot be compressed")
    return data.tobytes()


def _detections(
    detected: Detections, solution: Solution | None, sensor: SensorModel
) -> tuple[list[tuple[float, float, float, float]], list[int]]:
    """Return the detections with their Hipparcos numbers."""
    zero = sensor.zero_magnitude_e_s * sensor.exposure_s
    magnitude = -2.5 * np.log10(np.maximum(detected.flux, 1.0) / zero)
    snr = detected.flux / detected.flux_sigma
    hips = np.zeros(len(detected.flux), dtype=np.int64)
    if solution is not None and solution.valid:
        hips[solution.detection_index] = solution.hip
    rows = zip(
        *detected.xy_px.round(2).T.tolist(), magnitude.round(2).tolist(), snr.round(1).tolist(), strict=True
    )
    return list(rows), hips.tolist()


def unused_stars(detections_xy: Array, hips: list[int], hip: Indices32, xy_px: Array) -> list[int]:
    """Return for each detection (n, 2) without a Hipparcos number that of the star (m, 2), brightest first, at its place."""
    unused = [0] * len(hips)
    left = ~np.isin(hip, hips)
    for number, place in zip(hip[left].tolist(), xy_px[left], strict=True):
        distances = np.hypot(*(detections_xy - place).T)
        row = int(distances.argmin()) if len(distances) else -1
        if row >= 0 and distances[row] <= SEEN_PX and hips[row] == unused[row] == 0:
            unused[row] = number
    return unused


def _features(report: FeatureReport | None) -> dict[str, Any] | None:
    """Return the part of a report that a page shows."""
    if report is None:
        return None
    return {
        "search": report.search,
        "triggered": report.triggered,
        "refined": report.refined,
        "error_psi": None if math.isnan(report.error_psi) else round(report.error_psi, 3),
        "cell": report.cell,
        "weights": report.weights,
        "observed": [round(value, 2) for value in report.observed],
        "of_cell": [round(value, 2) for value in report.of_cell],
        "region_deg": round(report.region_deg, 2),
        "region_at_deg": [round(value, 3) for value in report.region_at_deg],
        "removed": list(report.removed_index),
        "rotation_deg": round(report.rotation_deg, 3),
        "translation_deg": round(report.translation_deg, 3),
    }


def _bodies(sky: SkyObjects, camera: Camera, attitude: Attitude) -> list[dict[str, Any]]:
    """Return the bodies in a sky, inside or outside the image."""
    planets = ((planet.name or f"planet {number}", planet) for number, planet in enumerate(sky.planets, 1))
    bodies = (("sun", sky.sun), ("moon", sky.moon), ("earth", sky.earth), *planets)
    return [_body(name, body, camera, attitude) for name, body in bodies if body is not None]


def _body(name: str, body: CelestialBody, camera: Camera, attitude: Attitude) -> dict[str, Any]:
    """Return a body with the outline of its disc in the image."""
    centre, radius = body.direction, body.radius_rad
    across = np.cross(centre, (0.0, 0.0, 1.0) if abs(centre[2]) < 0.9 else (1.0, 0.0, 0.0))
    across /= np.linalg.norm(across)
    angle = np.linspace(0.0, 2.0 * math.pi, OUTLINE_POINTS + 1 if radius > 0.0 else 1)[:, None]
    ring = np.cos(angle) * across + np.sin(angle) * np.cross(centre, across)
    seen = attitude.to_sensor(math.cos(radius) * centre + math.sin(radius) * ring)
    xy, _ = camera.project(seen)
    limit = 20.0 * max(camera.width, camera.height)
    mapped = np.all(np.abs(np.nan_to_num(xy, nan=np.inf)) < limit, axis=1)
    outline = [
        (x, y) if there else None for (x, y), there in zip(xy.round(1).tolist(), mapped.tolist(), strict=True)
    ]
    place = {"ra_deg": body.ra_deg, "dec_deg": body.dec_deg, "radius_deg": math.degrees(radius)}
    return {"name": name, **place, "outline_px": outline}


def _covered(obstruction: Obstruction, width: int, height: int) -> list[tuple[float, float]]:
    """Return the polygon, pixels, covered by an obstruction."""
    if obstruction.polygon_px:
        return list(obstruction.polygon_px)
    if obstruction.share <= 0.0:
        return []
    right, down = width - 0.5, height - 0.5
    corners = ((-0.5, -0.5), (right, -0.5), (right, down), (-0.5, down))
    angle = math.radians(obstruction.angle_deg)
    x, y = np.arange(width) - 0.5 * (width - 1), np.arange(height) - 0.5 * (height - 1)
    along = (math.cos(angle) * x[::4])[None, :] + (math.sin(angle) * y[::4])[:, None]
    edge = float(np.quantile(along, 1.0 - obstruction.share))
    heights = [
        math.cos(angle) * (cx - 0.5 * (width - 1)) + math.sin(angle) * (cy - 0.5 * (height - 1)) - edge
        for cx, cy in corners
    ]
    polygon: list[tuple[float, float]] = []
    for number, ((ax, ay), above) in enumerate(zip(corners, heights, strict=True)):
        (bx, by), other = corners[(number + 1) % 4], heights[(number + 1) % 4]
        if above >= 0.0:
            polygon.append((ax, ay))
        if (above >= 0.0) != (other >= 0.0):
            share = above / (above - other)
            polygon.append((ax + share * (bx - ax), ay + share * (by - ay)))
    return [(round(px, 1), round(py, 1)) for px, py in polygon]
