"""The guard against getting slower: counts and ratios that mean the same on a busy machine."""
