"""The expert that drives ego: candidate paths, speed plans and checks.

``plan`` chooses the path and its speeds, which ``speed_plan`` searches and smooths; ``driver`` drives.
"""
