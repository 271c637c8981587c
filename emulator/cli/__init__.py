"""The command line: one module a command, imported lazily where it is heavy."""
