"""Station: a microcontroller-in-the-loop control station that finds out what its simulation gets wrong."""

__version__ = "0.1.0"
