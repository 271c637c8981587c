"""A run: one clock, one truth, one or several heads, and what drives, disturbs and records them."""

from starhil.emulator.run.run import Run

__all__ = ["Run"]
