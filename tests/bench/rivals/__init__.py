"""What the lock-step benchmark runs beside mavsitl; each is two processes over UDP that end at a hover, or fail."""
