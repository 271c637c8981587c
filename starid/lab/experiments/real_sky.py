"""Beyond the thesis: algorithm 1 alone on the true sphere, off the grid, against noise, overlap p and brightness limit κ."""

from __future__ import annotations

import math
from typing import Any, Final

import numpy as np

from starid.arithmetic.arrays import Array
from starid.attitude import Attitude, random_attitude
from starid.camera import DEFAULT_CAMERA
from starid.identification.thesis.feature_search import FeatureSearch
from starid.identification.thesis.lsi_identifier import LsiIdentifier
from starid.lab.experiments.experiment import Context, Evaluation, Part, Results
from starid.lab.experiments.figures import Curve
from starid.lab.experiments.lsi_trials import share

_SEEN_MAG: Final = 1.0
"""How much fainter than κ the stars are that noise may carry across it."""


def _error_deg(search: FeatureSearch, rng: np.random.Generator, sigma: float) -> float:
    """Error of the boresight at a random attitude with noise of the magnitudes; NaN with too few stars."""
    somewhere = random_attitude(rng)
    truth = Attitude.from_radec_roll(somewhere.ra_deg, somewhere.dec_deg, 0.0)
    brightness, offsets, _ = search.stars.stars_in_frame(truth.ra_deg, truth.dec_deg)
    magnitude = brightness + rng.normal(0.0, 1.0, brightness.size) * sigma
    features = search.features(search.field_of(offsets, magnitude))
    if features is None:
        return math.nan
    return search.answer(features).attitude.error_to(truth).cross_boresight_arcsec / 3600.0


def compute(context: Context, part: Part) -> Results:
    """Errors of the boresight, degrees, for each noise of the magnitudes, (k, n)."""
    kappa = float(part["kappa"])
    identifier = LsiIdentifier(
        DEFAULT_CAMERA, feature_limit=kappa, overlap=float(part["overlap"]), detected_limit=kappa + _SEEN_MAG
    )
    frames = int(context.parameters["frames"])
    return {
        "errors": np.array(
            [
                [_error_deg(identifier.search, rng, float(sigma)) for _ in range(frames)]
                for sigma, rng in ((sigma, context.rng("frames")) for sigma in context.parameters["sigmas"])
            ]
        ),
        "bytes": np.array([identifier.database.bytes_features]),
    }


def _figures(errors: Array) -> dict[str, float]:
    known = errors[np.isfinite(errors)]
    return {
        "median_deg": float(np.median(known)) if known.size else math.nan,
        "within_0_3": share(errors, 0.3),
        "within_1": share(errors, 1.0),
    }


def evaluate(e: Evaluation) -> None:
    """A row for each overlap, limit and noise; curves of the share within 0.3° against noise."""
    sigmas = [float(sigma) for sigma in e.parameters["sigmas"]]
    lines: list[dict[str, Any]] = []
    curves: list[tuple[str, Curve]] = []
    for part in e.parts:
        kappa, overlap = part["kappa"], part["overlap"]
        rows = [_figures(errors) for errors in e[part]["errors"]]
        for sigma, figures in zip(sigmas, rows, strict=True):
            lines.append({"kappa": kappa, "overlap": overlap, "sigma_mag": sigma, **figures})
            quantity = f"boresight within 0.3°, κ = {kappa:g}, p = {100.0 * overlap:g} %, σ = {sigma:g} mag"
            e.compare(quantity, ours=figures["within_0_3"], unit="%", digits=1)
        y = np.array([figures["within_0_3"] for figures in rows])
        curves.append((f"p = {100.0 * overlap:g} %", Curve(np.array(sigmas), y, "o-", f"κ = {kappa:g}")))
    e.write("real_sky.csv", lines)
    axes = {"xlabel": "noise of the magnitudes, mag", "ylabel": "frames within 0.3°, %", "ylim": (0.0, 100.0)}
    e.draw("real_sky.png", curves, axes=axes, columns=2, width=8.0, height=6.4, legend="upper right")
