"""What both kinds of Argoverse 2 recordings share: their car, and what can be in a log."""

from __future__ import annotations

DATASET = "av2"
#: The recording car, a Ford Fusion: length, width and height of its box in the sensor logs, metres.
EGO_SIZE = (4.877, 2.0, 1.473)
#: Its poses are those of the middle of the rear axle, one wheel radius above ground. On the real logs the axis that
#: does not slip sideways in turns is within 0.3 m of the pose, and the map 0.33 m below it. The body's middle is half
#: the wheelbase of 2.85 m ahead, less 0.09 m, because the rear overhang is longer than the front one.
CENTRE_AHEAD_M = 1.34
AXLE_HEIGHT_M = 0.33
#: Limits of what can be in a log: city coordinates in metres, speeds in m/s, sizes in metres, tracks times steps.
FARTHEST_M, FASTEST_MPS, LARGEST_M, MOST_STATES = 1e6, 200.0, 100.0, 2_000_000
