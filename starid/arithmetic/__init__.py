"""Arrays and the arithmetic on them whose results are the same bytes on each processor."""
