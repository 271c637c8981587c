"""Trials of the LSI algorithm on the 1 701 frames of the thesis: on and off the grid, rolled, with noise."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Any, Final

import numpy as np

from starid.arithmetic.arrays import Array
from starid.identification.thesis.features import extract_features
from starid.identification.thesis.frame_sky import FrameSky
from starid.identification.thesis.lsi import LsiEstimate
from starid.identification.thesis.metrics import boresight_error, rotation_error
from starid.identification.thesis.subcell import FineEstimate, SubcellSearch
from starid.lab.experiments.experiment import Context, Results
from starid.lab.simulation import NoiseModel, add_noise, turned

COLUMNS: Final = 63
"""Number of test frames in right ascension, with corners at α = 2° + 5°·k."""

ROWS: Final = 27
"""Number of test frames in declination, with corners at δ = −88° + 5°·m."""

FRAMES: Final = COLUMNS * ROWS
"""Number of test frames in the thesis, 1 701."""

HALF_FRAME_DEG: Final = 20.0
"""Half-width of a frame, degrees: the frames of the published figures are 40° wide."""

_COMPARED_NEIGHBOURS: Final = 256
"""Number of neighbours tried if the stars themselves decide."""

ON, OFF = "on", "off"
"""Test frames as they are, and moved off the grid."""

GRID_LABELS: Final = {ON: "on the grid", OFF: "off the grid"}


def count_label(count: int, kind: str) -> str:
    """Format a number of false or missing stars."""
    return f"{count} {kind} star{'s' if count > 1 else ''}"


def centres(every: int = 1) -> Array:
    """Centres of the test frames, (n, 2) degrees, row by row, or of every n-th frame only."""
    ra = 2.0 + 5.0 * np.arange(COLUMNS) + HALF_FRAME_DEG
    dec = -88.0 + 5.0 * np.arange(ROWS) + HALF_FRAME_DEG
    grid = np.stack(np.meshgrid(ra, dec), axis=-1).reshape(-1, 2)
    return np.asarray(grid[::every], dtype=np.float64)


def frames_under_test(rng: np.random.Generator, grid: str, step_deg: float, every: int) -> Array:
    """Centres of the test frames; with `grid` "off", each moved by a random fraction of the grid step."""
    positions = centres(every)
    if grid == OFF:
        positions = positions + step_deg * rng.uniform(0.0, 1.0, positions.shape)
    return positions


def stars_of(
    sky: FrameSky,
    frames: Array,
    rng: np.random.Generator | None = None,
    noise: Callable[[np.random.Generator], NoiseModel] | None = None,
) -> Iterator[tuple[Array, Array]]:
    """Yield magnitudes (m,) and offsets in degrees (m, 2) of the stars in each frame, with the noise drawn for it."""
    for ra, dec in frames:
        brightness, positions, _ = sky.stars_in_frame(ra % 360.0, dec)
        if rng is not None and noise is not None:
            brightness, positions, _ = add_noise(rng, brightness, positions, noise(rng), sky.half_width)
        yield brightness, positions


def error_of(estimate: LsiEstimate | FineEstimate, ra_deg: float, dec_deg: float) -> float:
    """ε_f of an estimate, degrees."""
    return float(boresight_error(estimate.right_ascension_deg, estimate.declination_deg, ra_deg, dec_deg))


def solve_frames(
    context: Context,
    overlap: float,
    grid: str,
    *,
    rng: np.random.Generator,
    noise: Callable[[np.random.Generator], NoiseModel] | None = None,
    roll_deg: float = 0.0,
    every: int = 1,
    compares: bool = False,
    with_angle: bool = False,
) -> Results:
    """Run LSI, with the exact LASSO and with MATLAB's, and then the sub-cell search, on the test frames.

    `noise` is called for each frame, so that it can draw a mean; `rng` serves it and the shift of the frames.

    Returns
    -------
    Results
        `frames` (n, 2) degrees; `f_…` (n,): ε_f in degrees of the estimates `mse` and `1se` with the exact
        LASSO, `author_mse` and `author_1se` with MATLAB's, `fine` of the sub-cell search, and, if requested,
        `stars` of the search that compares the stars (`compares`) and `six` of the nearest cell in six features,
        with the polar angle (`with_angle`); `theta_…`: ε_θ in degrees of the same; `psi_mse`, `psi_author`,
        `residual`: ε_ψ of both kinds of LSI and the sub-cell search.
    """
    lsi, author = context.lost_in_space(overlap), context.lost_in_space(overlap, "matlab")
    fine, compared = SubcellSearch(lsi), SubcellSearch(lsi, neighbours=_COMPARED_NEIGHBOURS)
    sky = context.sky()
    frames = frames_under_test(rng, grid, lsi.database.grid.step_deg, every)
    names = ["mse", "1se", "author_mse", "author_1se", "fine", *["stars"] * compares, *["six"] * with_angle]
    answers = np.empty((len(names), len(frames), 2))
    angles = np.empty((len(names), len(frames)))
    psi = np.empty((3, len(frames)))
    for i, (brightness, seen) in enumerate(stars_of(sky, frames, rng, noise)):
        positions = turned(seen, roll_deg) if roll_deg != 0.0 else seen
        features = extract_features(brightness, positions)
        solution = lsi.solve(features)
        other = author.estimate(solution.observation, solution.nearest, solution.distance)
        better = fine.solve(features)
        estimates: list[LsiEstimate | FineEstimate] = [
            *(solution.mse, solution.one_se, other.mse, other.one_se, better)
        ]
        if compares:
            estimates.append(compared.solve(features, positions))
        places = [(each.right_ascension_deg, each.declination_deg, each.theta_rad) for each in estimates]
        if with_angle:
            cell, _ = lsi.nearest(solution.observation, theta_rad=features.theta_rad)
            places.append((*lsi.database.grid.centre(cell), lsi.database.exact_features(cell).theta_rad))
        for j, (ra, dec, theta) in enumerate(places):
            answers[j, i] = ra, dec
            angles[j, i] = rotation_error(math.degrees(features.theta_rad - theta), roll_deg)
        psi[:, i] = solution.mse.error_psi, other.mse.error_psi, better.residual
    errors = boresight_error(answers[..., 0], answers[..., 1], frames[:, 0], frames[:, 1])
    return {
        "frames": frames,
        **{f"f_{name}": errors[j] for j, name in enumerate(names)},
        **{f"theta_{name}": angles[j] for j, name in enumerate(names)},
        **dict(zip(("psi_mse", "psi_author", "residual"), psi, strict=True)),
    }


def share(errors: Array, limit: float) -> float:
    """Share of errors within a limit, percent."""
    return float(100.0 * np.mean(errors <= limit))


def shares(
    result: Results, limit: float, quantity: str = "f", ours: str = "fine", *, beyond: bool = False
) -> dict[str, Any]:
    """Share of errors within or beyond a limit, %, for both variants of LSI (MSE) and a search of this project."""
    author, printed, best = (
        100.0 - within if beyond else within
        for within in (share(result[f"{quantity}_{kind}"], limit) for kind in ("author_mse", "mse", ours))
    )
    return {"author": author, "printed": printed, "ours": best}
