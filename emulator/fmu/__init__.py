"""The star tracker as a Functional Mock-up Unit: its variables, its description, and a shell in C."""
