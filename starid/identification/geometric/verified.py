"""Base of the identifiers whose answers the geometric identifier verifies, and that track with it."""

from __future__ import annotations

from abc import abstractmethod

from starid.attitude import Attitude
from starid.identification.geometric.identifier import Identifier
from starid.identification.single_camera import CheckedDetections, SingleCameraIdentifier
from starid.identification.solution import Solution


class VerifiedIdentifier(SingleCameraIdentifier):
    """A lost-in-space algorithm with verified answers; the verifier does the tracking."""

    @property
    @abstractmethod
    def verifier(self) -> Identifier:
        """The geometric identifier that verifies answers and tracks."""

    def _track(self, measured: CheckedDetections, predicted: Attitude, window_px: float | None) -> Solution:
        return self.verifier.track(
            measured.xy,
            measured.flux,
            predicted,
            measured.given_sigmas,
            window_px=window_px,
            observer_velocity=measured.observer_velocity,
        )

    def verify(self, measured: CheckedDetections, candidate: Attitude, window_px: float) -> Solution:
        """Verify an attitude that was found lost in space (`Identifier.verify`)."""
        return self.verifier.verify(
            measured.xy,
            measured.flux,
            candidate,
            measured.given_sigmas,
            window_px=window_px,
            observer_velocity=measured.observer_velocity,
        )
