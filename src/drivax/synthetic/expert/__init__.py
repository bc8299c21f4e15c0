"""The expert that drives ego: candidate paths, speed search, smoothing and checks.

``plan`` chooses the path and its speeds (``speed_search``), which ``smoothing`` makes comfortable; ``driver`` drives.
"""
