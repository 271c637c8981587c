"""The recorders of `--record FILE`: the suffix of the file chooses one. A new recorder is a class and a row here."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final, Protocol

if TYPE_CHECKING:
    from starhil.emulator.console.events import EventLog
    from starhil.emulator.console.obc import ObcConnection
    from starhil.emulator.run.head import Head
    from starhil.emulator.simulation.output_file import OutputFile


class FileRecorder(Protocol):
    """Records a head in a file."""

    file: OutputFile

    def start(self) -> None:
        """Start recording: connect to the signals of the head."""

    async def close(self) -> None:
        """Write what is pending and close the file."""


@dataclass(frozen=True)
class RecorderKind:
    """A kind of file."""

    use: str
    """What the file is for, in the help of the option."""
    make: Callable[[Head, ObcConnection, EventLog, Path, bool], FileRecorder]
    """Makes a recorder for a head, with an OBC on its bus; the flag is whether an existing file is replaced."""
    needs: str = ""
    """Module that it needs of an extra; empty: none."""


def _mcap(head: Head, client: ObcConnection, events: EventLog, path: Path, overwrite: bool) -> FileRecorder:
    from starhil.emulator.console.mcap import McapRecorder

    return McapRecorder(head, client, events, path, overwrite=overwrite)


RECORDERS: Final[Mapping[str, RecorderKind]] = {
    ".mcap": RecorderKind("for Foxglove; extra `mcap`", _mcap, needs="mcap.writer")
}
