"""Why the recall of the thesis's filter falls: the spread of the disparities of true pairs."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

import numpy as np

from starid.lab.experiments.comparison import shown
from starid.lab.experiments.experiment import (
    Context,
    Experiment,
    Outcome,
    Parameters,
    Part,
    Results,
    parts_of,
    write_lines,
)
from starid.lab.experiments.fsf import EQUIVALENT, frames_of_seven, noise_of
from starid.thesis.fsf import EPSILON, MIN_SAMPLES_SHARE, pair_count, pairs_of

_FALSE_STARS: Final = 5

_NOTE: Final = f"""Seven stars, all visible, with brightness and position noise and no false star: the
{pair_count(7)} disparities of corresponding pairs should form one cluster. The table lists its spread, how
many of its members the fullest neighbourhood of ε = {EPSILON:g} contains (which decides whether there is a
core point), and the share of frames in which that is less than the min_samples for seven stars and f false
ones, {MIN_SAMPLES_SHARE:g}·(7 + f). Without a core point there is no cluster, and all stars of the frame
count as missed. At the printed noise there is no cluster in a growing share of the frames from μ = 4 on, the
more so the more false stars there are; at {EQUIVALENT:g} of it nothing is lost. Apart from chance neighbours
among the false pairs, this limits the recall, however the other steps are interpreted."""


def _parts(parameters: Parameters) -> list[Part]:
    return parts_of("m{factor}-x{scale:g}", scale=parameters["scales"], factor=parameters["factors"])


def _compute(context: Context, part: Part) -> Results:
    noise = noise_of("both", part.values["factor"] * part.values["scale"], 0)
    whole, frames = frames_of_seven(context.rng(part.key), noise, int(context.parameters["frames"]))
    first = pairs_of(whole.observed)
    spread, fullest = [], []
    for frame in frames:
        if len(frame.observed) < len(whole.observed):
            continue
        difference = first - pairs_of(frame.observed)
        difference[:, 2] -= 180.0 * np.ceil(difference[:, 2] / 180.0 - 0.5)
        middle = np.median(difference, axis=0)
        spread.append(np.median(np.abs(difference - middle), axis=0))
        apart = np.linalg.norm(difference[:, None] - difference[None, :], axis=2)
        fullest.append(int((apart <= EPSILON).sum(axis=1).max()))
    return {"spread": np.array(spread), "fullest": np.array(fullest)}


def _evaluate(context: Context, results: Mapping[str, Results]) -> Outcome:
    rows, lines = [], []
    for part in _parts(context.parameters):
        spread, fullest = results[part.key]["spread"], results[part.key]["fullest"]
        factor, scale = part.values["factor"], part.values["scale"]
        lost = {f: 100.0 * float(np.mean(fullest < MIN_SAMPLES_SHARE * (7 + f))) for f in (0, _FALSE_STARS)}
        typical = np.median(spread, axis=0)
        spreads = zip(
            ("brightness_spread_mag", "separation_spread_deg", "slope_spread_deg"), typical, strict=True
        )
        line = {"factor": factor, "scale": scale, **dict(spreads), "fullest_mean": float(fullest.mean())}
        lines.append(line | {f"lost_percent_f{f}": share for f, share in lost.items()})
        rows.append(
            shown(
                f"frames without a core among the true pairs, μ = {factor}, noise × {scale:g}: f = 0, f = {_FALSE_STARS}",
                printed=f"{lost[0]:.1f}, {lost[_FALSE_STARS]:.1f} %",
                remark=f"median spread {typical[1]:.2f}° in separation, {typical[2]:.2f}° in slope; fullest neighbourhood "
                f"{fullest.mean():.1f} of {pair_count(7)}",
            )
        )
    return Outcome(tuple(rows), (write_lines(context.folder / "limits.csv", lines),), (_NOTE,))


EXPERIMENTS: Final = (
    Experiment(
        "fsf-limits",
        "What noise leaves of the cluster: the recall of the filter",
        _parts,
        _compute,
        _evaluate,
        full={"scales": [1.0, EQUIVALENT], "factors": [1, 2, 3, 4, 5], "frames": 1500},
        quick=None,
    ),
)
