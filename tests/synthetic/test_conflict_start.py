from __future__ import annotations

import numpy as np
import pytest

from drivax.scenario.schema import CURRENT_STEP, STEPS
from drivax.synthetic.events.conflict_start import critical_steps
from drivax.synthetic.roads.network import Control
from drivax.synthetic.roads.signals import Colour

from .traffic_scenes import crossroads, run, twins

#: The middle of the crossing roads, and lanes east: before it, across it, beyond it.
MIDDLE, EAST, NORTH = 110.0, (0, 1, 2), (3, 4, 5)
SPEED = 10.0


def moved(at, speeds=(SPEED, SPEED), ways=(EAST, NORTH)):
    """Vehicles at constant speeds; the first one is ego."""
    network = crossroads()
    seconds = 2 * STEPS / 10
    motion = run(network, ways, twins(len(at)), at, speeds, seconds)
    times = np.arange(motion.xy.shape[1]) / 10
    for row, (begin, speed) in enumerate(zip(at, speeds, strict=True)):
        path = motion.paths[row]
        distance = begin + speed * times
        motion.distance_m[row] = distance
        motion.speed[row] = speed
        motion.valid[row] = distance < path.length_m
        sample = np.minimum((distance / path.step_m).astype(int), len(path.curve.xy) - 1)
        motion.xy[row], motion.heading[row] = path.curve.xy[sample], path.curve.heading[sample]
    colour = np.zeros((len(times), len(network.lanes)), np.int8)
    return network, motion, colour


def critical(network, motion, colour, steps=(0,)):
    return critical_steps(network, motion, colour, np.array(steps)).tolist()


def test_simultaneous_crossing_is_critical_and_earlier_one_is_not():
    # Ego reaches the middle 5 s after the start, so do others who are as far away and as fast.
    together = moved((60.0, 60.0))
    assert critical(*together) == [True]
    passed = moved((40.0, 90.0))
    assert critical(*passed) == [False]


def test_steps_are_evaluated_independently():
    # Ego and the other vehicle cross after 5 s: a driver that takes over 4 s before collides, one that takes over
    # after the crossing does not.
    network, motion, colour = moved((60.0, 60.0))
    assert critical(network, motion, colour, (0, 70 - CURRENT_STEP)) == [True, False]


def test_reference_driver_follows_its_leader():
    leader = moved((30.0, 50.0), (SPEED, 3.0), (EAST, EAST))
    assert critical(*leader) == [False]


def test_collisions_from_behind_do_not_count():
    tail = moved((40.0, 20.0), (2.0, 14.0), (EAST, EAST))
    assert critical(*tail) == [False]


@pytest.mark.parametrize(
    ("shown", "hit"), [(Colour.RED, False), (Colour.YELLOW, False), (Colour.GREEN, True)]
)
def test_reference_driver_stops_for_red_and_yellow(shown, hit):
    network, motion, colour = moved((60.0, 60.0))
    network = crossroads(control=[Control.SIGNAL, Control.SIGNAL])
    colour[:, EAST[1]] = shown
    assert critical(network, motion, colour) == [hit]


def test_empty_road_is_not_critical():
    network, motion, colour = moved((60.0,), (SPEED,), (EAST,))
    assert critical(network, motion, colour, (0, 10, 20)) == [False, False, False]
