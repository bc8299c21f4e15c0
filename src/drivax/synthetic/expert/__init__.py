"""The expert that drives ego: candidate paths, speed search, smoothing and checks."""
