"""Sets and methods of the recursive experiments, and the quantities measured in each frame."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any, Final

import numpy as np

from starid.lab.experiments.experiment import Parameters, Part, Results

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

SETTLING: Final = 5
"""Number of first frames left out of the statistics, in which false stars cannot be recognised yet."""

LSI_ONLY: Final = 0.0
"""Threshold τ for which every frame searches the whole database."""

PRINTED: Final = 1.0
"""Scale of the noise as printed; another scale stands for scale·√μ (`author_noise`)."""

BY_EQUATION, BY_TABLE = "equation", "table"
"""Side of the search region, by eq. 6.5 as interpreted here, or from table 6.8."""


_MEASURES: Final[dict[str, Callable[..., Any]]] = {
    "": np.nanmean,
    "mean": np.nanmean,
    "sigma": np.nanstd,
    "median": np.nanmedian,
}


def rsi_parts(parameters: Parameters) -> list[Part]:
    """List all runs: sets with μ = f, as in the tables, and the other sets with memory only.

    The side of table 6.8 is tried only at the first scale of the noise.
    """
    return [
        Part(
            f"p{100 * p:g}-f{f}-m{m}-t{tau:g}-n{memory}-{side}-x{scale:g}",
            {
                "overlap": p,
                "false_stars": f,
                "factor": m,
                "tau": tau,
                "memory": memory,
                "side": side,
                "scale": scale,
            },
        )
        for p in parameters["overlaps"]
        for f, m in parameters["sets"]
        for tau, memory, side in parameters["methods"]
        for scale in parameters["scales"]
        if (m > 0 or scale == parameters["scales"][0])
        and (side == BY_EQUATION or scale == parameters["scales"][0])
        and (f == m or memory)
    ]


def method_of(values: Mapping[str, Any]) -> str:
    """Name of the method of a part."""
    if values["tau"] == LSI_ONLY:
        return "FSF-aided LSI"
    name = f"RSI, τ = {values['tau']:g}"
    if values["memory"]:
        return f"{name}, with memory (ours)"
    return name if values["side"] == BY_EQUATION else f"{name}, Γ of table 6.8"


def noise_label(scale: float) -> str:
    """Name of the noise of a scale."""
    return "noise as printed" if scale == PRINTED else f"noise {scale:g}·√μ"


def set_label(values: Mapping[str, Any]) -> str:
    """Describe the overlap, noise and false stars of a part."""
    words = f"p = {100 * values['overlap']:g} %, μ = {values['factor']}, f = {values['false_stars']}"
    return words + (f", {noise_label(values['scale'])}" if values["factor"] else "")


def statistics(result: Results) -> dict[str, float]:
    """Means, standard deviations and shares over the frames of a part, without the first `SETTLING`."""
    settled = dict(zip(FIELDS, result["numbers"][:, SETTLING:], strict=True))
    side = settled["side"][np.isfinite(settled["side"])]
    error = settled["error"]

    def average(name: str, field: str, *measures: str) -> dict[str, float]:
        return {f"{name}_{what}".strip("_"): float(_MEASURES[what](settled[field])) for what in measures}

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
