"""What identifiers share that have the geometric one verify their answers and track for them."""

from __future__ import annotations

from abc import abstractmethod

from starid.attitude import Attitude
from starid.geometric.identifier import Identifier
from starid.single_camera import Measured, SingleCameraIdentifier
from starid.solution import Solution


class VerifiedIdentifier(SingleCameraIdentifier):
    """An algorithm that is for lost in space only: its answers are verified, and tracking is the verifier's."""

    @property
    @abstractmethod
    def verifier(self) -> Identifier:
        """What verifies and tracks."""

    def _track(self, measured: Measured, predicted: Attitude, window_px: float | None) -> Solution:
        return self.verifier.track(
            measured.xy,
            measured.flux,
            predicted,
            measured.given_sigmas,
            window_px=window_px,
            observer_velocity=measured.observer_velocity,
        )

    def verify(self, measured: Measured, candidate: Attitude, window_px: float) -> Solution:
        """Verify an attitude that was found lost in space (`Identifier.verify`)."""
        return self.verifier.verify(
            measured.xy,
            measured.flux,
            candidate,
            measured.given_sigmas,
            window_px=window_px,
            observer_velocity=measured.observer_velocity,
        )
