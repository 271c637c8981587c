"""Control of a run from outside: faults, scenarios and the control channel."""
