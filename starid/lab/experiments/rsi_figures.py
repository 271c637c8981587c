"""Figures of the recursive algorithm: sequences, precision and run time (6.33–6.43, E, F, G)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final

import numpy as np

from starid.lab.experiments.experiment import Evaluation, Part
from starid.lab.experiments.figures import Curve, Panel, panels, precision, precision_axes
from starid.lab.experiments.rsi_trials import BY_TABLE, FIELDS, LSI_ONLY, method_of, noise_label

_SHOWN: Final = 40
_LEAST: Final = 1e-4
_MAX_MS: Final = 1.0


def draw_sequences(e: Evaluation, parts: Sequence[Part], settling: int) -> None:
    """Draw all figures from the runs with μ = f; precision without the first `settling` frames."""
    parts = [part for part in parts if part.values["side"] != BY_TABLE]
    first, last = e.parameters["overlaps"][0], e.parameters["overlaps"][-1]
    for scale in e.parameters["scales"]:
        # runs without noise belong to every scale
        chosen = [p for p in parts if p.values["scale"] == scale or p.values["factor"] == 0]
        for number, words, overlaps, panel_of, label_of in (
            ("6_37_6_38_f_1_f_2", "6.37, 6.38, F.1, F.2", (first, last), _set, _method),
            ("f_3_to_f_5", "F.3 to F.5", (first,), _method, _set),
            ("6_39_to_6_41", "6.39 to 6.41", (last,), _method, _set),
        ):
            members = [part for part in chosen if part.values["overlap"] in overlaps]
            title = f"Figures {words}; {noise_label(scale)}"
            name = f"figures_{number}_x{scale:g}.png"
            _draw_precision(e, name, title, members, panel_of, label_of, settling)
    sequences = [
        part
        for part in parts
        if part.values["scale"] == e.parameters["scales"][0]
        and part.values["overlap"] == last
        and part.values["tau"] != LSI_ONLY
        and not part.values["memory"]
    ]
    _draw_frames(e, sequences)


def _method(part: Part) -> str:
    return f"{method_of(part.values['tau'], part.values['memory'])}, p = {100 * part.values['overlap']:g} %"


def _set(part: Part) -> str:
    return f"μ = f = {part.values['factor']}"


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
    curves = (
        (panel_of(part), precision(e.results[part.key]["numbers"][0, settling:], 1.0, label_of(part)))
        for part in parts
    )
    shown = panels(curves, "lower right", **precision_axes("ε_f"))
    e.draw(name, shown, columns=2, width=9.0, height=7.0, title=title, sharey=True)


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
