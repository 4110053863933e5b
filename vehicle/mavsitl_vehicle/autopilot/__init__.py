"""The autopilot: what PX4's commander, controllers and MAVLink module do, as pure step functions."""
