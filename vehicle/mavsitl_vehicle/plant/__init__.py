"""The plant: rotors (eqs 1-5), rigid body (eqs 6-13), ground contact, and the compiled step over a fleet."""
