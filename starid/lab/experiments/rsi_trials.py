"""Trials of the recursive algorithm: what is measured in each frame, its statistics, and the names of the methods."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, Final

import numpy as np

from starid.arithmetic.arrays import Array
from starid.identification.thesis.metrics import boresight_error, rotation_error
from starid.identification.thesis.rsi import RsiStep
from starid.lab.simulation import SimulatedFrame

START: Final = (108.41, 12.14)
"""Boresight of the first frame: corner (87.41°, −8.86°), 42° wide."""

FIELDS: Final = (
    "error",
    "roll_error",
    "psi",
    "side",
    "cells",
    "search_ms",
    "lasso_ms",
    "triggered",
    "exceeded",
    "valid",
    "mean_distance",
    "sigma_distance",
)
"""Fields of a frame: ε_f, ε_θ (°), ε_ψ, Γ (°), cells of the region, times, flags, μ_d, σ_d (°)."""

LSI_ONLY: Final = 0.0
"""Threshold τ for which every frame searches the whole database."""

PRINTED_SCALE: Final = 1.0
"""Scale of the noise as printed; another scale stands for scale·√μ (`author_noise`)."""

BY_EQUATION, BY_TABLE = "equation", "table"
"""Side of the search region, by eq. 6.5 as interpreted here, or from table 6.8."""


def measured_step(step: RsiStep, frame: SimulatedFrame) -> tuple[float, ...]:
    """Measurements of one frame, in the order of `FIELDS`."""
    motion, estimate = step.motion, step.estimate
    distances = (
        (math.nan, math.nan) if motion is None else (motion.mean_distance_deg, motion.sigma_distance_deg)
    )
    if estimate is None:
        return (*[math.nan] * 7, 0.0, 0.0, 0.0, *distances)
    found = estimate.right_ascension_deg, estimate.declination_deg
    return (
        float(boresight_error(*found, frame.right_ascension_deg, frame.declination_deg)),
        float(rotation_error(step.roll_deg, frame.roll_deg)),
        estimate.error_psi,
        step.region_deg,
        float(step.region_cells),
        1e3 * step.search_s,
        1e3 * step.lasso_s,
        float(step.triggered),
        float(step.exceeded),
        float(step.valid),
        *distances,
    )


def method_of(tau: float, memory: int = 0, side: str = BY_EQUATION) -> str:
    if tau == LSI_ONLY:
        return "FSF-aided LSI"
    name = f"RSI, τ = {tau:g}"
    if memory:
        return f"{name}, with memory (ours)"
    return name if side == BY_EQUATION else f"{name}, Γ of table 6.8"


def noise_label(scale: float) -> str:
    return "noise as printed" if scale == PRINTED_SCALE else f"noise {scale:g}·√μ"


def set_label(values: Mapping[str, Any]) -> str:
    """Describe the overlap, noise and false stars of a part."""
    words = f"p = {100 * values['overlap']:g} %, μ = {values['factor']}, f = {values['false_stars']}"
    return words + (f", {noise_label(values['scale'])}" if values["factor"] else "")


def statistics(numbers: Array, settling: int) -> dict[str, float]:
    """Means, standard deviations and shares over the frames (fields, n) of a sequence, without the first ones."""
    settled = dict(zip(FIELDS, numbers[:, settling:], strict=True))
    side = settled["side"][np.isfinite(settled["side"])]
    error = settled["error"]

    def average(name: str, field: str, *measures: str) -> dict[str, float]:
        functions: dict[str, Any] = {
            "mean": np.nanmean,
            "": np.nanmean,
            "sigma": np.nanstd,
            "median": np.nanmedian,
        }
        return {f"{name}_{what}".strip("_"): float(functions[what](settled[field])) for what in measures}

    return {
        **average("error", "error", "mean", "sigma", "median"),
        "gross_percent": 100.0 * float(np.nanmean(error > 1.0)),
        **average("roll", "roll_error", "mean", "sigma", "median"),
        **average("psi", "psi", "mean", "sigma"),
        "trigger_percent": 100.0 * float(np.mean(settled["triggered"])),
        "exceeded_percent": 100.0 * float(np.mean(settled["exceeded"])),
        "invalid_percent": 100.0 * float(np.mean(settled["valid"] == 0.0)),
        "region_percent": 100.0 * float(side.size / error.size),
        "side_mean": float(side.mean()) if side.size else math.nan,
        "side_sigma": float(side.std()) if side.size else math.nan,
        **average("search_ms", "search_ms", "", "sigma", "median"),
        "lasso_ms_median": float(np.nanmedian(settled["lasso_ms"])),
        **average("lasso_ms", "lasso_ms", "", "sigma"),
        "mean_distance_deg": float(np.nanmean(settled["mean_distance"])),
        "sigma_distance_deg": float(np.nanmean(settled["sigma_distance"])),
    }


def side_as_printed(mean_distance_deg: float, sigma_distance_deg: float, gamma_min_deg: float) -> float:
    """Side of the search region by eq. 6.5 with the printed 110, degrees; it falls as the distances grow."""
    power: float = 110.0 ** (-0.5 * math.log10(mean_distance_deg)) * 110.0 ** (
        -0.5 * math.log10(sigma_distance_deg)
    )
    return gamma_min_deg + power * sigma_distance_deg * mean_distance_deg
