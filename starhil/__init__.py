"""A star-sensor emulator for hardware-in-the-loop tests.

In the repository, the subpackages are symbolic links to top-level folders; an installed package contains the
folders.
"""
