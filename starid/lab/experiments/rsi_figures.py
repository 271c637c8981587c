"""Figures of the recursive algorithm: sequences, precision and run time (6.33–6.43, E, F, G)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Final

import numpy as np

from starid.lab.experiments.experiment import Evaluation, Part
from starid.lab.experiments.figures import Curve, Panel, precision, precision_axes
from starid.lab.experiments.rsi_trials import BY_TABLE, FIELDS, LSI_ONLY, method_of, noise_label
from starid.plots import colours

_SHOWN: Final = 40
_LEAST: Final = 1e-4
_MAX_MS: Final = 1.0


def draw_sequences(e: Evaluation, parts: Sequence[Part], settling: int) -> None:
    """Draw all figures from the runs with μ = f; precision without the first `settling` frames."""
    parts = [part for part in parts if part.values["side"] != BY_TABLE]
    overlaps = e.parameters["overlaps"]
    for scale in e.parameters["scales"]:
        # runs without noise belong to every scale
        chosen = [p for p in parts if p.values["scale"] == scale or p.values["factor"] == 0]

        def by_factor(part: Part) -> str:
            return f"μ = f = {part.values['factor']}"

        def by_overlap(part: Part) -> str:
            return f"{_method(part)}, p = {100 * part.values['overlap']:g} %"

        name = f"figures_6_37_6_38_f_1_f_2_x{scale:g}.png"
        title = f"Figures 6.37, 6.38, F.1, F.2; {noise_label(scale)}"
        _draw_precision(e, name, title, chosen, by_factor, by_overlap, settling)
        for overlap in overlaps:
            number, words = (
                ("6_39_to_6_41", "6.39 to 6.41") if overlap == overlaps[-1] else ("f_3_to_f_5", "F.3 to F.5")
            )
            members = [part for part in chosen if part.values["overlap"] == overlap]
            title = f"Figures {words}: p = {100 * overlap:g} %, {noise_label(scale)}"
            name = f"figures_{number}_x{scale:g}.png"
            _draw_precision(e, name, title, members, _method, by_factor, settling)
    sequences = {
        (part.values["factor"], part.values["tau"]): dict(
            zip(FIELDS, e.results[part.key]["numbers"][:, :_SHOWN], strict=True)
        )
        for part in parts
        if part.values["scale"] == e.parameters["scales"][0]
        and part.values["overlap"] == overlaps[-1]
        and part.values["tau"] != LSI_ONLY
        and not part.values["memory"]
    }
    _draw_sequences(e, sequences)


def _method(part: Part) -> str:
    return method_of(part.values["tau"], part.values["memory"])


def _draw_precision(
    e: Evaluation,
    name: str,
    title: str,
    parts: Sequence[Part],
    panel_of: Callable[[Part], str],
    label_of: Callable[[Part], str],
    settling: int,
) -> None:
    """Draw a panel for each value of one function of a part, a curve for each value of another."""
    methods = dict.fromkeys(map(_method, parts))
    shades = dict(zip(methods, colours(len(methods)), strict=True))
    panels: list[Panel] = []
    for words in dict.fromkeys(map(panel_of, parts)):
        curves = []
        for part in parts:
            if panel_of(part) == words:
                several = len(e.parameters["overlaps"]) > 1 and panel_of is not _method
                style = "--" if several and part.values["overlap"] == e.parameters["overlaps"][0] else "-"
                colour = {"color": shades[_method(part)]} if panel_of is not _method else {}
                errors = e.results[part.key]["numbers"][0, settling:]
                curves.append(precision(errors, 1.0, label_of(part), style, **colour))
        legend = "lower right" if panel_of is _method or not panels else ""
        panels.append(Panel(words, curves, precision_axes("ε_f", 1.0), legend))
    e.draw(name, panels, columns=2, width=9.0, height=7.0, title=title, sharey=True)


def _draw_by_frame(
    e: Evaluation, name: str, number: str, panels: Sequence[Panel], taus: int, **options: Any
) -> None:
    title = f"Figures {number}: p = {100 * e.parameters['overlaps'][-1]:g} %"
    size = {"columns": taus, "width": 10.0, "height": 2.2 * len(panels) / taus, "sharex": True}
    legend = {"legend": "outside lower center", "legend_columns": 4}
    e.draw(name, panels, title=title, **size, **legend, **options)


def _draw_sequences(e: Evaluation, sequences: dict[tuple[int, float], dict[str, Any]]) -> None:
    """Draw frame by frame ε_ψ and ε_f (figures 6.33 to 6.36, E), and run times (6.42, 6.43, G)."""
    frames = np.arange(1, _SHOWN + 1)
    errors, times = [], []
    for (factor, tau), numbers in sequences.items():
        error, psi = (1.0 + np.log10(np.maximum(numbers[name], _LEAST)) for name in ("error", "psi"))
        hit = numbers["triggered"] > 0.0
        threshold = np.full(2, 1.0 + np.log10(tau))
        curves = [
            Curve(frames, error, "-", "1 + log₁₀ ε_f", {"color": "red"}),
            Curve(frames, psi, "--", "1 + log₁₀ ε_ψ", {"color": "blue"}),
            Curve(frames[[0, -1]], threshold, "-", "τ", {"color": "0.5", "lw": 0.8}),
            Curve(frames[hit], psi[hit], "v", "update triggered", {"color": "black", "markersize": 5}),
        ]
        words = f"μ = f = {factor}, τ = {tau:g}"
        errors.append(Panel(words, curves, {"xlabel": "frame"}))
        left = [
            Curve(frames, numbers["error"], "-", "ε_f / °", {"color": "red"}),
            Curve(frames, numbers["side"], "-.", "Γ / °", {"color": "green"}),
        ]
        right = [
            Curve(frames, numbers["search_ms"], "b--", "1NN / ms (right)"),
            Curve(frames, numbers["lasso_ms"], "k:", "LASSO / ms (right)"),
        ]
        times.append(
            Panel(words, left, {"xlabel": "frame", "ylim": (0.0, 4.0)}, right=right, right_limit=_MAX_MS)
        )
    taus = len({tau for _, tau in sequences})
    name, number = "figures_6_33_to_6_36_and_e.png", "6.33 to 6.36 and E"
    _draw_by_frame(e, name, number, errors, taus, sharey=True)
    _draw_by_frame(e, "figures_6_42_6_43_and_g.png", "6.42, 6.43 and G", times, taus)
