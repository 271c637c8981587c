"""What the parts of a head report to each other. All signals of a head are declared here.

::

    cycle ──exposed──► images              cycle ──frame_published──► device, subscriptions, CANopen, logs, console
    modes ──mode_changed──► device, subscriptions, CANopen, head, console
    parameters ──parameters_changed──► device, subscriptions, links
    device ──started──► subscriptions, serial link          device ──restarted──► links, head, revival of the pipeline
    subscriptions ──rows_due──► requests    requests ──unsolicited──► links
    faults ──faults_changed──► recording, console    requests ──executed──► events of console and recording

Two parts that do not depend on the device have signals elsewhere: `Scheduler.added` wakes a sleeping pump, and
`SensorPipeline.ended` starts the pipeline again.

The sender changes its own state before it reports. Observers are called in any order, except those that connect as
`first`: the device, so that every other part finds it up to date, and the message numbers of the serial link, which
restart before the rows that report a start are sent.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from starhil.emulator.device.measurement import Measurement
from starhil.emulator.device.modes import Transition
from starhil.emulator.simulation.signal import Signal
from starhil.protocol.icd.codec import Row
from starhil.protocol.messages import ErrorCode, Reply, Request


@dataclass(frozen=True)
class Executed:
    """A telecommand was executed or refused."""

    request: Request
    row: Row | None
    """None: there is no such telecommand."""
    code: ErrorCode
    console: bool
    """Whether it came on the line of console and recording."""


@dataclass(frozen=True)
class Signals:
    """The signals of a head."""

    exposed: Signal[int] = field(default_factory=lambda: Signal("exposure"))
    """An exposure was sent to the pipeline; its index."""
    frame_published: Signal[Measurement] = field(default_factory=lambda: Signal("frame"))
    mode_changed: Signal[Transition] = field(default_factory=lambda: Signal("mode"))
    parameters_changed: Signal[frozenset[str]] = field(default_factory=lambda: Signal("parameters"))
    """Parameters have other values; their names."""
    started: Signal[str] = field(default_factory=lambda: Signal("start"))
    """The device was switched on or reset, and has set parameters and time; the cause."""
    restarted: Signal[str] = field(default_factory=lambda: Signal("reset"))
    """A reset is complete; the cause."""
    executed: Signal[Executed] = field(default_factory=lambda: Signal("telecommand"))
    rows_due: Signal[Sequence[Row]] = field(default_factory=lambda: Signal("unsolicited rows"))
    """Telemetry rows of one moment are due to be sent unsolicited, in this order."""
    faults_changed: Signal[dict[str, Any]] = field(default_factory=lambda: Signal("faults"))
    """Faults were injected, as requested, or all were ended: {}."""
    unsolicited: Signal[Reply] = field(default_factory=lambda: Signal("unsolicited telemetry"))
    """A message for every link."""
