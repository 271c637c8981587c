"""`python -m starhil` is the command `starhil`."""

from starhil.emulator.cli import main

if __name__ == "__main__":
    main()
