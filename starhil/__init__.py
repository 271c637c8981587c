"""A star-sensor emulator for hardware-in-the-loop tests.

In the repository the sub-packages are links to the folders at its top level; an installed package holds them
itself.
"""
