"""What acts on a run from outside: faults, scenarios and the control channel."""
