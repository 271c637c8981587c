"""Figures of the recursive algorithm: sequences, precision and run time (6.33–6.43, E, F, G)."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Final

import numpy as np

from starid.lab.experiments.experiment import Evaluation, Part
from starid.lab.experiments.figures import Curve, Panel, precision, precision_axes
from starid.lab.experiments.rsi_trials import BY_TABLE, FIELDS, LSI_ONLY, method_of, noise_label

_SHOWN: Final = 40
_LEAST: Final = 1e-4
_MAX_MS: Final = 1.0


def draw_sequences(e: Evaluation, parts: Sequence[Part], settling: int) -> None:
    """Draw all figures from the runs with μ = f; precision without the first `settling` frames."""
    parts = [part for part in parts if part.values["side"] != BY_TABLE]
    for scale, overlap in itertools.product(e.parameters["scales"], e.parameters["overlaps"]):
        curves = (
            (_set(part), precision(e.results[part.key]["numbers"][0, settling:], 1.0, _method(part)))
            for part in parts
            # runs without noise belong to every scale
            if (part.values["scale"] == scale or part.values["factor"] == 0)
            and part.values["overlap"] == overlap
        )
        title = f"Figures 6.37 to 6.41 and F: p = {100 * overlap:g} %, {noise_label(scale)}"
        name = f"figures_6_37_to_6_41_and_f_p{100 * overlap:g}_x{scale:g}.png"
        look = {"columns": 2, "width": 9.0, "height": 7.0, "sharey": True, "legend": "lower right"}
        e.draw(name, curves, axes=precision_axes("ε_f"), title=title, **look)
    last = [part for part in parts if part.values["overlap"] == e.parameters["overlaps"][-1]]
    _draw_frames(
        e,
        [
            part
            for part in last
            if part.values["scale"] == e.parameters["scales"][0]
            and part.values["tau"] != LSI_ONLY
            and not part.values["memory"]
        ],
    )


def _method(part: Part) -> str:
    return method_of(part.values["tau"], part.values["memory"])


def _set(part: Part) -> str:
    return f"μ = f = {part.values['factor']}"


def _draw_frames(e: Evaluation, parts: Sequence[Part]) -> None:
    """Draw frame by frame ε_ψ and ε_f (figures 6.33 to 6.36, E), and run times (6.42, 6.43, G)."""
    frames = np.arange(1, _SHOWN + 1)
    errors, times = [], []
    for part in parts:
        numbers = dict(zip(FIELDS, e.results[part.key]["numbers"][:, :_SHOWN], strict=True))
        tau, words = part.values["tau"], f"{_set(part)}, τ = {part.values['tau']:g}"
        error, psi = (1.0 + np.log10(np.maximum(numbers[name], _LEAST)) for name in ("error", "psi"))
        hit = numbers["triggered"] > 0.0
        curves = [
            Curve(frames, error, "-", "1 + log₁₀ ε_f"),
            Curve(frames, psi, "--", "1 + log₁₀ ε_ψ"),
            Curve(frames, np.full(_SHOWN, 1.0 + np.log10(tau)), ":", "τ"),
            Curve(frames[hit], psi[hit], "v", "update triggered"),
        ]
        errors.append(Panel(words, curves, {"xlabel": "frame"}))
        left = [Curve(frames, numbers[name], "-", f"{name} / °") for name in ("error", "side")]
        right = [
            Curve(frames, numbers["search_ms"], "b--", "1NN / ms (right)"),
            Curve(frames, numbers["lasso_ms"], "k:", "LASSO / ms (right)"),
        ]
        settings = {"xlabel": "frame", "ylim": (0.0, 4.0)}
        times.append(Panel(words, left, settings, right=right, right_limit=_MAX_MS))
    taus = len({part.values["tau"] for part in parts})
    size = {"columns": taus, "width": 10.0, "height": 2.2 * len(parts) / taus, "sharex": True}
    legend = {"legend": "outside lower center", "legend_columns": 4}
    percent = f"p = {100 * e.parameters['overlaps'][-1]:g} %"
    for name, number, shown, options in (
        ("figures_6_33_to_6_36_and_e.png", "6.33 to 6.36 and E", errors, {"sharey": True}),
        ("figures_6_42_6_43_and_g.png", "6.42, 6.43 and G", times, {}),
    ):
        e.draw(name, shown, title=f"Figures {number}: {percent}", **size, **legend, **options)
