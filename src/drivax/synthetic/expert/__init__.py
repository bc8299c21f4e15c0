"""The expert that drives ego: plan, reservations, smoothing and checks."""
