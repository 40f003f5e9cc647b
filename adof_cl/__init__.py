"""Adaptive depth of field: compute, loop, twin and command line. See ARCHITECTURE.md for the file map.

Imports nothing, so that `optics` and `reference` work on a machine without OpenCL.
"""

__version__ = "0.1.0"
