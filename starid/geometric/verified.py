"""What identifiers share that have the geometric one verify their answers and track for them."""

from __future__ import annotations

from abc import ABC, abstractmethod

from numpy.typing import ArrayLike

from starid.attitude import Attitude
from starid.geometric.identifier import Identifier
from starid.solution import Solution


class VerifiedIdentifier(ABC):
    """An algorithm that is for lost in space only: its answers are verified, and tracking is the verifier's."""

    @property
    @abstractmethod
    def verifier(self) -> Identifier:
        """What verifies and tracks."""

    def track(
        self,
        xy_px: ArrayLike,
        flux: ArrayLike,
        predicted: Attitude | ArrayLike,
        xy_sigma_px: ArrayLike | None = None,
        *,
        window_px: float | None = None,
        observer_velocity: ArrayLike | None = None,
    ) -> Solution:
        """Attitude near a predicted one, as the verifier finds it.

        Parameters
        ----------
        xy_px, flux, predicted, xy_sigma_px, window_px, observer_velocity
            As in `starid.interface.StarIdentifier.track`.
        """
        return self.verifier.track(
            xy_px, flux, predicted, xy_sigma_px, window_px=window_px, observer_velocity=observer_velocity
        )
