"""The machine on which a recording is made: what may change the last digits of a computed value."""

from __future__ import annotations

import importlib.metadata
import os
import platform
from collections.abc import Mapping
from pathlib import Path
from typing import Final

PROCESSOR_FILE: Final = Path("/proc/cpuinfo")
"""Describes the processor; it may be hidden, as by `ProcSubset=pid` of systemd."""

_VECTORS: Final = ("avx512f", "avx2", "sse4_2", "asimd")
"""Flags of the widest vector instructions of a processor, widest first."""


def description() -> dict[str, str]:
    """Return processor, and versions of Python, numpy, numba and libc, by name."""
    library, version = platform.libc_ver()
    return {
        "processor": _processor(),
        "python": platform.python_version(),
        "numpy": importlib.metadata.version("numpy"),
        "numba": importlib.metadata.version("numba"),
        "libc": f"{library} {version}".strip(),
    }


def _processor() -> str:
    """Return model, architecture and vectors of the processor, and the one that numba compiles for if it is set."""
    try:
        lines = PROCESSOR_FILE.read_text(encoding="ascii", errors="replace").splitlines()
    except OSError:
        lines = []
    fields = {
        name.strip().lower(): value.strip() for name, _, value in (line.partition(":") for line in lines)
    }
    flags = fields.get("flags", fields.get("features", "")).split()
    vectors = next((each for each in _VECTORS if each in flags), "")
    target = os.environ.get("NUMBA_CPU_NAME", "")
    parts = (
        fields.get("model name", ""),
        platform.machine(),
        vectors,
        f"kernels for {target}" if target else "",
    )
    return ", ".join(part for part in parts if part)


def other_machine(recorded: Mapping[str, str]) -> str:
    """Return how the machine of a recording differs from this one; empty if it does not, or is not in the recording."""
    here = description()
    changed = [
        f"{name} {was} (here {here[name]})"
        for name, was in recorded.items()
        if name in here and here[name] != was
    ]
    return f"recorded on another machine: {', '.join(changed)}" if changed else ""
