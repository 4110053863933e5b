"""The wind: steady, gusts and Dryden turbulence (eqs 14-17, MIL-F-8785C), summed, in world NWU."""
