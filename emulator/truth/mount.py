"""The truth of a sensor, from the truth of the body on which it is mounted."""

from __future__ import annotations

from dataclasses import dataclass, replace

from starhil.emulator.truth.source import TruthSource, TruthState
from starid.attitude import Attitude


@dataclass(frozen=True)
class MountedTruth:
    """The truth of a sensor with a fixed mount.

    Attributes
    ----------
    body
        Truth of the body: attitude ICRS→body, rate in the body frame.
    mount
        Rotation body→sensor.
    """

    body: TruthSource
    mount: Attitude

    @property
    def kind(self) -> str:
        """Kind of the truth source of the body."""
        return self.body.kind

    def state(self, t_s: float) -> TruthState:
        """Return the truth of the sensor at a simulation time in seconds."""
        state = self.body.state(t_s)
        turn = self.mount.matrix
        return replace(
            state,
            attitude=Attitude.from_matrix(turn @ state.attitude.matrix),
            rate_rad_s=turn @ state.rate_rad_s,
        )


def mounted(body: TruthSource, mount: Attitude | None) -> TruthSource:
    """Return the truth of a sensor; without a mount, its frame is the body frame."""
    return body if mount is None else MountedTruth(body, mount)
