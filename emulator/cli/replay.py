"""`starhil replay`: replay a recorded run and compare."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Annotated

import typer

from starhil.emulator.cli.options import AsJson


def command(
    folder: Annotated[Path, typer.Argument(help="Folder written by `starhil run --record`.")],
    as_json: AsJson = False,
) -> int:
    """Replay a recorded run on the stepped clock and compare everything that the device sends and measures.

    The exit status is 0 if all bytes are identical, otherwise 1.
    """
    import asyncio
    import json

    from starhil.emulator.replay import replay

    report = asyncio.run(replay(folder))
    if as_json:
        print(json.dumps(dataclasses.asdict(report)))
    else:
        units = {"serial": "bytes"}
        for link, count in report.sent.items():
            print(f"{link}: {count} {units.get(link, 'frames')} sent")
        print(f"{report.entries} entries played: {'; '.join(report.differences) or 'identical'}")
    return 1 if report.differences else 0
