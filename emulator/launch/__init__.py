"""The ways to start a run: for a user, from a recording, in memory."""

from starhil.emulator.launch.emulator import (
    ConsoleOptions,
    Emulator,
    RunOptions,
    path_of_head,
    with_own_seeds,
)

__all__ = ["ConsoleOptions", "Emulator", "RunOptions", "path_of_head", "with_own_seeds"]
