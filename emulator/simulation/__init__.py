"""Time and events, what may fail without ending a run, and the base of configuration models."""
