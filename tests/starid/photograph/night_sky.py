"""Simulated photographs: more stars than the catalogue has, and the defects of ordinary cameras."""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from starid.attitude import Attitude, random_attitude
from starid.camera import Camera
from starid.catalog import StarCatalog

WIDTH, HEIGHT, FOV_DEG = 800, 600, 11.0
LIMIT = 9.0
UNLISTED = 150
FULL = 255.0
SKY = 30.0


def photograph(
    catalog: StarCatalog,
    seed: int,
    *,
    distortion: float = 0.0,
    spot_px: float = 1.3,
    foreground: float = 0.0,
    trail_px: float = 0.0,
    hot: float = 0.0,
    hot_counts: float | None = None,
    glow: float = 0.0,
    quality: int = 0,
    fov_deg: float = FOV_DEG,
    limit: float = LIMIT,
    centre_deg: tuple[float, float] | None = None,
    clouds: float = 0.0,
    noise: float = 1.0,
    straight: float | None = None,
    vignette: float = 0.0,
    width: int = WIDTH,
    height: int = HEIGHT,
) -> tuple[NDArray[np.uint8], Attitude, Camera]:
    """Return an 8-bit grey image, the attitude, and the camera that took it.

    Parameters
    ----------
    catalog : StarCatalog
        The catalogue; the image has half as many faint stars again.
    seed : int
        Seed of attitude, unlisted stars, colours and noise.
    distortion : float
        Displacement at the corner of the image, as a share of its distance from the centre.
    spot_px : float
        Standard deviation of a star's spot.
    foreground : float
        Share of the height of the image covered by a hill, sharp and grainy.
    trail_px : float
        Length of the star trails, in one direction.
    hot : float
        Share of the pixels that are hot.
    hot_counts : float, optional
        Mean excess of a hot pixel, exponentially distributed; by default any excess is as frequent.
    glow : float
        Peak of the glow around a bright body in the field, counts; the body itself is saturated.
    quality : int
        JPEG quality, 0 for no compression.
    fov_deg : float
        Width of the field.
    limit : float
        Magnitude of the faintest stars.
    centre_deg : (float, float), optional
        Right ascension and declination of the boresight; by default random.
    clouds : float
        Share of the light that the thickest clouds take away; they are as bright as the sky is dark.
    noise : float
        Standard deviation of the noise, counts.
    straight : float, optional
        Resample the image, as a user who removes the distortion does: with this focal length, relative to that of
        the distorted image. What the distorted image does not show is black.
    vignette : float
        Share of the light that is lost in the corners.
    width, height : int
        Size of the image.
    """
    rng = np.random.default_rng(seed)
    attitude = random_attitude(rng)
    if centre_deg is not None:
        attitude = Attitude.from_radec_roll(*centre_deg, rng.uniform(0.0, 360.0))
    half = math.tan(math.radians(fov_deg) / 2.0)
    k1 = distortion / (half * math.hypot(1.0, height / width)) ** 2
    camera = Camera.from_fov(fov_deg, width, height, distortion=(k1,))
    near = catalog.in_cone(attitude.boresight, camera.field_radius_rad * 1.1)
    near = near[catalog.v[near] < limit]
    xy, inside = camera.project(attitude.to_sensor(catalog.vectors[near]))
    magnitude = catalog.v[near][inside] + rng.normal(0.0, 0.25, int(inside.sum()))
    unlisted = rng.uniform(-0.5, [width - 0.5, height - 0.5], (UNLISTED, 2))
    magnitude = np.concatenate([magnitude, limit - rng.exponential(0.7, UNLISTED)])
    light = 5.0 * math.sqrt(4.0 * math.pi) * spot_px * noise * 10.0 ** (0.4 * (limit - magnitude))
    image = np.zeros((height, width))
    rows, columns = np.arange(height), np.arange(width)
    for (x, y), flux in zip(np.concatenate([xy[inside], unlisted]), light, strict=True):
        bell_x = np.exp(-0.5 * ((columns - x) / spot_px) ** 2)
        bell_y = np.exp(-0.5 * ((rows - y) / spot_px) ** 2)
        reach = max(round(6.0 * spot_px), 8)
        window = np.s_[max(int(y) - reach, 0) : int(y) + reach, max(int(x) - reach, 0) : int(x) + reach]
        spot = np.outer(bell_y[window[0]], bell_x[window[1]])
        image[window] += flux / (2.0 * math.pi * spot_px**2) * spot
    if trail_px:
        steps = np.linspace(-0.5, 0.5, 8 * math.ceil(trail_px)) * trail_px
        middle = math.ceil(trail_px)
        along = np.zeros((2 * middle + 1, 2 * middle + 1))
        np.add.at(
            along, (np.rint(middle + 0.6 * steps).astype(int), np.rint(middle + 0.8 * steps).astype(int)), 1.0
        )
        image = cv2.filter2D(image, -1, along / along.sum(), borderType=cv2.BORDER_REPLICATE)
    sky = np.full((height, width), SKY)
    if clouds:
        cover = cv2.resize(rng.uniform(0.0, 1.0, (5, 7)), (width, height), interpolation=cv2.INTER_CUBIC)
        cover = clouds * np.clip(cover, 0.0, 1.0)
        image, sky = image * (1.0 - cover), sky + SKY * cover
    image += sky
    if vignette:
        image *= 1.0 - vignette * (((columns - width / 2) ** 2 + (rows[:, None] - height / 2) ** 2) * 4.0) / (
            width**2 + height**2
        )
    if glow:
        x, y = rng.uniform(0.0, [width, height])
        away = np.hypot(columns - x, rows[:, None] - y)
        image += glow * np.exp(-away / (0.15 * width)) + FULL * (away < 0.25 / fov_deg * width)
    image += rng.normal(0.0, noise, image.shape)
    if foreground:
        crest = height * (1.0 - foreground) + 20.0 * np.sin(columns / 60.0)
        grain = cv2.GaussianBlur(rng.normal(0.0, 20.0, image.shape), (0, 0), 1.0)
        image = np.where(rows[:, None] > crest, 14.0 + grain, image)
    if hot:
        count = int(hot * image.size)
        excess = rng.uniform(0.0, FULL, count) if hot_counts is None else rng.exponential(hot_counts, count)
        image[rng.integers(0, height, count), rng.integers(0, width, count)] += excess
    counts = np.clip(np.rint(image), 0.0, FULL).astype(np.uint8)
    if straight is not None:
        counts, camera = _straightened(counts, camera, straight)
    if quality:
        packed = cv2.imencode(".jpg", counts, [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
        counts = np.asarray(cv2.imdecode(packed, cv2.IMREAD_UNCHANGED), dtype=np.uint8)
    return counts, attitude, camera


def _straightened(
    counts: NDArray[np.uint8], camera: Camera, share: float
) -> tuple[NDArray[np.uint8], Camera]:
    """Resample an image to a camera without distortion, with linear interpolation; the border is black."""
    focal = share * camera.focal_px[0]
    plain = Camera(camera.width, camera.height, (focal, focal), camera.centre_px)
    columns, rows = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    source, inside = camera.project(plain.back_project(np.column_stack([columns.ravel(), rows.ravel()])))
    source[~inside] = -10.0
    maps = source.astype(np.float32).reshape(*counts.shape, 2)
    return np.asarray(cv2.remap(counts, maps, None, cv2.INTER_LINEAR), dtype=np.uint8), plain
