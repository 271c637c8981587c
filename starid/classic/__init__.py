"""Published star identification algorithms, each in its own module, behind the interface of all identifiers."""
