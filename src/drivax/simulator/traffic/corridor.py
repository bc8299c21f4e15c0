"""Find the leader of each vehicle on its path: the nearest of the 8 closest agents in its corridor.

All R vehicles of a scenario are processed at once. Three rectangles around the path ahead select the boxes in or near
the corridor; eight minima select the 8 closest (a sort is several times slower), and only these are measured against
the path.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import reduce
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from drivax.geometry.boxes import COS, LENGTH, SIN, WIDTH, X, Y
from drivax.scenario.bank.queries import LEVEL_M
from drivax.scenario.bank.smallest import embed_number, first_smallest, number_of
from drivax.scenario.record import record
from drivax.simulator.traffic.agent_paths import PATH_COS, PATH_POINTS, PATH_SIN, AgentPaths
from drivax.simulator.types import Frame

#: Number C of agents measured against a path. Six suffice (docs/log), but eight fill a vector.
CLOSEST = 8
#: Margin of a corridor on either side of the vehicle, m.
SIDE_M = 0.1
#: Straight pieces that approximate the path ahead, and rectangles around equal numbers of pieces.
PIECES, RECTANGLES = 12, 3
#: Largest offset of the path from its pieces, m; widens the rectangles.
_BULGE_M = 0.5
#: Reach of the corridor behind the vehicle, m, for vehicles that wait to appear.
BEHIND_M = 1.0
#: Look-ahead: constant (m), plus travel time (s), plus braking distance at a deceleration (m/s2); maximum (m).
_LOOK_M, _LOOK_S, _LOOK_MPS2, _LOOK_MOST_M = 20.0, 1.5, 3.0, 120.0
#: Gap of a free road, m; finite, so that gradients stay finite.
FREE_M = 1e4
#: Lower bound of the gap of overlapping agents, m.
LEAST_GAP_M = -50.0
#: Low bits of a squared distance that store the slot or piece; the rest is exact to 0.013 % (of at least 1 m2).
SLOT_BITS, _PIECE_BITS = 10, 4


@record
class Movers:
    """R vehicles on their paths."""

    box: Float[Array, "R 6"]  # x, y, cos, sin, length, width
    z: Float[Array, " R"]  # Height of the box centre, m
    arc: Float[Array, " R"]  # Arc length along the path, m
    speed: Float[Array, " R"]  # m/s
    slot: Int[Array, " R"]  # Slot of the frame
    ignored: Int[Array, "R 2"]  # Slots of ignored agents, -1 for none


@record
class Leaders:
    """Leaders of R vehicles, and the agents around their corridors."""

    # Free path to the nearest agent in the corridor, bumper to bumper, m; 10 km if free
    gap: Float[Array, " R"]
    speed: Float[Array, " R"]  # Speed of that agent along the path, m/s; arbitrary if free
    slots: Int[Array, "R C"]  # Slots of the closest agents around the corridor
    valid: Bool[Array, "R C"]  # Mask of valid ``slots``


def path_poses(
    paths: AgentPaths, index: Int[Array, ""], arc: Float[Array, " R"]
) -> tuple[Float[Array, "R 4"], Float[Array, "R 2"]]:
    """Return poses (x, y, cos, sin) at arc lengths of a scenario's paths, and their heights and speed limits."""
    position = arc / paths.spacing[index]
    low = jnp.clip(position.astype(jnp.int32), 0, PATH_POINTS - 2)
    fraction = jnp.clip(position - low, 0.0, 1.0)[:, None]

    def interpolate(table: Float[Array, "N R M F"]) -> Float[Array, "R F"]:
        """Interpolate a table at the arc lengths."""

        def read_ends(row: Array, low: Array) -> Float[Array, "2 F"]:
            """Read the points before and after, which are contiguous."""
            start = (index, row, low, jnp.int32(0))
            return jax.lax.dynamic_slice(table, start, (1, 1, 2, table.shape[-1]))[0, 0]

        ends = jax.vmap(read_ends)(jnp.arange(arc.shape[0], dtype=jnp.int32), low)
        return ends[:, 0] * (1 - fraction) + ends[:, 1] * fraction

    pose = interpolate(paths.points)
    # Interpolation shortens the direction, so normalise it.
    unit = jax.lax.rsqrt(jnp.maximum(pose[:, PATH_COS] ** 2 + pose[:, PATH_SIN] ** 2, 1e-9))
    return pose * jnp.where(jnp.arange(4) >= PATH_COS, unit[:, None], 1.0), interpolate(paths.profile)


def leaders(paths: AgentPaths, index: Int[Array, ""], movers: Movers, frame: Frame) -> Leaders:
    """Return the nearest agent in the corridor of each vehicle.

    The corridor is as wide as the vehicle plus 0.1 m on either side, and ends at the look-ahead distance or the end of
    the path. An agent is in it if its box, projected across the path, reaches into it, its centre is ahead of the
    vehicle's, and it is on the same level.
    """
    look_m = _look_ahead(movers.speed)
    poses, arcs = _path_ahead(paths, index, movers, look_m)
    nodes = poses[..., :2]
    slots, valid = _closest(movers, frame, nodes)
    box, velocity = frame.box[slots], frame.velocity[slots]
    piece = _nearest_piece(nodes, box)
    x0, y0, cos0, sin0, x1, y1, cos1, sin1 = jnp.moveaxis(_both_ends(poses, piece), -1, 0)
    tangents = cos0, sin0, cos1, sin1
    arc, end = (jnp.take_along_axis(arcs, piece + offset, axis=1) for offset in (0, 1))
    fraction, squared_distance = _project_on_piece(x0, y0, x1, y1, box[..., X], box[..., Y])
    length = jnp.sqrt(jnp.maximum((x1 - x0) ** 2 + (y1 - y0) ** 2, 1e-6))
    ux, uy = (x1 - x0) / length, (y1 - y0) / length
    bulge = _bulge(fraction, (ux, uy), tangents) * length
    lateral = ux * (box[..., Y] - y0) - uy * (box[..., X] - x0) - bulge
    squared_distance = jnp.where((fraction > 0.0) & (fraction < 1.0), lateral * lateral, squared_distance)
    along = arc + fraction * (end - arc) - movers.arc[:, None]
    cos = jnp.abs(box[..., COS] * ux + box[..., SIN] * uy)
    sin = jnp.abs(box[..., SIN] * ux - box[..., COS] * uy)
    half_length = cos * box[..., LENGTH] / 2 + sin * box[..., WIDTH] / 2
    half_width = sin * box[..., LENGTH] / 2 + cos * box[..., WIDTH] / 2
    reach = movers.box[:, None, WIDTH] / 2 + SIDE_M + half_width
    is_past = (along >= look_m[:, None]) | ((piece == PIECES - 1) & (fraction >= 1.0))
    is_inside = valid & (squared_distance < reach * reach) & (along > 0.0) & ~is_past
    gap = jnp.where(is_inside, along - half_length - movers.box[:, None, LENGTH] / 2, FREE_M)
    is_leader = first_smallest(gap, least=LEAST_GAP_M)[:, None] == jnp.arange(CLOSEST)
    speed = jnp.sum(jnp.where(is_leader, velocity[..., 0] * ux + velocity[..., 1] * uy, 0.0), axis=1)
    return Leaders(gap=jnp.min(gap, axis=1), speed=speed, slots=slots, valid=valid)


def _nearest_piece(nodes: Float[Array, "R K 2"], box: Float[Array, "R C 6"]) -> Int[Array, "R C"]:
    """Return the index of the piece between two nodes of a path that is nearest to the centre of each box."""
    # Coordinates one by one: pairs of numbers at the end of an array do not vectorise.
    x, y = nodes[..., X, None], nodes[..., Y, None]
    keys = []
    for piece in range(PIECES):
        ends = x[:, piece], y[:, piece], x[:, piece + 1], y[:, piece + 1]
        _, squared_distance = _project_on_piece(*ends, box[..., X], box[..., Y])
        keys.append(embed_number(1.0 + squared_distance, piece, _PIECE_BITS))
    nearest = number_of(reduce(jnp.minimum, keys), _PIECE_BITS)
    # Stored to memory: XLA would otherwise compute it again for each of the columns that are read.
    return jnp.zeros_like(nearest).at[jnp.arange(len(nearest))].set(nearest)


def _both_ends(poses: Float[Array, "R K 4"], first: Int[Array, "R C"]) -> Float[Array, "R C 8"]:
    """Return the poses at two consecutive points of each path, ``first`` and the next, by one contiguous read."""

    def read(path: Float[Array, "K 4"], first: Array) -> Float[Array, " 8"]:
        return jax.lax.dynamic_slice(path, (first, jnp.int32(0)), (2, 4)).reshape(8)

    return jax.vmap(jax.vmap(read, in_axes=(None, 0)))(poses, first)


def _project_on_piece(x0: Any, y0: Any, x1: Any, y1: Any, x: Any, y: Any) -> tuple[Any, Any]:
    """Return the fraction of a piece at which it is nearest to a point, and their squared distance."""
    ux, uy, wx, wy = x1 - x0, y1 - y0, x - x0, y - y0
    fraction = jnp.clip((ux * wx + uy * wy) / jnp.maximum(ux * ux + uy * uy, 1e-6), 0.0, 1.0)
    dx, dy = wx - fraction * ux, wy - fraction * uy
    return fraction, dx * dx + dy * dy


def _bulge(fraction: Any, direction: tuple[Any, Any], tangents: Sequence[Any]) -> Any:
    """Return the path's offset to the left of a straight piece, relative to its length: a cubic with both tangents.

    ``tangents`` are cosine and sine at the start of the piece, then at its end.
    """
    (ux, uy), slopes = direction, []
    for cos, sin in (tangents[:2], tangents[2:]):
        slopes.append(jnp.clip((ux * sin - uy * cos) / jnp.maximum(ux * cos + uy * sin, 0.1), -1.0, 1.0))
    return fraction * (1 - fraction) * ((1 - fraction) * slopes[0] - fraction * slopes[1])


def _look_ahead(speed: Float[Array, " R"]) -> Float[Array, " R"]:
    """Return the look-ahead distance along the path, m."""
    return jnp.minimum(_LOOK_M + _LOOK_S * speed + speed * speed / (2 * _LOOK_MPS2), _LOOK_MOST_M)


def _path_ahead(
    paths: AgentPaths, index: Int[Array, ""], movers: Movers, look_m: Float[Array, " R"]
) -> tuple[Float[Array, "R K 4"], Float[Array, "R K"]]:
    """Return poses on the path from behind the vehicle to its look-ahead distance, and their arc lengths."""
    spacing = paths.spacing[index]
    # PIECES - 1 pieces cover the look-ahead distance, since the first one begins behind the vehicle.
    stride = jnp.ceil(look_m / ((PIECES - 1) * spacing)).astype(jnp.int32)
    first = (movers.arc / spacing).astype(jnp.int32)
    point = jnp.clip(first[:, None] + stride[:, None] * jnp.arange(PIECES + 1), 0, PATH_POINTS - 1)
    poses = paths.points[index, jnp.arange(point.shape[0])[:, None], point]
    return poses, point * spacing[:, None]


def _closest(
    movers: Movers, frame: Frame, nodes: Float[Array, "R K 2"]
) -> tuple[Int[Array, "R C"], Bool[Array, "R C"]]:
    """Return the closest agents whose boxes reach into the rectangles around the corridor."""
    mover = movers.box[:, None]
    behind_m = mover[..., LENGTH] / 2 + BEHIND_M
    box = columns(frame.box)
    is_near = overlaps_rectangles(
        box, nodes, mover[..., WIDTH] / 2 + SIDE_M + _BULGE_M, behind_m, 0.0, RECTANGLES
    )
    slot = jnp.arange(frame.valid.shape[0], dtype=jnp.int32)
    is_near &= frame.valid & (slot != movers.slot[:, None])
    is_near &= jnp.abs(frame.z - movers.z[:, None]) <= LEVEL_M
    is_near &= (slot != movers.ignored[:, :1]) & (slot != movers.ignored[:, 1:])
    return closest(is_near, movers.box, box)


def columns(box: Float[Array, "S 6"]) -> Float[Array, "6 S"]:
    """Transpose boxes by a product with the identity matrix.

    XLA folds a plain transposition into its consumers, which then read with strides.
    """
    identity = jnp.eye(box.shape[1], dtype=box.dtype)
    return jnp.einsum("fg,sg->fs", identity, box, precision=jax.lax.Precision.HIGHEST)


def closest(
    near: Bool[Array, "R S"], centre: Float[Array, "R 6"], box: Float[Array, "6 S"]
) -> tuple[Int[Array, "R C"], Bool[Array, "R C"]]:
    """Return the slots of the C boxes (:func:`columns`) in ``near`` that are closest to each centre, and their mask."""
    dx, dy = box[X] - centre[:, X : X + 1], box[Y] - centre[:, Y : Y + 1]
    key = embed_number(1.0 + (dx * dx + dy * dy), jnp.arange(near.shape[1]), SLOT_BITS)
    # Without the barrier XLA computes the keys again for each of the minima.
    key = jax.lax.optimization_barrier(jnp.where(near, key, jnp.inf))
    minima = [jnp.min(key, axis=1, keepdims=True)]
    for _ in range(CLOSEST - 1):
        minima.append(jnp.min(jnp.where(key > minima[-1], key, jnp.inf), axis=1, keepdims=True))
    smallest = jnp.concatenate(minima, axis=1)
    valid = jnp.isfinite(smallest)
    return jnp.where(valid, number_of(smallest, SLOT_BITS), 0), valid


def overlaps_rectangles(
    box: Float[Array, "6 S"], nodes: Float[Array, "R K 2"], half: Float[Array, "R 1"], behind_m: Any, ahead_m: Any,
    rectangles: int,
) -> Bool[Array, "R S"]:  # fmt: skip
    """Mask of boxes (:func:`columns`) that reach into one of the rectangles along the chords of K points on a path.

    The corridor is ``half`` wide (m) on either side; the first rectangle is ``behind_m`` longer, the last ``ahead_m``.
    The number of rectangles divides K - 1.
    """
    corridor = _rectangles(nodes, half, behind_m, ahead_m, rectangles)
    half_length, half_width = box[LENGTH] / 2, box[WIDTH] / 2
    reaches = jnp.zeros((nodes.shape[0], box.shape[1]), bool)
    for number in range(rectangles):
        x, y, cos, sin, length, width = (column[:, number : number + 1] for column in corridor)
        turn_cos = jnp.abs(box[COS] * cos + box[SIN] * sin)
        turn_sin = jnp.abs(box[SIN] * cos - box[COS] * sin)
        ahead = jnp.abs(box[X] * cos + (box[Y] * sin - (x * cos + y * sin)))
        left = jnp.abs(box[Y] * cos - (box[X] * sin + (y * cos - x * sin)))
        inside = ahead < length + turn_cos * half_length + turn_sin * half_width
        reaches |= inside & (left < width + turn_sin * half_length + turn_cos * half_width)
    return reaches


def _rectangles(
    nodes: Float[Array, "R K 2"], half: Float[Array, "R 1"], behind_m: Any, ahead_m: Any, count: int
) -> tuple[Float[Array, "R Q"], ...]:
    """Return rectangles around stretches of paths: x, y, cosine, sine, half the length, half the width."""
    pieces = (nodes.shape[1] - 1) // count
    # All points but the last, by stretch; the next stretch begins at (chord, 0) in the frame of each.
    x, y = (nodes[:, :-1, axis].reshape(len(nodes), count, pieces) for axis in (X, Y))
    dx, dy = x - x[..., :1], y - y[..., :1]
    chord_x, chord_y = nodes[:, pieces::pieces, X] - x[..., 0], nodes[:, pieces::pieces, Y] - y[..., 0]
    chord = jnp.sqrt(jnp.maximum(chord_x * chord_x + chord_y * chord_y, 1e-6))
    # Beyond the end of a path all points are equal, and any direction works.
    cos, sin = jnp.where(chord > 1e-2, chord_x / chord, 1.0), jnp.where(chord > 1e-2, chord_y / chord, 0.0)
    ahead = dx * cos[..., None] + dy * sin[..., None]
    left = dy * cos[..., None] - dx * sin[..., None]
    number = jnp.arange(count)
    begin = ahead.min(axis=-1) - half - jnp.where(number == 0, behind_m, 0.0)
    end = jnp.maximum(ahead.max(axis=-1), chord) + half + jnp.where(number == count - 1, ahead_m, 0.0)
    right, left = left.min(axis=-1) - half, left.max(axis=-1) + half
    along, across = (begin + end) / 2, (right + left) / 2
    centre_x, centre_y = x[..., 0] + along * cos - across * sin, y[..., 0] + along * sin + across * cos
    # Without the barrier XLA computes the rectangles again for every box.
    return jax.lax.optimization_barrier((centre_x, centre_y, cos, sin, (end - begin) / 2, (left - right) / 2))
