"""Figures of the recursive algorithm: sequences, precision and run time (6.33–6.43, E, F, G)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np

from starid.lab.experiments.experiment import Context, Part, Results
from starid.lab.experiments.rsi_parts import (
    BY_TABLE,
    FIELDS,
    LSI_ONLY,
    SETTLING,
    method_of,
    noise_label,
    rsi_parts,
)
from starid.plots import colours, figure, precision_curve, save

_SHOWN: Final = 40
_LEAST: Final = 1e-4
_MAX_MS: Final = 1.0


def rsi_figures(context: Context, results: Mapping[str, Results]) -> list[str]:
    """Draw all figures; return the names of the files."""
    files = []
    for scale in context.parameters["scales"]:
        files.append(_by_noise(context, results, scale))
        files += [_by_method(context, results, p, scale) for p in context.parameters["overlaps"]]
    files.append(_sequences(context, results))
    files.append(_run_times(context, results))
    return files


def _chosen(context: Context, scale: float) -> list[Part]:
    """Sets with μ = f at one scale of the noise; those without noise belong to every scale."""
    return [
        part
        for part in rsi_parts(context.parameters)
        if part.values["false_stars"] == part.values["factor"]
        and part.values["side"] != BY_TABLE
        and (part.values["scale"] == scale or part.values["factor"] == 0)
    ]


def _unique(values: Sequence[Any]) -> list[Any]:
    return list(dict.fromkeys(values))


def _by_noise(context: Context, results: Mapping[str, Results], scale: float) -> str:
    """Draw a panel for each noise, a curve for each method and overlap: figures 6.37, 6.38, F.1 and F.2."""
    parts = _chosen(context, scale)
    factors = _unique([part.values["factor"] for part in parts])
    fig, axes = figure(2, (len(factors) + 1) // 2, width=9.0, height=7.0, squeeze=False, sharey=True)
    overlaps = context.parameters["overlaps"]
    for factor, axis in zip(factors, axes.ravel(), strict=False):
        members = [part for part in parts if part.values["factor"] == factor]
        names = _unique([method_of(part.values) for part in members])
        palette = dict(zip(names, colours(len(names)), strict=True))
        for part in members:
            first = part.values["overlap"] == overlaps[0]
            precision_curve(
                axis,
                results[part.key]["numbers"][0, SETTLING:],
                1.0,
                color=palette[method_of(part.values)],
                ls="--" if first else "-",
                label=f"{method_of(part.values)}, p = {100 * part.values['overlap']:g} %",
            )
        axis.set(title=f"μ = f = {factor}", xlabel="threshold of ε_f / °")
    axes[0, 0].legend(loc="lower right")
    fig.suptitle(f"Figures 6.37, 6.38, F.1, F.2; {noise_label(scale)}")
    return save(fig, context.folder / f"figures_6_37_6_38_f_1_f_2_x{scale:g}.png")


def _by_method(context: Context, results: Mapping[str, Results], overlap: float, scale: float) -> str:
    """Draw a panel for each method, a curve for each noise: figures 6.39 to 6.41, or F.3 to F.5."""
    parts = [part for part in _chosen(context, scale) if part.values["overlap"] == overlap]
    names = _unique([method_of(part.values) for part in parts])
    fig, axes = figure(2, (len(names) + 1) // 2, width=9.0, height=7.0, squeeze=False, sharey=True)
    for name, axis in zip(names, axes.ravel(), strict=False):
        members = [part for part in parts if method_of(part.values) == name]
        for part, colour in zip(members, colours(len(members)), strict=True):
            precision_curve(
                axis,
                results[part.key]["numbers"][0, SETTLING:],
                1.0,
                color=colour,
                label=f"μ = f = {part.values['factor']}",
            )
        axis.set(title=name, xlabel="threshold of ε_f / °")
        axis.legend(loc="lower right")
    last = overlap == context.parameters["overlaps"][-1]
    number, words = ("6_39_to_6_41", "6.39 to 6.41") if last else ("f_3_to_f_5", "F.3 to F.5")
    fig.suptitle(f"Figures {words}: p = {100 * overlap:g} %, {noise_label(scale)}")
    return save(fig, context.folder / f"figures_{number}_x{scale:g}.png")


def _sequence_parts(context: Context) -> tuple[list[int], list[float], dict[tuple[int, float], Part]]:
    """Runs as printed, with the finest database and the lowest noise, by noise factor and τ."""
    found = {
        (part.values["factor"], part.values["tau"]): part
        for part in _chosen(context, context.parameters["scales"][0])
        if part.values["overlap"] == context.parameters["overlaps"][-1]
        and part.values["tau"] != LSI_ONLY
        and not part.values["memory"]
    }
    return _unique([m for m, _ in found]), _unique([t for _, t in found]), found


def _numbers(results: Mapping[str, Results], part: Part) -> dict[str, Any]:
    return dict(zip(FIELDS, results[part.key]["numbers"][:, :_SHOWN], strict=True))


def _sequences(context: Context, results: Mapping[str, Results]) -> str:
    """Draw ε_ψ and ε_f frame by frame: figures 6.33 to 6.36 and E."""
    factors, taus, parts = _sequence_parts(context)
    fig, axes = figure(
        len(factors),
        len(taus),
        width=10.0,
        height=2.2 * len(factors),
        squeeze=False,
        sharex=True,
        sharey=True,
    )
    frames = np.arange(1, _SHOWN + 1)
    for i, factor in enumerate(factors):
        for j, tau in enumerate(taus):
            axis, numbers = axes[i, j], _numbers(results, parts[factor, tau])
            error, psi = (1.0 + np.log10(np.maximum(numbers[name], _LEAST)) for name in ("error", "psi"))
            axis.plot(frames, error, "r-", label="1 + log₁₀ ε_f")
            axis.plot(frames, psi, "b--", label="1 + log₁₀ ε_ψ")
            axis.axhline(1.0 + np.log10(tau), color="0.5", lw=0.8, label="τ")
            hit = numbers["triggered"] > 0.0
            axis.plot(frames[hit], psi[hit], "kv", markersize=5, label="update triggered")
            axis.set(title=f"μ = f = {factor}, τ = {tau:g}")
    for axis in axes[-1]:
        axis.set_xlabel("frame")
    fig.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=4)
    fig.suptitle(f"Figures 6.33 to 6.36 and E: p = {100 * context.parameters['overlaps'][-1]:g} %")
    return save(fig, context.folder / "figures_6_33_to_6_36_and_e.png")


def _run_times(context: Context, results: Mapping[str, Results]) -> str:
    """Draw ε_f, side of the region and run times frame by frame: figures 6.42, 6.43 and G."""
    factors, taus, parts = _sequence_parts(context)
    fig, axes = figure(
        len(factors), len(taus), width=10.0, height=2.2 * len(factors), squeeze=False, sharex=True
    )
    frames = np.arange(1, _SHOWN + 1)
    for i, factor in enumerate(factors):
        for j, tau in enumerate(taus):
            axis, numbers = axes[i, j], _numbers(results, parts[factor, tau])
            right = axis.twinx()
            lines = axis.plot(frames, numbers["error"], "r-", label="ε_f / °")
            lines += axis.plot(frames, numbers["side"], "g-.", label="Γ / °")
            lines += right.plot(frames, numbers["search_ms"], "b--", label="1NN / ms (right)")
            lines += right.plot(frames, numbers["lasso_ms"], "k:", label="LASSO / ms (right)")
            axis.set(title=f"μ = f = {factor}, τ = {tau:g}", ylim=(0.0, 4.0))
            right.grid(visible=False)
            right.set_ylim(0.0, _MAX_MS)
            if (i, j) == (0, 0):
                fig.legend(handles=lines, loc="outside lower center", ncols=4)
    for axis in axes[-1]:
        axis.set_xlabel("frame")
    fig.suptitle(f"Figures 6.42, 6.43 and G: p = {100 * context.parameters['overlaps'][-1]:g} %")
    return save(fig, context.folder / "figures_6_42_6_43_and_g.png")
