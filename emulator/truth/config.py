"""Configuration of truth sources in a profile, a scenario or on the control channel."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Literal, Self, TypeAlias

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator

from starhil.emulator.truth.file import read_truth_file
from starhil.emulator.truth.live import LiveTruth
from starhil.emulator.truth.source import (
    MAX_RATE_DEG_S,
    FixedTruth,
    HoldSegment,
    RateSegment,
    RateTruth,
    Segment,
    SlewSegment,
    SlewTruth,
    TruthSource,
)
from starid.attitude import Attitude

AxisRate: TypeAlias = Annotated[float, Field(ge=-MAX_RATE_DEG_S, le=MAX_RATE_DEG_S)]
Rate: TypeAlias = Annotated[list[AxisRate], Field(min_length=3, max_length=3)]
"""Body rate in the sensor frame, degrees per second."""

Turn: TypeAlias = Annotated[float, Field(ge=-360.0, le=360.0)]
"""Right ascension or roll, degrees."""

SegmentSeconds: TypeAlias = Annotated[float, Field(gt=0.0, le=1e9)]


class Strict(BaseModel):
    """Base of configuration models: rejects unknown keys, numbers in quotes and non-finite numbers."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, strict=True)


class AttitudeConfig(Strict):
    """An attitude: right ascension, declination and roll in degrees, or a quaternion."""

    ra_deg: Turn | None = None
    """Right ascension of the boresight."""
    dec_deg: Annotated[float, Field(ge=-90.0, le=90.0)] | None = None
    """Declination of the boresight."""
    roll_deg: Turn | None = None
    """Angle by which celestial north is turned counter-clockwise in the image; 0 if left out."""
    quaternion_xyzw: Annotated[list[float], Field(min_length=4, max_length=4)] | None = None
    """Quaternion ICRS to sensor, scalar last, of length 1; in place of the angles."""

    @model_validator(mode="after")
    def _one_form(self) -> Self:
        angles = (self.ra_deg, self.dec_deg, self.roll_deg)
        if self.quaternion_xyzw is not None:
            if any(angle is not None for angle in angles):
                raise ValueError("give ra_deg, dec_deg, roll_deg or quaternion_xyzw, not both")
            if abs(math.hypot(*self.quaternion_xyzw) - 1.0) > 0.01:
                raise ValueError("quaternion_xyzw is not of length 1")
        elif self.ra_deg is None or self.dec_deg is None:
            raise ValueError("give ra_deg and dec_deg (roll_deg is 0 if left out), or quaternion_xyzw")
        return self

    def build(self) -> Attitude:
        """Make the attitude."""
        if self.quaternion_xyzw is not None:
            return Attitude(np.array(self.quaternion_xyzw))
        return Attitude.from_radec_roll(self.ra_deg or 0.0, self.dec_deg or 0.0, self.roll_deg or 0.0)


DEFAULT_ATTITUDE = AttitudeConfig(ra_deg=83.8, dec_deg=-1.2, roll_deg=0.0)
"""Orion: bright stars, and easy to recognise in an image."""


class FixedConfig(Strict):
    """An attitude that does not change."""

    kind: Literal["fixed"]
    """Which truth source this is."""
    attitude: AttitudeConfig = DEFAULT_ATTITUDE
    """The attitude."""

    def build(self, now_s: float, folder: Path) -> TruthSource:  # noqa: ARG002 (one signature for all)
        """Make the source."""
        return FixedTruth(self.attitude.build())


class RateConfig(Strict):
    """A rotation at a constant body rate, starting from an attitude."""

    kind: Literal["rate"]
    """Which truth source this is."""
    attitude: AttitudeConfig = DEFAULT_ATTITUDE
    """Attitude at the start."""
    rate_deg_s: Rate
    """Body rate about x, y and z of the sensor frame."""

    def build(self, now_s: float, folder: Path) -> TruthSource:  # noqa: ARG002 (one signature for all)
        """Make the source; the rotation begins now."""
        return RateTruth(self.attitude.build(), np.radians(self.rate_deg_s), start_s=now_s)


class HoldConfig(Strict):
    """Hold the attitude for a time."""

    do: Literal["hold"]
    """Which segment this is."""
    seconds: SegmentSeconds
    """How long."""

    def build(self) -> Segment:
        """Make the segment."""
        return HoldSegment(self.seconds)


class TurnConfig(Strict):
    """Rotate at a constant body rate for a time."""

    do: Literal["rate"]
    """Which segment this is."""
    seconds: SegmentSeconds
    """How long."""
    rate_deg_s: Rate
    """Body rate about x, y and z of the sensor frame."""

    def build(self) -> Segment:
        """Make the segment."""
        return RateSegment(self.seconds, np.radians(self.rate_deg_s))


class SlewToConfig(Strict):
    """Slew about one axis to an attitude, from rest to rest."""

    do: Literal["slew"]
    """Which segment this is."""
    to: AttitudeConfig
    """Attitude at the end."""
    max_rate_deg_s: Annotated[float, Field(ge=1e-6, le=100.0)]
    """Highest body rate."""
    shape: Literal["smooth", "limited"] = "smooth"
    """Rate over time: `smooth` (no jump in acceleration), or `limited` (constant acceleration, constant rate, constant deceleration)."""
    acceleration_deg_s2: Annotated[float, Field(ge=1e-6, le=1e6)] = 0.1
    """Acceleration of `limited`."""

    def build(self) -> Segment:
        """Make the segment."""
        return SlewSegment(
            self.to.build(),
            math.radians(self.max_rate_deg_s),
            self.shape,
            math.radians(self.acceleration_deg_s2),
        )


SegmentConfig: TypeAlias = Annotated[HoldConfig | TurnConfig | SlewToConfig, Field(discriminator="do")]


class SlewConfig(Strict):
    """A sequence of holds, constant rates and slews."""

    kind: Literal["slew"]
    """Which truth source this is."""
    attitude: AttitudeConfig = DEFAULT_ATTITUDE
    """Attitude at the start."""
    segments: Annotated[list[SegmentConfig], Field(min_length=1)]
    """Segments, one after the other."""
    repeat: bool = False
    """Begin again after the last segment."""

    def build(self, now_s: float, folder: Path) -> TruthSource:  # noqa: ARG002 (one signature for all)
        """Make the source; the first segment begins now."""
        segments = [segment.build() for segment in self.segments]
        return SlewTruth(self.attitude.build(), segments, start_s=now_s, repeat=self.repeat)


class FileConfig(Strict):
    """A table of times and attitudes; a relative path refers to the profile's folder."""

    kind: Literal["file"]
    """Which truth source this is."""
    path: str
    """CSV file of times and attitudes."""
    start: Literal["run", "now"] = "run"
    """Time zero of the file: the start of the run, or the time at which the source is set."""
    repeat: bool = False
    """Begin again after the last row."""

    def build(self, now_s: float, folder: Path) -> TruthSource:
        """Read the file."""
        start_s = now_s if self.start == "now" else 0.0
        return read_truth_file(folder / self.path, start_s=start_s, repeat=self.repeat)


class LiveConfig(Strict):
    """A feed of JSON lines in the format of `starhil.emulator.truth.live`."""

    kind: Literal["live"]
    """Which truth source this is."""
    protocol: Literal["udp", "tcp"] = "udp"
    """Transport of the feed."""
    host: str = "127.0.0.1"
    """Address to listen at."""
    port: Annotated[int, Field(ge=0, le=65535)] = 0
    """Port to listen at; 0 takes a free one, which the ready line names."""
    stale_s: Annotated[float, Field(gt=0.0, le=3600.0)] = 1.0
    """Silence after which the attitude stands still and is flagged `stale`."""
    timeline: Literal["anchor", "run"] = "anchor"
    """What `t` of a message means: `anchor` ties the first message to its arrival, `run` takes `t` as seconds of simulation time."""
    attitude: AttitudeConfig = DEFAULT_ATTITUDE
    """Attitude before the first message."""

    def build(self, now_s: float, folder: Path) -> TruthSource:  # noqa: ARG002 (one signature for all)
        """Make the source; the emulation opens its socket."""
        return LiveTruth(self.attitude.build(), stale_s=self.stale_s, timeline=self.timeline)


TruthConfig: TypeAlias = Annotated[
    FixedConfig | RateConfig | SlewConfig | FileConfig | LiveConfig, Field(discriminator="kind")
]
