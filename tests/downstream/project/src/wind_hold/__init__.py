"""Hold a place in wind, and survey one."""
