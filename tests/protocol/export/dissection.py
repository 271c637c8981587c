"""Recordings of a CAN bus as Wireshark's CANopen dissector reads them (tshark)."""

from __future__ import annotations

import shutil
import subprocess
from dataclasses import dataclass
from pathlib import Path

import pytest

from tests.waiting import PATIENCE_S

FIELDS = ("can.id", "can.flags.xtd", "frame.protocols", "_ws.malformed", "_ws.col.Info")


@dataclass(frozen=True)
class Dissected:
    """One frame: its identifier, whether it has 29 bits, what it was read as, and whether it is malformed."""

    identifier: int
    extended: bool
    protocols: tuple[str, ...]
    malformed: bool
    words: str


def dissect(recording: Path) -> list[Dissected]:
    """Dissect a candump log; the test is skipped where tshark is not installed."""
    tshark = shutil.which("tshark")
    if tshark is None:
        pytest.skip("tshark is not installed; it dissects recordings (Debian package tshark)")
    command = [tshark, "-r", str(recording), "-d", "can.subdissector,canopen", "-T", "fields"]
    for field in FIELDS:
        command += ["-e", field]
    done = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE_S, check=True)
    frames = []
    for line in done.stdout.splitlines():
        identifier, extended, protocols, malformed, words = line.split("\t")
        frames.append(
            Dissected(
                int(identifier),
                extended in ("1", "True"),
                tuple(protocols.split(":")),
                bool(malformed),
                words,
            )
        )
    return frames
