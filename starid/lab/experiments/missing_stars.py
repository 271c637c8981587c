"""The future work of section 7.2 of the thesis: missing stars restored by the filter, and a divided field."""

from __future__ import annotations

import itertools
from functools import lru_cache
from typing import Final

import numpy as np

from starid.arithmetic.arrays import Array
from starid.identification.thesis.cme import matched_motion
from starid.identification.thesis.database import DatabaseParameters, build_database
from starid.identification.thesis.false_stars import ObservedFrame
from starid.identification.thesis.features import FeatureError, FeatureVector, extract_features
from starid.identification.thesis.fsf import ClusterFilter
from starid.identification.thesis.lsi import LostInSpace
from starid.identification.thesis.metrics import boresight_error
from starid.identification.thesis.missing_stars import DividedField, restore_missing
from starid.lab.experiments.experiment import Context, Evaluation, Part, Results, star_catalog
from starid.lab.experiments.lsi_trials import (
    HALF_FRAME_DEG,
    OFF,
    count_label,
    error_of,
    frames_under_test,
    share,
    stars_of,
)
from starid.lab.experiments.rsi_trials import START
from starid.lab.simulation import NoiseModel, add_noise, sky_sequence

_OVERLAP: Final = 0.995
_FRAME_DEG: Final = 24.0
_STEP_DEG: Final = 0.2
_COVERED_FROM_DEG: Final = 12.0
_MARGIN_DEG: Final = 1.6
_RIM_DEG: Final = 0.01
_LABELS: Final = {
    "none": "nothing missing",
    "covered": f"a body covers the field beyond {_COVERED_FROM_DEG:g}° on one side",
    **{f"{kind}-{n}": count_label(n, kind) for kind in ("missing", "false") for n in (1, 2, 3)},
}


@lru_cache(maxsize=1)
def _divided() -> DividedField:
    parameters = DatabaseParameters(overlap=1.0 - _STEP_DEG / _FRAME_DEG, fov_deg=_FRAME_DEG)
    database = build_database(star_catalog(), parameters)
    return DividedField(LostInSpace(database), half_width_deg=HALF_FRAME_DEG)


def _with_changed_stars(
    rng: np.random.Generator, case: str, brightness: Array, positions: Array
) -> ObservedFrame:
    """Remove stars from a frame, or add false ones, as a case says."""
    if case == "covered":
        seen = positions[:, 0] < _COVERED_FROM_DEG
        return ObservedFrame(brightness[seen], positions[seen])
    kind, _, count = case.partition("-")
    noise = NoiseModel.of(kind, float(count or 0))
    mags, noisy, _ = add_noise(rng, brightness, positions, noise, HALF_FRAME_DEG)
    return ObservedFrame(mags, noisy)


def _boresight_errors(context: Context, part: Part) -> Results:
    """ε_f (2, n) of the whole and of the divided field; NaN for no answer."""
    lsi, divided = context.lost_in_space(_OVERLAP), _divided()
    rng, step = context.rng(part.key), lsi.database.grid.step_deg
    frames = frames_under_test(context.rng("frames"), OFF, step, context.parameters["every"])
    errors = np.full((2, len(frames)), np.nan)
    for i, (place, stars) in enumerate(zip(frames, stars_of(context.sky(), frames), strict=True)):
        frame = _with_changed_stars(rng, part["case"], *stars)
        if len(frame) == 0:
            continue
        errors[0, i] = error_of(lsi.solve(extract_features(frame.brightness, frame.positions)).mse, *place)
        answer = divided.solve(frame)
        if answer is not None:
            errors[1, i] = boresight_error(answer.right_ascension_deg, answer.declination_deg, *place)
    return {"errors": errors}


def _features(frame: ObservedFrame) -> FeatureVector | None:
    inside = np.sum(frame.positions**2, axis=1) <= HALF_FRAME_DEG**2
    try:
        return extract_features(frame.brightness[inside], frame.positions[inside])
    except FeatureError:
        return None


def _put_back(context: Context) -> Results:
    """ε_f (2, n) of frames that lack a star: as they are, and with the stars that the filter restores."""
    lsi, cluster = context.lost_in_space(_OVERLAP), ClusterFilter()
    rng, count = context.rng("put-back"), int(context.parameters["frames"])
    frames = sky_sequence(rng, context.sky(), *START, NoiseModel(), count=count, margin_deg=_MARGIN_DEG)
    sequence = list(frames)
    errors = np.full((2, len(sequence) - 1), np.nan)
    for i, (before, after) in enumerate(itertools.pairwise(sequence)):
        whole = after.observed
        inside = np.flatnonzero(np.sum(whole.positions**2, axis=1) <= (HALF_FRAME_DEG - _RIM_DEG) ** 2)
        kept = np.delete(np.arange(len(whole)), rng.choice(inside))
        now = ObservedFrame(whole.brightness[kept], whole.positions[kept])
        result = cluster(before.observed, now)
        motion = matched_motion(before.observed, now, result.matches)
        if motion is None:
            continue
        rim = {"radius_deg": HALF_FRAME_DEG + _MARGIN_DEG, "margin_deg": _MARGIN_DEG}
        mended = restore_missing(before.observed, now, result, motion, **rim)
        place = after.right_ascension_deg, after.declination_deg
        for j, frame in enumerate((now, mended)):
            features = _features(frame)
            if features is not None:
                observation = lsi.database.normalise(features)
                cell, distance, _ = lsi.nearest_in_region(observation, *place, 4.0)
                errors[j, i] = error_of(lsi.estimate(observation, cell, distance).mse, *place)
    return {"errors": errors}


def compute(context: Context, part: Part) -> Results:
    """ε_f (2, n) with the features as seen, and with what the thesis suggests."""
    return _put_back(context) if part.key == "put-back" else _boresight_errors(context, part)


def evaluate(e: Evaluation) -> None:
    """What each case loses, and what is regained."""
    lines = []
    for part in e.parts:
        errors = e[part]["errors"]
        names = ("as seen", "put back") if part.key == "put-back" else ("whole field", "divided field")
        for name, one in zip(names, errors, strict=True):
            within = {f"within_{limit:g}": share(one, limit) for limit in (0.3, 1.0)}
            lost = 100.0 * float(np.mean(np.isnan(one)))
            lines.append({"case": part.key, "method": name, **within, "no_answer": lost})
        label = _LABELS.get(part.key, "one star missing, put back from the frame before")
        unfilled, regained = (share(one, 1.0) for one in errors)
        e.claim(
            f"{label}, off the grid: share with ε_f ≤ 1°",
            ours=f"{regained:.2f} %",
            matches=[regained > unfilled or (part.key == "none" and regained >= unfilled)],
            target=f"more than the features as seen, {unfilled:.2f} %",
            remark=f"{names[1].capitalize()}: {share(errors[1], 0.3):.1f} % within 0.3°, {lost:.1f} % without "
            f"an answer, {100.0 * np.mean(errors[1] > 1.0):.1f} % wrong by more than 1°.",
            kind="ours",
        )
        close, closer = (share(one, 0.3) for one in errors)
        e.compare(f"{label}: share with ε_f ≤ 0.3°", printed=close, ours=closer, unit="%")
    e.write("missing_stars.csv", lines)
