"""Tracking from frame to frame with any star identifier."""

from __future__ import annotations

import dataclasses
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from starid.arithmetic.arrays import Array
from starid.attitude import Attitude
from starid.errors import StaridError
from starid.identification.attitude_history import AttitudeHistory
from starid.identification.solution import Solution
from starid.identification.star_identifier import StarIdentifier

LONGEST_GAP_S: Final = 10.0
"""Longest time without a valid attitude that a prediction bridges, seconds."""


class Tracker:
    """Track the attitude from frame to frame: predict, match nearby, or fall back to lost in space.

    Parameters
    ----------
    identifier : StarIdentifier
        The star identifier.
    longest_gap_s : float
        Largest age of the last valid attitude, seconds; beyond it the next frame is identified lost in space.
    window_px : float, optional
        See `StarIdentifier.track`.

    Attributes
    ----------
    rate_rad_s : ndarray (3,) or None
        Body rate in the sensor frame, from the last two valid attitudes.
    """

    def __init__(
        self,
        identifier: StarIdentifier,
        *,
        longest_gap_s: float = LONGEST_GAP_S,
        window_px: float | None = None,
    ) -> None:
        if not longest_gap_s > 0.0:
            raise StaridError(f"tracker longest_gap_s: must be seconds > 0, not {longest_gap_s}")
        self.identifier = identifier
        self.rate_rad_s: Array | None = None
        self._history = AttitudeHistory(window=2)
        self._longest_gap_s = longest_gap_s
        self._window_px = window_px

    @property
    def attitude(self) -> Attitude | None:
        """Last valid attitude."""
        last = self._history.last
        return None if last is None else last[1]

    def reset(self) -> None:
        """Forget attitude and rate, so that the next frame is identified lost in space."""
        self._history.clear()
        self.rate_rad_s = None

    def predict(self, time_s: float) -> Attitude | None:
        """Predict the attitude at a time; None without a recent valid attitude."""
        last = self._history.last
        if last is None or not 0.0 <= time_s - last[0] <= self._longest_gap_s:
            return None
        return self._history.predict(time_s, self.rate_rad_s)

    def update(
        self,
        xy_px: Array,
        flux: Array,
        time_s: float,
        xy_sigma_px: Array | None = None,
        *,
        rate_hint_rad_s: ArrayLike | None = None,
        observer_velocity: ArrayLike | None = None,
    ) -> Solution:
        """Identify the detections of one image.

        Parameters
        ----------
        xy_px, flux, xy_sigma_px, observer_velocity
            See `StarIdentifier.identify`.
        time_s : float
            Time of the exposure, seconds on any monotonic clock.
        rate_hint_rad_s : array (3,), optional
            Body rate in the sensor frame from another source, such as a gyro; replaces the estimate.

        Returns
        -------
        Solution
            With `rate_rad_s` after two valid solutions. After an invalid solution, predictions start from the
            last valid attitude until `longest_gap_s` has passed.
        """
        if rate_hint_rad_s is not None:
            self.rate_rad_s = np.asarray(rate_hint_rad_s, dtype=np.float64)
        predicted = self.predict(time_s)
        solution: Solution | None = None
        if predicted is not None:
            solution = self.identifier.track(
                xy_px,
                flux,
                predicted,
                xy_sigma_px,
                window_px=self._window_px,
                observer_velocity=observer_velocity,
            )
        if solution is None or not solution.valid:
            spent = 0.0 if solution is None else solution.elapsed
            solution = self.identifier.identify(xy_px, flux, xy_sigma_px, observer_velocity=observer_velocity)
            solution = dataclasses.replace(solution, elapsed=solution.elapsed + spent)
        if solution.valid:
            self._history.add(time_s, solution.attitude, self._longest_gap_s)
            rate = self._history.rate()
            self.rate_rad_s = None if rate is None else np.array(rate)
        return dataclasses.replace(solution, rate_rad_s=self.rate_rad_s if solution.valid else None)
