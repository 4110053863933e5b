"""A score board for controllers: a fixed set of flights, what is measured of each, and how that becomes one number."""
