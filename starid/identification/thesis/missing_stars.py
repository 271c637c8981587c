"""Missing stars: restored from the previous frame, or avoided by dividing the field (section 7.2).

The thesis suggests both as future work; this is our implementation. A single missing star changes all five
features of a frame. A star of the previous frame that the camera motion carries to a position in the field
where nothing is detected is missing, and is restored there. Lost in space there is no previous frame. The
field is then divided into smaller overlapping circles, each with a database of that width, and the answer is
the boresight of the whole field on which several circles agree: those with missing stars do not agree.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from starid.arithmetic.arrays import Array, elementwise
from starid.arithmetic.elementary import cos, sin, square
from starid.arithmetic.matrices import lengths
from starid.identification.thesis.cme import CameraMotion
from starid.identification.thesis.database import DatabaseError
from starid.identification.thesis.false_stars import FilterResult, ObservedFrame
from starid.identification.thesis.features import extract_features
from starid.identification.thesis.lsi import LostInSpace
from starid.identification.thesis.metrics import boresight_error

MAX_ERROR_PSI: Final = 2.0
"""Largest ε_ψ of a circle that votes; beyond it, its features fit no cell."""

SUBFIELD_OFFSET: Final = 0.3
"""Distance of the centres of the outer circles from the centre of the field, as a share of its half-width."""


def restore_missing(
    before: ObservedFrame,
    now: ObservedFrame,
    result: FilterResult,
    motion: CameraMotion,
    *,
    radius_deg: float,
    margin_deg: float,
) -> ObservedFrame:
    """Return the true stars of the later frame, and those of the earlier one that it lacks.

    Parameters
    ----------
    before, now, result, motion
        Two frames, the result of a filter for them, and the motion of the stars.
    radius_deg
        Radius of the field of the features, degrees.
    margin_deg
        A star predicted nearer to the rim than this may have left the field and is not restored, degrees.
    """
    matched = np.zeros(len(before), dtype=np.bool_)
    matched[result.matches[:, 0]] = True
    predicted = motion.apply(before.positions)
    inside = lengths(predicted) <= radius_deg - margin_deg
    lost = result.true_before & ~matched & inside
    return ObservedFrame(
        np.concatenate([now.brightness[result.true_now], before.brightness[lost]]),
        np.concatenate([now.positions[result.true_now], predicted[lost]]),
    )


@dataclass(frozen=True, slots=True)
class SubfieldAnswer:
    """Boresight of the whole field, from one circle of a divided field or several that agree.

    Attributes
    ----------
    right_ascension_deg, declination_deg, roll_deg
        Boresight and roll of the whole field, degrees.
    error_psi
        ε_ψ of the circle, or the least of several.
    votes
        Number of circles that agree.
    """

    right_ascension_deg: float
    declination_deg: float
    roll_deg: float
    error_psi: float
    votes: int


class DividedField:
    """Lost-in-space identification by overlapping circles of the field, of which at least two must agree.

    Parameters
    ----------
    lost_in_space
        LSI on a planar database whose frames are narrower than the field.
    half_width_deg
        Half-width of the whole field, degrees.
    agreement_deg
        Distance within which two circles agree on the boresight, degrees.

    Raises
    ------
    DatabaseError
        The database is not planar, or its circles do not fit into the field.
    """

    def __init__(
        self, lost_in_space: LostInSpace, *, half_width_deg: float, agreement_deg: float = 1.0
    ) -> None:
        parameters = lost_in_space.database.parameters
        self._radius = parameters.half_width
        self._offset = SUBFIELD_OFFSET * half_width_deg
        if parameters.geometry != "planar" or self._radius + self._offset > half_width_deg * (1.0 + 1e-9):
            raise DatabaseError(
                f"divided field: needs a planar database with frames of at most "
                f"{2.0 * (half_width_deg - self._offset):g}°; it has {2.0 * self._radius:g}°, {parameters.geometry}"
            )
        self._lsi = lost_in_space
        self._agreement = agreement_deg

    def centres(self) -> Array:
        """Centres of the circles, (9, 2) degrees: the middle, and eight around it."""
        turns = np.arange(8) * (math.pi / 4.0)
        ring = self._offset * np.column_stack([elementwise(cos, turns), elementwise(sin, turns)])
        return np.concatenate([np.zeros((1, 2)), ring])

    def answers(self, frame: ObservedFrame) -> list[SubfieldAnswer]:
        """Estimates from all circles that contain a star."""
        estimates = []
        for centre in self.centres():
            places = frame.positions - centre
            inside = np.sum(square(places), axis=1) <= square(self._radius)
            if not inside.any():
                continue
            features = extract_features(frame.brightness[inside], places[inside])
            estimate = self._lsi.solve(features).mse
            roll = math.remainder(features.theta_rad - estimate.theta_rad, 2.0 * math.pi)
            c, s = cos(roll), sin(roll)
            east, north = c * centre[0] + s * centre[1], c * centre[1] - s * centre[0]
            estimates.append(
                SubfieldAnswer(
                    float(estimate.right_ascension_deg - east) % 360.0,
                    float(estimate.declination_deg - north),
                    math.degrees(roll),
                    estimate.error_psi,
                    1,
                )
            )
        return estimates

    def solve(self, frame: ObservedFrame) -> SubfieldAnswer | None:
        """Return the median boresight on which most circles agree; None if no two agree."""
        answers = self.answers(frame)
        answers = [answer for answer in answers if answer.error_psi <= MAX_ERROR_PSI]
        groups = [self._agreeing(answer, answers) for answer in answers]
        best = max(groups, key=lambda group: (len(group), -min(a.error_psi for a in group)), default=[])
        return _median(best) if len(best) > 1 else None

    def _agreeing(self, answer: SubfieldAnswer, others: Sequence[SubfieldAnswer]) -> list[SubfieldAnswer]:
        return [
            other
            for other in others
            if boresight_error(
                other.right_ascension_deg,
                other.declination_deg,
                answer.right_ascension_deg,
                answer.declination_deg,
            )
            <= self._agreement
        ]


def _median(group: Sequence[SubfieldAnswer]) -> SubfieldAnswer:
    first = group[0]
    east = [math.remainder(a.right_ascension_deg - first.right_ascension_deg, 360.0) for a in group]
    turn = [float(math.remainder(a.roll_deg - first.roll_deg, 360.0)) for a in group]
    return SubfieldAnswer(
        (first.right_ascension_deg + float(np.median(east))) % 360.0,
        float(np.median([a.declination_deg for a in group])),
        math.remainder(first.roll_deg + float(np.median(turn)), 360.0),
        min(a.error_psi for a in group),
        len(group),
    )
