"""mavsitl: a MAVLink software-in-the-loop bridge."""

__version__ = "0.1.0"
