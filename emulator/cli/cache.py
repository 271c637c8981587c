"""`starhil cache`: show and clear the cache of computed files."""

from __future__ import annotations

import json
import time

import typer

from starhil.emulator.cli.options import AsJson

group = typer.Typer(
    help="Show or clear the cache of star catalogues, indices, databases and machine code of kernels."
)


@group.callback(invoke_without_command=True)
def command(context: typer.Context) -> None:
    """Show or clear the cache of star catalogues, indices and databases; without a command: info."""
    if context.invoked_subcommand is None:
        info()


@group.command("info")
def info(as_json: AsJson = False) -> None:
    """Show the folder, size, limit and files of the cache.

    Above the limit, the least recently used files are removed. The environment variables STARHIL_CACHE_DIR
    and STARHIL_CACHE_LIMIT_MB set the folder and the limit.
    """
    from starid.cache import BYTES_PER_MB, cache_dir, cached_files, size_limit

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


@group.command("clear")
def clear() -> None:
    """Remove all cached files; they are computed again when needed."""
    from starid.cache import BYTES_PER_MB, cache_dir, cached_files, remove

    files = cached_files()
    removed = [each for each in files if remove(each)]
    megabytes = sum(each.size for each in removed) / BYTES_PER_MB
    print(f"removed {len(removed)} of {len(files)} files, {megabytes:.1f} MB, from {cache_dir()}")
    raise typer.Exit(0 if len(removed) == len(files) else 1)
