"""Vehicles in a browser, live or from a run's logs: `mavsitl view`."""
