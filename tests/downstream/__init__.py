"""mavsitl as its users have it: from its wheel, in an environment of their own."""
