"""Recursive identification: figures 6.33–6.43, E, F and G, tables 6.7–6.9 and H."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, Final

import numpy as np

from starid.lab.experiments.author_noise import IDENTIFICATION_ROOT, identification_noise
from starid.lab.experiments.experiment import Context, Experiment, Outcome, Part, Results
from starid.lab.experiments.published import printed_of
from starid.lab.experiments.rsi_figures import rsi_figures
from starid.lab.experiments.rsi_parts import BY_EQUATION, BY_TABLE, FIELDS, LSI_ONLY, PRINTED, rsi_parts
from starid.lab.experiments.rsi_tables import rsi_notes, rsi_rows, rsi_tables
from starid.lab.simulation import PIXEL_DEG, NoiseModel, SimulatedFrame, sky_sequence
from starid.thesis.metrics import boresight_error, rotation_error
from starid.thesis.rsi import RecursiveIdentification, RsiSettings, RsiStep
from starid.thesis.scalable_filter import TrackFilter, TrackFilterSettings

START: Final = (108.41, 12.14)
"""Boresight of the first frame: corner (87.41°, −8.86°), 42° wide."""


def _settings(values: Mapping[str, Any]) -> RsiSettings:
    if values["tau"] == LSI_ONLY:
        return RsiSettings(tau=1.0, gamma_lsi_deg=1e-9)
    settings = RsiSettings(tau=values["tau"], memory=values["memory"])
    if values["side"] == BY_TABLE:
        side = printed_of(values)["side_mean"]
        return RsiSettings(tau=values["tau"], gamma_min_deg=side, gamma_scale=0.0)
    return settings


def _compute(context: Context, part: Part) -> Results:
    v = part.values
    lsi = context.lost_in_space(v["overlap"])
    noise = identification_noise(v["factor"], false_stars=v["false_stars"])
    if v["scale"] == PRINTED:
        noise = NoiseModel.factor(v["factor"], v["false_stars"])
    track = TrackFilter(
        TrackFilterSettings(
            position_sigma_deg=max(noise.position_sigma_px * PIXEL_DEG, 0.002),
            brightness_sigma=max(noise.brightness_sigma * noise.magnitude_per_unit, 0.005),
            max_rotation_deg=4.0,
            max_shift_deg=4.0,
        )
    )
    count = int(context.parameters["frames"])
    recursion = RecursiveIdentification(lsi, track, _settings(v))
    numbers = np.full((len(FIELDS), count), math.nan)
    rng = context.rng("frames", v["false_stars"], v["factor"], int(100 * v["scale"]))
    for i, frame in enumerate(sky_sequence(rng, lsi.database.sky, *START, noise, count=count, wander=True)):
        numbers[:, i] = measured_step(recursion.step(frame.observed), frame)
    return {"numbers": numbers}


def measured_step(step: RsiStep, frame: SimulatedFrame) -> tuple[float, ...]:
    """Measurements of one frame, in the order of `FIELDS`."""
    motion = step.motion
    distances = (
        (math.nan, math.nan) if motion is None else (motion.mean_distance_deg, motion.sigma_distance_deg)
    )
    if step.estimate is None:
        return (*[math.nan] * 7, 0.0, 0.0, 0.0, *distances)
    error = boresight_error(
        step.estimate.right_ascension_deg,
        step.estimate.declination_deg,
        frame.right_ascension_deg,
        frame.declination_deg,
    )
    return (
        float(error),
        float(rotation_error(step.roll_deg, frame.roll_deg)),
        step.estimate.error_psi,
        step.region_deg,
        float(step.region_cells),
        1e3 * step.search_s,
        1e3 * step.lasso_s,
        float(step.triggered),
        float(step.exceeded),
        float(step.valid),
        *distances,
    )


def _evaluate(context: Context, results: Mapping[str, Results]) -> Outcome:
    files = rsi_tables(context, results)
    if not context.quick:
        files += rsi_figures(context, results)
    return Outcome(tuple(rsi_rows(context, results)), tuple(files), tuple(rsi_notes(context, results)))


_SETS: Final = [[f, m] for f in range(4) for m in range(4)]
_MEMORY: Final = 15

EXPERIMENTS: Final = (
    Experiment(
        "rsi",
        "Recursive identification with the scalable filter (ours): figures 6.33–6.43, E, F, G, tables 6.6–6.9",
        rsi_parts,
        _compute,
        _evaluate,
        full={
            "overlaps": [0.995, 0.9975],
            "sets": _SETS,
            "methods": [
                [LSI_ONLY, 0, BY_EQUATION],
                [0.5, 0, BY_EQUATION],
                [1.0, 0, BY_EQUATION],
                [0.5, 0, BY_TABLE],
                [0.5, _MEMORY, BY_EQUATION],
            ],
            "scales": [IDENTIFICATION_ROOT, PRINTED],
            "frames": 1001,
        },
        quick={
            "overlaps": [0.995],
            "sets": [[0, 0], [1, 1]],
            "methods": [[1.0, 0, BY_EQUATION], [0.5, _MEMORY, BY_EQUATION]],
            "scales": [IDENTIFICATION_ROOT],
            "frames": 400,
        },
        revision=4,
    ),
)
