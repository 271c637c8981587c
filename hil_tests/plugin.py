"""Pytest plugin of the bench: fixtures that put a star sensor, emulated or real, on a bus."""

from __future__ import annotations
