"""Compiled loops: how they are compiled, kept and loaded."""
