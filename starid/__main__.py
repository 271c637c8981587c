"""`python -m starid` is the command `starid`."""

from starid.cli import main

if __name__ == "__main__":
    main()
