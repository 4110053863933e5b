"""Simulated sensors, and the filter over them: what the vehicle flies by with `estimator.kind = "ekf"`."""
