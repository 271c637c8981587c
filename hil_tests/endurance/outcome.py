"""What a life has shown."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass
class Outcome:
    """What a life has shown."""

    violation: str = ""
    """What the unit did and must never do; empty if nothing."""
    step: int = -1
    """Number of the last step."""
    device_s: float = 0.0
    exposed_s: float = 0.0
    """Simulation time lived, and the part of it in which images were taken, seconds."""
    frames: int = 0
    requests: int = 0
    readings: int = 0
    attitudes: int = 0
    """Images solved, requests sent, rows and PDOs read, and valid attitudes compared with the truth."""
