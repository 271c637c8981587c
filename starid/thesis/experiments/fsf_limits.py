"""Why the recall of the thesis's filter falls at the noise as printed: how far noise spreads the disparities of true pairs."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from starid.thesis.experiments.comparison import shown
from starid.thesis.experiments.experiment import (
    Context,
    Experiment,
    Outcome,
    Parameters,
    Part,
    Results,
    write_csv,
)
from starid.thesis.experiments.fsf import EQUIVALENT, RADIUS_DEG, first_frame, noise_of
from starid.thesis.fsf import EPSILON, MIN_SAMPLES_SHARE, pair_count, pair_features
from starid.thesis.simulation import moved_frames

_FALSE_STARS: Final = 5

_NOTE: Final = f"""Seven stars that are all seen, brightness and position noise, no false star: the {pair_count(7)} disparities of the pairs that
belong together ought to lie in one heap. The table gives the heap's spread, how many of its members the fullest neighbourhood
of ε = {EPSILON:g} holds (the heap's chance of a core point), and in which share of the frames that is less than the min_samples that
seven stars and f false ones ask for, {MIN_SAMPLES_SHARE:g}·(7 + f). Without a core point there is no cluster, and all stars of the frame count as missed. At
the noise as printed the heap is gone in a growing share of the frames from μ = 4 on, and the more so the more false stars there are; at
{EQUIVALENT:g} of it nothing is lost. But for chance companions among the false pairs this bounds the recall, however the other steps are read."""


def _parts(parameters: Parameters) -> list[Part]:
    return [
        Part(f"m{factor}-x{scale:g}", {"factor": factor, "scale": scale})
        for scale in parameters["scales"]
        for factor in parameters["factors"]
    ]


def _pairs(brightness: NDArray[np.float64], positions: NDArray[np.float64]) -> NDArray[np.float64]:
    vectors = np.empty((pair_count(brightness.size), 3))
    pair_features(brightness, positions, vectors, np.empty((len(vectors), 2), dtype=np.int64))
    return vectors


def _work(context: Context, part: Part) -> Results:
    brightness, positions = first_frame()
    noise = noise_of("both", part.values["factor"] * part.values["scale"], 0)
    frames = moved_frames(
        context.rng(part.key),
        brightness,
        positions,
        noise,
        count=int(context.parameters["frames"]),
        radius_deg=RADIUS_DEG,
    )
    reference = next(frames).observed
    first = _pairs(reference.brightness, reference.positions)
    spread, fullest = [], []
    for frame in frames:
        if frame.observed.brightness.size < brightness.size:
            continue
        difference = first - _pairs(frame.observed.brightness, frame.observed.positions)
        difference[:, 2] -= 180.0 * np.ceil(difference[:, 2] / 180.0 - 0.5)
        middle = np.median(difference, axis=0)
        spread.append(np.median(np.abs(difference - middle), axis=0))
        apart = np.linalg.norm(difference[:, None] - difference[None, :], axis=2)
        fullest.append(int((apart <= EPSILON).sum(axis=1).max()))
    return {"spread": np.array(spread), "fullest": np.array(fullest)}


def _finish(context: Context, results: Mapping[str, Results]) -> Outcome:
    columns: dict[str, list[Any]] = {}
    rows = []
    for part in _parts(context.parameters):
        spread, fullest = results[part.key]["spread"], results[part.key]["fullest"]
        factor, scale = part.values["factor"], part.values["scale"]
        lost = {f: 100.0 * float(np.mean(fullest < MIN_SAMPLES_SHARE * (7 + f))) for f in (0, _FALSE_STARS)}
        typical = np.median(spread, axis=0)
        line = {
            "factor": factor,
            "scale": scale,
            "brightness_spread_mag": typical[0],
            "separation_spread_deg": typical[1],
            "slope_spread_deg": typical[2],
            "fullest_mean": float(fullest.mean()),
            "lost_percent_f0": lost[0],
            f"lost_percent_f{_FALSE_STARS}": lost[_FALSE_STARS],
        }
        for name, value in line.items():
            columns.setdefault(name, []).append(value)
        rows.append(
            shown(
                f"frames without a core among the true pairs, μ = {factor}, noise × {scale:g}: f = 0, f = {_FALSE_STARS}",
                printed=f"{lost[0]:.1f}, {lost[_FALSE_STARS]:.1f} %",
                remark=f"median spread {typical[1]:.2f}° in separation, {typical[2]:.2f}° in slope; fullest neighbourhood "
                f"{fullest.mean():.1f} of {pair_count(7)}",
            )
        )
    write_csv(context.folder / "limits.csv", columns)
    return Outcome(tuple(rows), ("limits.csv",), (_NOTE,))


EXPERIMENTS: Final = (
    Experiment(
        "fsf-limits",
        "What noise leaves of the cluster: the recall of the filter",
        _parts,
        _work,
        _finish,
        full={"scales": [1.0, EQUIVALENT], "factors": [1, 2, 3, 4, 5], "frames": 1500},
        quick=None,
    ),
)
