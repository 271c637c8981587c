"""`starhil cache`: show, fill and clear the cache of computed files."""

from __future__ import annotations

import asyncio
import json
import time
from dataclasses import replace

import typer

from starhil.emulator.cli.options import ProfileArgument
from starhil.emulator.cli.output import report_slow_start
from starid.cli.options import AsJson

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
) -> None:
    """Compile the kernels and build the star index, as the first start of a profile does.

    Progress is shown on stderr. Kernels are the same for all profiles; the star index depends on the camera and the
    parameters.
    """
    from starhil.emulator.device.device import adopt_camera, profile_defaults
    from starhil.emulator.device.parameters import Parameters
    from starhil.emulator.profile import DEFAULT_PROFILE, load_profile
    from starhil.emulator.profile.pipeline_setup import pipeline_setup
    from starhil.emulator.sensor.pipeline.client import WorkerClient
    from starhil.emulator.sensor.pipeline.messages import IndexRequest, SolverSettings, camera_constants
    from starhil.emulator.sensor.pipeline.worker_process import WorkerProcess
    from starhil.protocol.unit import load_unit
    from starid.storage.cache import cache_dir, kernels_written_since

    begin_s = time.time()
    loaded = load_profile(profile or DEFAULT_PROFILE)
    icd = load_unit(loaded.unit_source)
    parameters = Parameters(icd, profile_defaults(loaded, icd))
    setup = pipeline_setup(loaded)
    setup = replace(setup, previews=True, sky={"bodies": "ephemeris"})  # these have kernels of their own

    async def start() -> None:
        imager = WorkerClient(setup, WorkerProcess())
        progress = asyncio.create_task(report_slow_start())
        try:
            adopt_camera(parameters, loaded, camera_constants((await imager.start()).camera))
            imager.prepare(IndexRequest(SolverSettings.of(parameters)))
            await imager.settle()
        finally:
            progress.cancel()
            await imager.close()

    asyncio.run(start())
    print(
        f"{kernels_written_since(begin_s)} kernels compiled in {time.time() - begin_s:.1f} s, in {cache_dir()}"
    )


@group.command("clear")
def clear() -> None:
    """Remove all cached files; they are computed again when needed."""
    from starid.storage.cache import BYTES_PER_MB, cache_dir, cached_files, remove

    files = cached_files()
    removed = [each for each in files if remove(each)]
    megabytes = sum(each.size for each in removed) / BYTES_PER_MB
    print(f"removed {len(removed)} of {len(files)} files, {megabytes:.1f} MB, from {cache_dir()}")
    raise typer.Exit(0 if len(removed) == len(files) else 1)
