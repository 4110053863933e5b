"""`mavsitl tune`: a controller's gains, searched on some seeds and judged on others."""
