"""Benchmarks and campaigns: accuracy against its bound, and the speed of stages, links and solvers."""
