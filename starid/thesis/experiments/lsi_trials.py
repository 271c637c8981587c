"""Trials of the LSI algorithm on the thesis's 1 701 frames, on and off the grid, rolled, and with noise."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Final

import numpy as np

from starid.arrays import Array
from starid.thesis.experiments.comparison import Readings
from starid.thesis.experiments.experiment import Context, Results
from starid.thesis.features import extract_features
from starid.thesis.lsi import LsiEstimate
from starid.thesis.metrics import boresight_error, rotation_error
from starid.thesis.simulation import NoiseModel, add_noise, turned
from starid.thesis.subcell import FineEstimate, SubcellSearch

COLUMNS: Final = 63
"""Test frames along right ascension: α corner 2° + 5°·k."""

ROWS: Final = 27
"""Test frames along declination: δ corner −88° + 5°·m."""

FRAMES: Final = COLUMNS * ROWS
"""The thesis's number of test frames, 1 701."""

HALF_FRAME_DEG: Final = 20.0
"""From the corner of a frame to its centre, degrees: the frames behind the published numbers are 40° wide."""

_COMPARED_NEIGHBOURS: Final = 256
"""Neighbours tried where the stars themselves decide."""

ON, OFF = "on", "off"
"""The frames as they are, and moved off the grid."""

GRID_WORDS: Final = {ON: "on the grid", OFF: "off the grid"}


def count_words(count: int, kind: str) -> str:
    """How many false or missing stars, in words."""
    return f"{count} {kind} star{'s' if count > 1 else ''}"


def centres(every: int = 1) -> Array:
    """Centres of the test frames, (n, 2) degrees, row by row; only every so-many-th if asked for."""
    ra = 2.0 + 5.0 * np.arange(COLUMNS) + HALF_FRAME_DEG
    dec = -88.0 + 5.0 * np.arange(ROWS) + HALF_FRAME_DEG
    grid = np.stack(np.meshgrid(ra, dec), axis=-1).reshape(-1, 2)
    return np.asarray(grid[::every], dtype=np.float64)


def frames_under_test(rng: np.random.Generator, grid: str, step_deg: float, every: int) -> Array:
    """Centres of the test frames; `grid` "off" moves each by its own random fraction of the grid step, both ways."""
    places = centres(every)
    if grid == OFF:
        places = places + step_deg * rng.uniform(0.0, 1.0, places.shape)
    return places


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
    """Run LSI, with the exact LASSO and with MATLAB's, and the sub-cell search after it, on the test frames.

    Parameters
    ----------
    context
        Databases.
    overlap
        Overlap ratio p as a fraction.
    grid
        "on" or "off".
    rng
        Where frames are moved to, and their noise.
    noise
        Noise of a frame's stars; it is asked for each frame, so that it may draw a mean.
    roll_deg
        The camera's roll.
    every
        Use only every so-many-th frame.
    compares
        Run the sub-cell search that compares the stars, too.
    with_angle
        Look for the cell that is nearest with the polar angle as a sixth feature, too.

    Returns
    -------
    Results
        `frames` (n, 2) degrees; `f_…` (n,): ε_f in degrees of the estimates `mse` and `1se` with the exact LASSO, `author_mse`
        and `author_1se` with MATLAB's, `fine` of the sub-cell search, and, if asked for, `stars` of the one that compares the
        stars and `six` of the cell nearest in six features; `theta_…` likewise: ε_θ in degrees; `psi_mse`, `psi_author`,
        `residual`: ε_ψ of the two kinds of LSI and of the sub-cell search.
    """
    lsi = context.lost_in_space(overlap)
    author = context.lost_in_space(overlap, "matlab")
    fine = SubcellSearch(lsi)
    compared = SubcellSearch(lsi, neighbours=_COMPARED_NEIGHBOURS)
    sky = context.sky()
    frames = frames_under_test(rng, grid, lsi.database.grid.step_deg, every)
    names = ["mse", "1se", "author_mse", "author_1se", "fine"]
    names += ["stars"] * compares + ["six"] * with_angle
    answers = np.empty((len(names), len(frames), 2))
    angles = np.empty((len(names), len(frames)))
    psi = np.empty((3, len(frames)))
    for i, (ra, dec) in enumerate(frames):
        brightness, places, _ = sky.stars_in_frame(ra % 360.0, dec)
        if noise is not None:
            brightness, places, _ = add_noise(rng, brightness, places, noise(rng), sky.half_width)
        if roll_deg != 0.0:
            places = turned(places, roll_deg)
        features = extract_features(brightness, places)
        solution = lsi.solve(features)
        other = author.estimate(solution.observation, solution.nearest, solution.distance)
        better = fine.solve(features)
        estimates: list[LsiEstimate | FineEstimate] = [
            *(solution.mse, solution.one_se),
            *(other.mse, other.one_se),
            better,
        ]
        if compares:
            estimates.append(compared.solve(features, places))
        for j, estimate in enumerate(estimates):
            answers[j, i] = estimate.right_ascension_deg, estimate.declination_deg
            turn = features.theta_rad - estimate.theta_rad
            angles[j, i] = rotation_error(math.degrees(turn), roll_deg)
        psi[:, i] = solution.mse.error_psi, other.mse.error_psi, better.residual
        if with_angle:
            cell, _ = lsi.nearest(solution.observation, theta_rad=features.theta_rad)
            answers[-1, i] = lsi.database.grid.centre(cell)
            theta = lsi.database.exact_features(cell).theta_rad
            angles[-1, i] = rotation_error(math.degrees(features.theta_rad - theta), roll_deg)
    errors = boresight_error(answers[..., 0], answers[..., 1], frames[:, 0], frames[:, 1])
    return {
        "frames": frames,
        **{f"f_{name}": errors[j] for j, name in enumerate(names)},
        **{f"theta_{name}": angles[j] for j, name in enumerate(names)},
        "psi_mse": psi[0],
        "psi_author": psi[1],
        "residual": psi[2],
    }


def share(errors: Array, limit: float) -> float:
    """Share of errors within a limit, percent."""
    return float(100.0 * np.mean(errors <= limit))


def shares(
    result: Results, limit: float, quantity: str = "f", ours: str = "fine", *, beyond: bool = False
) -> Readings:
    """Share of errors within a limit, or beyond it, of LSI (MSE) in both readings and of a search of ours, percent."""
    author, printed, best = (
        100.0 - within if beyond else within
        for within in (share(result[f"{quantity}_{kind}"], limit) for kind in ("author_mse", "mse", ours))
    )
    return {"author": author, "printed": printed, "ours": best}
