"""Published star identification algorithms, one per module, behind a common interface."""
