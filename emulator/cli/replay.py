"""`starhil replay`: play a recorded run again, and compare."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Annotated

import typer


def command(
    folder: Annotated[Path, typer.Argument(help="Folder written by starhil run --record.")],
    json_output: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> int:
    """Play a recorded run on the stepped clock, and compare what the device sends and measures, byte by byte.

    Exit status 0 if all is equal, 1 if anything differs.
    """
    import asyncio
    import json

    from starhil.emulator.replay import replay

    report = asyncio.run(replay(folder))
    if json_output:
        print(json.dumps(dataclasses.asdict(report)))
    else:
        units = {"serial": "bytes"}
        for link, count in report.sent.items():
            print(f"{link}: {count} {units.get(link, 'frames')} sent")
        print(f"{report.entries} entries played: {'; '.join(report.differences) or 'identical'}")
    return 1 if report.differences else 0
