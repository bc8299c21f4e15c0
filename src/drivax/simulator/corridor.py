"""Who is in the way of vehicles on their paths: the nearest of the 8 closest things in each one's corridor.

All R vehicles of a scenario at once. Of all S things, comparing boxes with three rectangles around the path ahead
leaves those that are in the corridor or hardly beside it; the 8 closest of them are found by eight minima over whole
numbers (a sort costs several times as much), and only these are measured against the path.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from drivax.geometry.boxes import COS, LENGTH, SIN, WIDTH, X, Y
from drivax.geometry.vectors import first_smallest
from drivax.scenario.agent_paths import PATH_COS, PATH_POINTS, PATH_SIN, PATH_SPEED, AgentPaths
from drivax.scenario.queries import LEVEL_M
from drivax.scenario.record import record
from drivax.simulator.types import Frame

#: How many things are measured against a path.
CLOSEST = 8
#: Free space that a corridor has beside the vehicle, m.
SIDE_M = 0.1
#: Pieces that stand for the path ahead, and rectangles around as many of them each.
PIECES, RECTANGLES = 12, 3
#: How far the path may run beside its pieces, m: rectangles are so much wider.
_BULGE_M = 0.5
#: Things so far behind the vehicle are among the closest too, for those that wait for a place to appear in, m.
BEHIND_M = 1.0
#: How far a vehicle looks: this, what it drives in so many seconds, what it needs to stop with 3 m/s2; at most so far.
_LOOK_M, _LOOK_S, _LOOK_MPS2, _LOOK_MOST_M = 20.0, 1.5, 3.0, 120.0
#: Gap of a free road, m; a number, so that gradients stay finite.
FREE_M = 1e4
#: The low bits of a key hold the thing, the others its squared distance, to within 0.03 %.
_SLOT_BITS = 10
_NONE = 2**31 - 1


@record
class Movers:
    """R vehicles on their paths.

    Attributes:
        box: x, y, cos, sin, length, width.
        z: Height of the box centre, m.
        arc: Place along the path, m.
        speed: m/s.
        slot: Slot of the frame.
        ignored: Slots of things that do not count, -1 for none.
    """

    box: Float[Array, "R 6"]
    z: Float[Array, " R"]
    arc: Float[Array, " R"]
    speed: Float[Array, " R"]
    slot: Int[Array, " R"]
    ignored: Int[Array, "R 2"]


@record
class Leaders:
    """What R vehicles have ahead of them.

    Attributes:
        gap: Free path up to the nearest thing in the corridor, bumper to bumper, m; 10 km where there is none.
        speed: Speed of that thing along the path, m/s.
        things: Slots of the closest things around the corridor.
        real: Whether there is one.
    """

    gap: Float[Array, " R"]
    speed: Float[Array, " R"]
    things: Int[Array, "R 8"]
    real: Bool[Array, "R 8"]


def path_rows(paths: AgentPaths, index: Int[Array, ""], arc: Float[Array, " R"]) -> Float[Array, "R 6"]:
    """Pose (x, y, z, cos, sin) and highest speed at arc lengths of a scenario's paths."""
    at = arc / paths.spacing[index]
    low = jnp.clip(at.astype(jnp.int32), 0, PATH_POINTS - 2)
    row = jnp.arange(arc.shape[0])
    part = jnp.clip(at - low, 0.0, 1.0)[:, None]
    here = paths.points[index, row, low] * (1 - part) + paths.points[index, row, low + 1] * part
    unit = jax.lax.rsqrt(jnp.maximum(here[:, 3] ** 2 + here[:, 4] ** 2, 1e-9))
    return jnp.stack(
        [here[:, 0], here[:, 1], here[:, 2], here[:, 3] * unit, here[:, 4] * unit, here[:, PATH_SPEED]],
        axis=-1,
    )


def leaders(paths: AgentPaths, index: Int[Array, ""], movers: Movers, frame: Frame) -> Leaders:
    """The nearest thing in the corridor of each vehicle.

    The corridor is as wide as the vehicle and 0.1 m more on either side. A thing is in it when its box, as wide as it
    is across the path, reaches into it and its centre is ahead of the vehicle's; things on another level are not.

    Args:
        paths: Paths of the bank.
        index: Row of the bank.
        movers: The vehicles.
        frame: Everyone now.
    """
    look = _look(movers.speed)
    nodes, tangents, arcs = _path_ahead(paths, index, movers, look)
    things, real = _closest(movers, frame, nodes)
    box, velocity = jax.lax.optimization_barrier((frame.box[things], frame.velocity[things]))
    # Coordinates one by one: pairs of numbers at the end of an array do not vectorise.
    x, y = (nodes[:, None, :, axis] for axis in (X, Y))
    ux, uy = x[..., 1:] - x[..., :-1], y[..., 1:] - y[..., :-1]
    wx, wy = box[:, :, None, X] - x[..., :-1], box[:, :, None, Y] - y[..., :-1]
    part = jnp.clip((ux * wx + uy * wy) / jnp.maximum(ux * ux + uy * uy, 1e-6), 0.0, 1.0)
    apart_x, apart_y = wx - part * ux, wy - part * uy
    part, distance = jax.lax.optimization_barrier((part, apart_x * apart_x + apart_y * apart_y))
    best = first_smallest(distance)[..., None]
    part, distance = (jnp.take_along_axis(one, best, axis=-1)[..., 0] for one in (part, distance))
    row, best = jnp.arange(things.shape[0])[:, None], best[..., 0]
    # Everything about a piece in one row, so that it is read once.
    rows = jnp.concatenate(
        [
            nodes[:, :-1],
            nodes[:, 1:],
            tangents[:, :-1],
            tangents[:, 1:],
            arcs[:, :-1, None],
            arcs[:, 1:, None],
        ],
        -1,
    )
    piece = jax.lax.optimization_barrier(rows[row, best])
    way = piece[..., 2:4] - piece[..., :2]
    long = jnp.sqrt(jnp.maximum(jnp.sum(way * way, axis=-1), 1e-6))
    way = way / long[..., None]
    beside = _cross(way, box[..., :2] - piece[..., :2])
    beside -= _bulge(part, way, piece[..., 4:6], piece[..., 6:8]) * long
    distance = jnp.where((part > 0.0) & (part < 1.0), beside * beside, distance)
    along = piece[..., 8] + part * (piece[..., 9] - piece[..., 8]) - movers.arc[:, None]
    cos = jnp.abs(box[..., COS] * way[..., 0] + box[..., SIN] * way[..., 1])
    sin = jnp.abs(box[..., SIN] * way[..., 0] - box[..., COS] * way[..., 1])
    half_length = cos * box[..., LENGTH] / 2 + sin * box[..., WIDTH] / 2
    half_width = sin * box[..., LENGTH] / 2 + cos * box[..., WIDTH] / 2
    room = movers.box[:, None, WIDTH] / 2 + SIDE_M + half_width
    beyond = (along >= look[:, None]) | ((best == PIECES - 1) & (part >= 1.0))
    inside = real & (distance < room * room) & (along > 0.0) & ~beyond
    gap = jnp.where(inside, along - half_length - movers.box[:, None, LENGTH] / 2, FREE_M)
    nearest = first_smallest(gap)[:, None] == jnp.arange(CLOSEST)
    speed = jnp.sum(jnp.where(nearest, jnp.sum(velocity * way, axis=-1), 0.0), axis=1)
    return Leaders(gap=jnp.min(gap, axis=1), speed=speed, things=things, real=real)


def _cross(a: Float[Array, "... 2"], b: Float[Array, "... 2"]) -> Float[Array, ...]:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def _bulge(
    part: Float[Array, ...],
    way: Float[Array, "... 2"],
    begin: Float[Array, "... 2"],
    end: Float[Array, "... 2"],
) -> Float[Array, ...]:
    """How far to the left of a straight piece the path runs, as a share of its length: the cubic with both tangents."""
    slopes = [
        jnp.clip(_cross(way, tangent) / jnp.maximum(jnp.sum(way * tangent, axis=-1), 0.1), -1.0, 1.0)
        for tangent in (begin, end)
    ]
    return part * (1 - part) * ((1 - part) * slopes[0] - part * slopes[1])


def _look(speed: Float[Array, " R"]) -> Float[Array, " R"]:
    """How far a vehicle looks along its path, m."""
    return jnp.minimum(_LOOK_M + _LOOK_S * speed + speed * speed / (2 * _LOOK_MPS2), _LOOK_MOST_M)


def _path_ahead(
    paths: AgentPaths, index: Int[Array, ""], movers: Movers, look: Float[Array, " R"]
) -> tuple[Float[Array, "R 13 2"], Float[Array, "R 13 2"], Float[Array, "R 13"]]:
    """Points of the path from the one behind the vehicle to as far as it looks, directions and arc lengths."""
    spacing = paths.spacing[index]
    # One point more than it takes, since the first one lies behind.
    stride = jnp.ceil(look / ((PIECES - 1) * spacing)).astype(jnp.int32)
    first = (movers.arc / spacing).astype(jnp.int32)
    place = jnp.clip(first[:, None] + stride[:, None] * jnp.arange(PIECES + 1), 0, PATH_POINTS - 1)
    rows = paths.points[index, jnp.arange(place.shape[0])[:, None], place]
    return rows[..., :2], rows[..., PATH_COS : PATH_SIN + 1], place * spacing[:, None]


def _closest(
    movers: Movers, frame: Frame, nodes: Float[Array, "R 13 2"]
) -> tuple[Int[Array, "R 8"], Bool[Array, "R 8"]]:
    """The 8 closest things whose box reaches into one of the rectangles around the corridor."""
    me = movers.box[:, None]
    behind = me[..., LENGTH] / 2 + BEHIND_M
    near = reaching(frame.box[None], nodes, me[..., WIDTH] / 2 + SIDE_M + _BULGE_M, behind, 0.0, RECTANGLES)
    slot = jnp.arange(frame.valid.shape[0], dtype=jnp.int32)
    near &= frame.valid & (slot != movers.slot[:, None])
    near &= jnp.abs(frame.z - movers.z[:, None]) <= LEVEL_M
    near &= (slot != movers.ignored[:, :1]) & (slot != movers.ignored[:, 1:])
    return closest(near, movers.box, frame.box)


def closest(
    near: Bool[Array, "R S"], me: Float[Array, "R 6"], box: Float[Array, "S 6"]
) -> tuple[Int[Array, "R 8"], Bool[Array, "R 8"]]:
    """Of the boxes that are near the 8 whose centres are the closest; and whether there are as many."""
    slot = jnp.arange(near.shape[1], dtype=jnp.int32)
    dx, dy = box[:, X] - me[:, X : X + 1], box[:, Y] - me[:, Y : Y + 1]
    square = jax.lax.stop_gradient(dx * dx + dy * dy).astype(jnp.float32)
    # Floats that are not negative are ordered like their bits; the low ones give way to the slot.
    bits = jax.lax.bitcast_convert_type(square, jnp.int32)
    # Computed once: without the barrier XLA computes it anew for each of the minima.
    key = jax.lax.optimization_barrier(jnp.where(near, (bits & ~((1 << _SLOT_BITS) - 1)) | slot, _NONE))
    found = [jnp.min(key, axis=1, keepdims=True)]
    for _ in range(CLOSEST - 1):
        found.append(jnp.min(jnp.where(key > found[-1], key, _NONE), axis=1, keepdims=True))
    chosen = jnp.concatenate(found, axis=1)
    real = chosen < _NONE
    return jnp.where(real, chosen & ((1 << _SLOT_BITS) - 1), 0), real


def reaching(
    box: Float[Array, "1 S 6"], nodes: Float[Array, "R K 2"], half: Float[Array, "R 1"], behind: Any, beyond: Any,
    rectangles: int,
) -> Bool[Array, "R S"]:  # fmt: skip
    """Which boxes reach into one of the rectangles along the chords of K points on a path.

    Args:
        box: Boxes.
        nodes: Points on the path.
        half: Half the width of the corridor, m.
        behind: How much further back the first rectangle reaches, m.
        beyond: How much further on the last one reaches, m.
        rectangles: How many; K - 1 is a multiple of it.
    """
    count = (nodes.shape[1] - 1) // rectangles
    found = jnp.zeros((nodes.shape[0], box.shape[1]), bool)
    for number in range(rectangles):
        stretch = nodes[:, number * count : (number + 1) * count + 1]
        back, on = behind if number == 0 else 0.0, beyond if number == rectangles - 1 else 0.0
        found |= _in_rectangle(box, stretch, half, back, on)
    return found


def _in_rectangle(
    box: Float[Array, "1 S 6"],
    nodes: Float[Array, "R K 2"],
    half: Float[Array, "R 1"],
    behind: Any,
    beyond: Any,
) -> Bool[Array, "R S"]:
    chord = nodes[:, -1] - nodes[:, 0]
    long = jnp.sqrt(jnp.maximum(jnp.sum(chord * chord, axis=-1, keepdims=True), 1e-6))
    # Beyond its end a path is one point; there any direction will do.
    chord = jnp.where(long > 1e-2, chord / long, jnp.array([1.0, 0.0]))
    cos, sin = chord[:, :1], chord[:, 1:]
    rest = nodes - nodes[:, :1]
    ahead, left = rest[..., 0] * cos + rest[..., 1] * sin, rest[..., 1] * cos - rest[..., 0] * sin
    near = ahead.min(axis=1, keepdims=True) - half - behind
    far = ahead.max(axis=1, keepdims=True) + half + beyond
    low, high = left.min(axis=1, keepdims=True) - half, left.max(axis=1, keepdims=True) + half
    dx, dy = box[..., X] - nodes[:, :1, 0], box[..., Y] - nodes[:, :1, 1]
    ahead, left = dx * cos + dy * sin, dy * cos - dx * sin
    turn_cos = jnp.abs(box[..., COS] * cos + box[..., SIN] * sin)
    turn_sin = jnp.abs(box[..., SIN] * cos - box[..., COS] * sin)
    deep, wide = box[..., LENGTH] / 2, box[..., WIDTH] / 2
    reach_ahead, reach_left = turn_cos * deep + turn_sin * wide, turn_sin * deep + turn_cos * wide
    inside = (ahead > near - reach_ahead) & (ahead < far + reach_ahead)
    return inside & (left > low - reach_left) & (left < high + reach_left)
