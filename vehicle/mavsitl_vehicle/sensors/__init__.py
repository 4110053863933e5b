"""Simulated sensors, and the filter that makes the vehicle's state of them: what `estimator.kind = "ekf"` flies with."""
