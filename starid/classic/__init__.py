"""Published star identification algorithms, each in a module of its own, behind the interface of all identifiers."""
