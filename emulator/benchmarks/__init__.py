"""Benchmarks and campaigns: accuracy compared with its bound, and speed of stages, links and solvers."""
