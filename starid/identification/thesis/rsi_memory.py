"""Prediction of the boresight by a vote of the last answers, carried forward with the measured motion.

This is our addition to the recursive algorithm. The camera's motion is measured to hundredths of a degree,
while an answer is occasionally wrong by a degree, or by half the sky. Answers that agree once the motion
between them is removed are correct.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from starid.arithmetic.arrays import Array
from starid.arithmetic.elementary import cos, sin, square
from starid.identification.thesis.cme import CameraMotion

_RA, _DEC, _ROLL, _TURN, _X, _Y = range(6)


@dataclass(frozen=True, slots=True)
class Prediction:
    """Predicted boresight and roll.

    Attributes
    ----------
    right_ascension_deg, declination_deg, roll_deg
        Boresight and roll, degrees.
    votes
        Number of answers that agree with it.
    """

    right_ascension_deg: float
    declination_deg: float
    roll_deg: float
    votes: int


class AnswerMemory:
    """The last answers, and the motion since each of them.

    Parameters
    ----------
    size
        Maximum number of answers.
    agreement_deg
        Distance within which two answers agree, degrees.
    """

    def __init__(self, size: int, agreement_deg: float) -> None:
        self._size = size
        self._agreement = agreement_deg
        self._answers = np.empty((0, 6))

    def clear(self) -> None:
        """Discard all answers, for example because the motion since then is unknown."""
        self._answers = np.empty((0, 6))

    def add(self, right_ascension_deg: float, declination_deg: float, roll_deg: float) -> None:
        """Add the answer of the current frame, degrees."""
        answer = np.array([[right_ascension_deg, declination_deg, roll_deg, 0.0, 0.0, 0.0]])
        self._answers = np.concatenate([self._answers, answer])[-self._size :]

    def carry(self, motion: CameraMotion) -> None:
        """Carry all answers to the next frame, in which the stars have moved by `motion`."""
        answers = self._answers
        answers[:, _TURN] += motion.rotation_deg
        answers[:, _X : _Y + 1] = motion.apply(answers[:, _X : _Y + 1])

    def prediction(self) -> Prediction | None:
        """Return the prediction on which most answers agree (the latest of equal ones); None without answers.

        The roll comes first, because the motion in the sky depends on it: a circular median.
        """
        answers = self._answers
        if answers.shape[0] == 0:
            return None
        rolls = _wrapped(answers[:, _ROLL] + answers[:, _TURN])
        apart = np.abs(_wrapped(rolls[:, None] - rolls[None, :]))
        middle = rolls[int(np.argmin(apart.sum(axis=1)))]
        roll = middle + float(np.median(_wrapped(rolls - middle)))
        c, s = cos(math.radians(roll)), sin(math.radians(roll))
        x, y = answers[:, _X], answers[:, _Y]
        ra = answers[:, _RA] - (c * x + s * y)
        dec = answers[:, _DEC] - (c * y - s * x)
        distance = np.sqrt(square(_wrapped(ra[:, None] - ra[None, :])) + square(dec[:, None] - dec[None, :]))
        agrees = distance <= self._agreement
        votes = agrees.sum(axis=1)
        winner = int(np.flatnonzero(votes == votes.max())[-1])
        members = agrees[winner]
        east = float(np.median(_wrapped(ra[members] - ra[winner])))
        turn = float(np.median(_wrapped(rolls[members] - roll)))
        return Prediction(
            float((ra[winner] + east) % 360.0),
            float(np.median(dec[members])),
            float(_wrapped(np.array(roll + turn))),
            int(votes[winner]),
        )


def _wrapped(angle_deg: Array) -> Array:
    """Wrap angles to −180 … 180 degrees."""
    return np.asarray((angle_deg + 180.0) % 360.0 - 180.0, dtype=np.float64)
