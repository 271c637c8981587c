"""What a life has shown."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass
class Outcome:
    """What a life has shown.

    Attributes
    ----------
    violation
        What the unit did and must never do; empty if nothing.
    step
        Number of the last step.
    device_s, exposed_s
        Simulation time lived, and the part of it in which images were taken, seconds.
    frames, requests, readings, attitudes
        Images solved, requests sent, rows and PDOs read, and valid attitudes compared with the truth.
    """

    violation: str = ""
    step: int = -1
    device_s: float = 0.0
    exposed_s: float = 0.0
    frames: int = 0
    requests: int = 0
    readings: int = 0
    attitudes: int = 0
