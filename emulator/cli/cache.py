"""`starhil cache`: show, fill and clear the cache of computed files."""

from __future__ import annotations

import asyncio
import json
import logging
import time
from typing import TYPE_CHECKING

import typer

from starhil.emulator.cli.options import OrbitChoice, ProfileArgument, UnitChoice, absolute_unit, with_orbit
from starid.cli.options import AsJson
from starid.cli.output import compiling_reported

if TYPE_CHECKING:
    from starhil.emulator.profile import Profile

log = logging.getLogger("starhil.run")

group = typer.Typer(
    help="Show, fill or clear the cache of star catalogues, indices, databases and machine code of kernels."
)


@group.callback(invoke_without_command=True)
def command(context: typer.Context) -> None:
    """Show, fill or clear the cache of star catalogues, indices and databases; without a command: info."""
    if context.invoked_subcommand is None:
        info()


@group.command("info")
def info(as_json: AsJson = False) -> None:
    """Show the folder, size, limit and files of the cache.

    Above the limit, the least recently used files are removed. The environment variables STARHIL_CACHE_DIR
    and STARHIL_CACHE_LIMIT_MB set the folder and the limit.
    """
    from starid.storage.cache import BYTES_PER_MB, cache_dir, cached_files, size_limit

    files = cached_files()
    total = sum(each.size for each in files)
    if as_json:
        rows = [{"name": each.name, "bytes": each.size, "used_unix_s": each.used_s} for each in files]
        content = {"folder": str(cache_dir()), "bytes": total, "limit_bytes": size_limit(), "files": rows}
        print(json.dumps(content))
        return
    for each in reversed(files):
        used = time.strftime("%Y-%m-%d %H:%M", time.localtime(each.used_s))
        print(f"{each.size / BYTES_PER_MB:8.1f} MB  {used}  {each.name}")
    limit = size_limit() / BYTES_PER_MB
    print(f"{total / BYTES_PER_MB:8.1f} MB of {limit:g} MB in {len(files)} files in {cache_dir()}")


@group.command("warm")
def warm(
    profile: ProfileArgument = None,
    orbit: OrbitChoice = None,
    unit: UnitChoice = None,
) -> None:
    """Compile the kernels and build the star index, as the first start of a profile does.

    Without a profile or a unit: for all bundled profiles, and for all bundled units on the default profile.
    Progress is shown on stderr.
    """
    from starhil.emulator.profile import DEFAULT_PROFILE, load_profile
    from starhil.emulator.run import Run
    from starhil.protocol.files.bundled import bundled, bundled_units
    from starid.storage.cache import cache_dir, kernels_written_since

    begin_s = time.time()
    targets = [(profile or DEFAULT_PROFILE, unit and absolute_unit(unit))]
    if profile is unit is None:
        targets += [(name, None) for name in bundled("profile") if name != DEFAULT_PROFILE]
        targets += [(DEFAULT_PROFILE, name) for name in bundled_units()]
    fixed = [
        "run.clock=stepped",
        "run.worker=thread",
        "links.serial.port=off",
        "links.can.channel=off",
        "links.canopen.node=0",
    ]
    profiles = [
        load_profile(
            name, with_orbit([*fixed, "run.state_dir=", *([] if of is None else [f"unit={of}"])], orbit)
        )
        for name, of in targets
    ]

    async def start(loaded: Profile) -> None:
        run = Run([loaded], previews=True)
        with compiling_reported(start=True):
            try:
                await run.open()
                run.begin()
                await run.ready()
            finally:
                await run.close()

    for number, each in enumerate(profiles, 1):
        log.info("%d of %d: %s, unit %s", number, len(profiles), each.name, each.unit_source)
        asyncio.run(start(each))
    print(f"{kernels_written_since(begin_s)} kernels added to {cache_dir()} in {time.time() - begin_s:.1f} s")


@group.command("clear")
def clear() -> None:
    """Remove all cached files; they are computed again when needed."""
    from starid.storage.cache import BYTES_PER_MB, cache_dir, cached_files, remove

    files = cached_files()
    removed = [each for each in files if remove(each)]
    megabytes = sum(each.size for each in removed) / BYTES_PER_MB
    print(f"removed {len(removed)} of {len(files)} files, {megabytes:.1f} MB, from {cache_dir()}")
    raise typer.Exit(0 if len(removed) == len(files) else 1)
