"""Endurance runs: a random life of a unit, generated from a seed and judged by an oracle that knows only its bus."""
