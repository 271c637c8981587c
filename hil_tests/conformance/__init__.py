"""Conformance: cases that test a device, real or emulated, over its links only."""
