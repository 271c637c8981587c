"""Time and events, and what may fail without ending a run."""
