"""The compiled core of planning: machine code by numba, kept in its cache on this machine."""
