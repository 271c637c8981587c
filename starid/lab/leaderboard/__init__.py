"""Star identification solvers, ours and others, on the same scenes."""
