"""How long a test waits for what has to happen: so long that only what never happens takes longer, whatever else the machine does."""

PATIENCE_S = 600.0
