"""Recursive star identification (algorithm 3): filter, motion, search region or whole sky."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, replace
from typing import Final, Literal

import numpy as np

from starid.arithmetic.arrays import Array, Mask
from starid.arithmetic.elementary import square
from starid.errors import StaridError
from starid.identification.thesis.cme import CameraMotion, MotionModel, matched_motion
from starid.identification.thesis.false_stars import FalseStarFilter, ObservedFrame
from starid.identification.thesis.features import FeatureVector, extract_features
from starid.identification.thesis.lsi import LostInSpace, LsiEstimate, LsiSolution
from starid.identification.thesis.rsi_memory import AnswerMemory, Prediction

Mode = Literal["lsi", "rsi"]

_MIN_VOTES: Final = 2


class RsiError(StaridError):
    """Settings or frames that the recursive algorithm rejects."""


@dataclass(frozen=True, slots=True)
class RsiSettings:
    """Settings of the recursive algorithm.

    Attributes
    ----------
    tau
        Threshold τ on ε_ψ beyond which the whole database is searched.
    invalid_factor
        Factor K: an estimate with ε_ψ > K·τ is invalid.
    gamma_min_deg, gamma_scale, gamma_lsi_deg
        Γ_min, its scale factor, and the side from which the whole database is searched at once.
    motion_threshold_deg
        Distance beyond which a match is not used for the motion.
    motion_model
        Transformation that models the camera motion; the thesis uses an affine one.
    angle_in_search
        Use the polar angle as a sixth feature of the search, as in the thesis's worked example. The frame
        must then not be rotated by more than a few degrees.
    memory, agreement_deg
        0: the thesis's algorithm, in which each answer is the centre of the next search region. Otherwise our
        addition: this many previous answers, carried forward with the motion, vote; two agree if they are
        within `agreement_deg`. The answer with most votes is the result and the next centre.
    """

    tau: float = 0.5
    invalid_factor: float = 10.0
    gamma_min_deg: float = 2.0
    gamma_scale: float = 1.0
    gamma_lsi_deg: float = 90.0
    motion_threshold_deg: float = 1.0
    motion_model: MotionModel = "rigid"
    angle_in_search: bool = False
    memory: int = 0
    agreement_deg: float = 0.5

    def __post_init__(self) -> None:
        values = (
            self.tau,
            self.invalid_factor,
            self.gamma_min_deg,
            self.gamma_lsi_deg,
            self.motion_threshold_deg,
            self.agreement_deg,
        )
        if not all(value > 0.0 for value in values) or self.gamma_scale < 0.0 or self.memory < 0:
            raise RsiError("RSI: thresholds and sides must be positive, the memory not negative")


@dataclass(frozen=True, eq=False)
class RsiStep:
    """The result for one frame.

    Attributes
    ----------
    true_stars
        The objects from which the features were computed.
    motion
        Camera motion since the previous frame, if it is known.
    estimate
        Boresight and polar angle; None if no star remained.
    roll_deg
        Roll: observed minus estimated polar angle, −180 … 180.
    valid
        False if there is no estimate or ε_ψ > K·τ.
    mode
        Where the first search was: in the region ("rsi") or in the whole database ("lsi").
    triggered
        The answer from the region exceeded τ, so the whole database was searched too.
    exceeded
        ε_ψ of the answer kept exceeds τ.
    region_deg, region_cells
        Side Γ of the region, and its number of cells; NaN and 0 in mode "lsi".
    search_s, lasso_s
        Time of the nearest-neighbour searches and of the LASSO, seconds.
    """

    true_stars: Mask
    motion: CameraMotion | None
    estimate: LsiEstimate | None = None
    roll_deg: float = math.nan
    valid: bool = False
    mode: Mode = "lsi"
    triggered: bool = False
    exceeded: bool = True
    region_deg: float = math.nan
    region_cells: int = 0
    search_s: float = 0.0
    lasso_s: float = 0.0


def region_side(mean_distance_deg: float, sigma_distance_deg: float, settings: RsiSettings) -> float:
    """Side of the search region, degrees: Γ = Γ_min + scale·√(μ_d·σ_d), as eq. 6.5 is interpreted here.

    The thesis prints Γ_min + 110^(−log10(μ_d)/2)·110^(−log10(σ_d)/2)·σ_d·μ_d. With "1·10" instead of "110"
    the powers are 1/√μ_d and 1/√σ_d, and the product is √(μ_d·σ_d).
    """
    return settings.gamma_min_deg + settings.gamma_scale * math.sqrt(mean_distance_deg * sigma_distance_deg)


def region_cells(side_deg: float, fov_deg: float, overlap: float) -> float:
    """Number of cells of a region, N_RoS = Γ²/(φ_x·φ_y·(1 − p)²), eq. 6.6."""
    return square(side_deg / (fov_deg * (1.0 - overlap)))


def correlation(first: Array, second: Array) -> tuple[float, float]:
    """Correlation coefficient ρ(μ_d, σ_d) of eq. 4.2, and its p-value."""
    from scipy.stats import pearsonr

    result = pearsonr(first, second)
    return float(result.statistic), float(result.pvalue)


class RecursiveIdentification:
    """The recursive algorithm on one database, for frames in sequence.

    Parameters
    ----------
    lost_in_space
        The LSI algorithm on a planar database.
    false_star_filter
        Compares the previous frame with the current one; None accepts every object.
    settings
        Thresholds and search region.

    Raises
    ------
    RsiError
        The database is not planar (for the sphere see `starid.identification.thesis.rsi_identifier`).
    """

    def __init__(
        self,
        lost_in_space: LostInSpace,
        false_star_filter: FalseStarFilter | None,
        settings: RsiSettings | None = None,
    ) -> None:
        if lost_in_space.database.parameters.geometry != "planar":
            raise RsiError(
                "RSI: the thesis's algorithm needs a planar database; build one with --geometry planar"
            )
        self.settings = settings or RsiSettings()
        self._lsi = lost_in_space
        self._filter = false_star_filter
        self._radius = lost_in_space.database.parameters.half_width
        self.reset()

    def reset(self) -> None:
        """Start again with the next frame as the first."""
        self._before: ObservedFrame | None = None
        self._memory = AnswerMemory(max(self.settings.memory, 1), self.settings.agreement_deg)
        self._searches_all = True

    def step(self, frame: ObservedFrame) -> RsiStep:
        """Identify the next frame.

        The first frame, and every frame after one whose ε_ψ stayed above τ, is searched in the whole
        database. Any other is searched in the region around the predicted boresight and, if ε_ψ exceeds τ
        (eq. 4.1), in the whole database too; the answer with the smaller ε_ψ is kept. With a memory, a region
        on which several answers agree is also searched after a frame above τ.
        """
        true_stars, motion = self._filtered(frame)
        side = math.nan
        if motion is None:
            self._memory.clear()
        else:
            side = region_side(motion.mean_distance_deg, motion.sigma_distance_deg, self.settings)
            self._memory.carry(motion)
        features = self._features(frame, true_stars)
        self._before = frame
        if features is None:
            self._memory.clear()
            self._searches_all = True
            return RsiStep(true_stars, motion)
        observation = self._lsi.database.normalise(features)
        angle = features.theta_rad if self.settings.angle_in_search else math.nan
        predicted = self._memory.prediction()
        start = time.perf_counter()
        cells = 0
        cell, distance = -1, math.inf
        if predicted is not None and side < self.settings.gamma_lsi_deg and self._trusts(predicted):
            centre = predicted.right_ascension_deg, predicted.declination_deg
            cell, distance, cells = self._lsi.nearest_in_region(observation, *centre, side, theta_rad=angle)
        use_region = cell >= 0
        if not use_region:
            cell, distance = self._lsi.nearest(observation, theta_rad=angle)
        found = time.perf_counter()
        solution = self._lsi.estimate(observation, cell, distance)
        solved = time.perf_counter()
        search_s, lasso_s = found - start, solved - found
        triggered = use_region and solution.mse.error_psi > self.settings.tau
        if triggered:
            solution, more_search, more_lasso = self._whole_database(observation, angle, solution)
            search_s, lasso_s = search_s + more_search, lasso_s + more_lasso
        estimate, roll = self._voted(solution.mse, features)
        exceeded = estimate.error_psi > self.settings.tau
        self._searches_all = exceeded
        return RsiStep(
            true_stars,
            motion,
            estimate,
            roll,
            estimate.error_psi <= self.settings.invalid_factor * self.settings.tau,
            "rsi" if use_region else "lsi",
            triggered,
            exceeded,
            side if use_region else math.nan,
            cells,
            search_s,
            lasso_s,
        )

    def _trusts(self, predicted: Prediction) -> bool:
        """Whether to search the predicted region: not after a doubtful frame unless answers agree."""
        return not self._searches_all or predicted.votes >= _MIN_VOTES

    def _voted(self, estimate: LsiEstimate, features: FeatureVector) -> tuple[LsiEstimate, float]:
        """Remember a valid answer; return the answer and roll or, with a memory, those with the most votes."""
        roll = (features.theta_deg - math.degrees(estimate.theta_rad) + 180.0) % 360.0 - 180.0
        if estimate.error_psi <= self.settings.invalid_factor * self.settings.tau:
            self._memory.add(estimate.right_ascension_deg, estimate.declination_deg, roll)
        elif self.settings.memory == 0:
            self._memory.clear()
        agreed = self._memory.prediction() if self.settings.memory > 0 else None
        if agreed is None or agreed.votes < _MIN_VOTES:
            return estimate, roll
        theta = math.remainder(math.radians(features.theta_deg - agreed.roll_deg), 2.0 * math.pi)
        voted = replace(
            estimate,
            right_ascension_deg=agreed.right_ascension_deg,
            declination_deg=agreed.declination_deg,
            theta_rad=theta,
        )
        return voted, agreed.roll_deg

    def _whole_database(
        self, observation: Array, angle: float, solution: LsiSolution
    ) -> tuple[LsiSolution, float, float]:
        start = time.perf_counter()
        cell, distance = self._lsi.nearest(observation, theta_rad=angle)
        searched = time.perf_counter()
        other = self._lsi.estimate(observation, cell, distance)
        solved = time.perf_counter()
        better = other if other.mse.error_psi < solution.mse.error_psi else solution
        return better, searched - start, solved - searched

    def _filtered(self, frame: ObservedFrame) -> tuple[Mask, CameraMotion | None]:
        """Return which objects are stars (all without a previous frame), and their motion or None."""
        everything = np.ones(len(frame), dtype=np.bool_)
        if self._before is None or self._filter is None:
            return everything, None
        result = self._filter(self._before, frame)
        limit, model = self.settings.motion_threshold_deg, self.settings.motion_model
        motion = matched_motion(self._before, frame, result.matches, threshold_deg=limit, model=model)
        return (everything, None) if motion is None else (result.true_now, motion)

    def _features(self, frame: ObservedFrame, chosen: Mask) -> FeatureVector | None:
        inside = chosen & (np.sum(square(frame.positions), axis=1) <= square(self._radius))
        if not inside.any():
            return None
        return extract_features(frame.brightness[inside], frame.positions[inside])
