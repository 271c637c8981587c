"""Benchmarks of the picture: accuracy of centroids against their bound, and speed stage by stage."""
