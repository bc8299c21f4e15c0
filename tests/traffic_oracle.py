"""An independent model of reactive traffic: float64, one vehicle at a time, a search of the whole path."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from drivax.geometry.boxes import overlap
from drivax.simulator.simulator import Simulator
from drivax.simulator.traffic.agent_paths import PATH_X, PATH_Y, PROFILE_SPEED, PROFILE_Z, AgentPaths
from drivax.simulator.traffic.bank_data import data_of
from drivax.simulator.traffic.log import alone
from drivax.simulator.traffic.reactive import DRIVES, IdmTraffic
from drivax.tasks.task import Task

TRAFFIC = IdmTraffic()
SIMULATOR = Simulator(Task(), TRAFFIC)
STEPS = 80
#: Agents whose gaps differ by less are equally near, m: a path of stored points has no better direction.
EQUALLY_NEAR_M = 0.3


def _rolled(bank, index):
    """Replay ego; return the frame and the traffic state before every step."""

    def one(context, _):
        frame = SIMULATOR.frame(bank, context, alone(context), 0)
        at = bank.agents[index, jnp.minimum(context.step + 1, bank.steps - 1), 0]
        motion = jnp.stack([at[0], at[1], jnp.arctan2(at[4], at[3]), jnp.hypot(at[5], at[6])])
        history = jnp.concatenate([context.history[1:], motion[None]])
        traffic = TRAFFIC.advance(bank, context, frame)
        after = replace(context, step=context.step + 1, history=history, traffic=traffic)
        return after, (frame, context.traffic)

    return jax.lax.scan(one, SIMULATOR.context(bank, index, 10), None, length=STEPS)[1]


rolled = jax.jit(jax.vmap(_rolled, (None, 0)))


def runs_of(bank):
    """Frames and traffic states of every scenario in which ego replays its log."""
    whole = jax.tree.map(np.asarray, rolled(bank, jnp.arange(len(bank))))
    return [jax.tree.map(lambda leaf, i=i: leaf[i], whole) for i in range(len(bank))]


class Path:
    """The path of a vehicle as a polyline of all its points."""

    def __init__(self, paths, index, row):
        self.points = np.asarray(paths.points[index, row], np.float64)
        self.profile = np.asarray(paths.profile[index, row], np.float64)
        self.spacing = float(paths.spacing[index, row])
        self.arc = np.arange(len(self.points)) * self.spacing

    def at(self, s):
        columns = [self.points[:, PATH_X], self.points[:, PATH_Y]]
        columns += [self.profile[:, PROFILE_Z], self.profile[:, PROFILE_SPEED]]
        return tuple(np.interp(s, self.arc, column) for column in columns)

    def project(self, xy, first, reach):
        """Arc length, distance and direction of the nearest point in a range of arcs; direction of 4 m around it."""
        keep = (self.arc[1:] > first - self.spacing) & (self.arc[:-1] < reach)
        a, b = self.points[:-1, :2][keep], self.points[1:, :2][keep]
        u = b - a
        share = np.clip(((xy - a) * u).sum(1) / np.maximum((u * u).sum(1), 1e-12), 0, 1)
        away = np.hypot(*(xy - a - share[:, None] * u).T)
        k = int(away.argmin())
        arc = self.arc[:-1][keep][k] + share[k] * self.spacing
        (x0, x1), (y0, y1) = (np.interp([arc - 2.0, arc + 2.0], self.arc, self.points[:, i]) for i in (0, 1))
        around = np.array([x1 - x0, y1 - y0])
        return arc, away[k], *(vector / max(np.hypot(*vector), 1e-9) for vector in (u[k], around))


def extents(box, direction):
    """Half the extent of a box along and across a direction."""
    turn_cos, turn_sin = abs(box[2:4] @ direction), abs(box[3] * direction[0] - box[2] * direction[1])
    return turn_cos * box[4] / 2 + turn_sin * box[5] / 2, turn_sin * box[4] / 2 + turn_cos * box[5] / 2


def law(speed, desired, gap, leader):
    """Return the IDM acceleration, independent of the code under test."""
    desired_gap = 2.0 + max(0.0, 1.5 * speed + speed * (speed - leader) / (2 * np.sqrt(1.5 * 3.0)))
    return max(1.5 * (1 - (speed / max(desired, 0.1)) ** 4 - (desired_gap / max(gap, 0.1)) ** 2), -6.0)


def expected_accelerations(bank, index, row, arc, speed, ignored, frame, step):
    """Return an acceleration for each agent that may count as the nearest, and the least distance of one to a border.

    The border is that of the vehicle's corridor.
    """
    path, slot = Path(data_of(bank, AgentPaths), index, row), int(data_of(bank, AgentPaths).slot[index, row])
    x, y, z, limit = path.at(arc)
    length, width = np.asarray(bank.agent_box[index, slot, :2], np.float64)
    look = min(20 + 1.5 * speed + speed * speed / 6, 120)
    border_m, inside = np.inf, []
    box = np.asarray(frame.box, np.float64)
    for other in range(len(box)):
        counts = frame.valid[other] and other != slot and other not in ignored
        if not counts or abs(frame.z[other] - z) > 3 or np.hypot(*(box[other, :2] - [x, y])) > look + 12:
            continue
        s, away, direction, around = path.project(box[other, :2], arc, arc + look)
        # A logged path jitters, and with it the extent of a long box along and across it.
        (half_length, half_width), smooth = extents(box[other], direction), extents(box[other], around)
        beyond = [away - (width / 2 + 0.1 + half) for half in (half_width, smooth[1])]
        side_m = min(abs(beyond[0]), abs(beyond[1])) if beyond[0] * beyond[1] > 0 else 0.0
        ahead = s - arc
        if ahead > -1 and ahead < look + 1:
            start_m = abs(ahead) if away < width / 2 + half_width else np.inf
            border_m = min(border_m, side_m, start_m, abs(ahead - look))
        if away < width / 2 + 0.1 + half_width and 0 < ahead < look:
            gaps = ahead - half_length - length / 2, ahead - smooth[0] - length / 2
            inside.append((*gaps, float(np.asarray(frame.velocity[other], np.float64) @ direction)))
    nearest = np.min([gaps for *gaps, _ in inside], axis=0, initial=1e4)
    results = [
        law(speed, limit, gap, leader)
        for gap, smooth_gap, leader in inside
        if gap < nearest[0] + EQUALLY_NEAR_M or smooth_gap < nearest[1] + EQUALLY_NEAR_M
    ]
    results = results or [law(speed, limit, 1e4, 0.0)]
    state = np.asarray(bank.light_state[index, min(step, 90)])
    for line, light in zip(
        data_of(bank, AgentPaths).stop_arc[index, row],
        data_of(bank, AgentPaths).stop_light[index, row],
        strict=True,
    ):
        front = float(line) - arc - length / 2
        brakes = {1: 6.0, 4: 6.0, 2: 3.0, 5: 3.0}.get(int(state[light]))
        if brakes is None:
            continue
        if (front > 0 and speed**2 <= 2 * brakes * front) or (
            front <= 0 < front + length / 2 and speed < 0.5 and brakes > 3
        ):
            results = [min(result, law(speed, limit, max(front, 0.0), 0.0)) for result in results]
    return results, border_m


def compare(bank, index, frames, traffic, every=7):
    """Return each vehicle's speed error after a step (m/s), and the expected acceleration (m/s2)."""
    errors = []
    for t in range(0, STEPS - 1, every):
        frame = jax.tree.map(lambda leaf, t=t: leaf[t], frames)
        for row in np.flatnonzero((traffic.phase[t] == DRIVES) & (traffic.phase[t + 1] == DRIVES)):
            arc, speed = float(traffic.arc[t, -1, row]), float(traffic.speed[t, -1, row])
            ignored = set(traffic.ignored[t + 1, row].tolist())
            accelerations, border_m = expected_accelerations(
                bank, index, row, arc, speed, ignored, frame, 10 + t
            )
            if border_m < 0.1:
                continue  # on the border of the corridor both answers are right
            reached = traffic.speed[t + 1, -1, row]
            acceleration = min(
                accelerations, key=lambda a, v=speed, u=reached: abs(max(v + a * 0.1, 0.0) - u)
            )
            after = max(speed + acceleration * 0.1, 0.0)
            moved = (speed + after) * 0.05 if after > 0 else speed**2 / max(-2 * acceleration, 1e-9)
            assert traffic.arc[t + 1, -1, row] - arc == pytest.approx(moved, abs=1e-3)
            errors.append((abs(after - reached), acceleration))
    return np.array(errors).reshape(-1, 2)


def new_overlaps(bank, index, frames, traffic):
    """Slot pairs with a reacting agent that begin to overlap after the first step; and the reacting slots."""
    slots = np.asarray(data_of(bank, AgentPaths).slot[index])
    reacting = [int(s) for s in slots[(traffic.phase != 0).any(0) & (slots > 0)]]
    pairs = set()
    for slot in reacting:
        hits = overlap(frames.box[:, slot, None], frames.box) & frames.valid & frames.valid[:, slot, None]
        hits &= np.abs(frames.z - frames.z[:, slot, None]) <= 3
        hits[:, slot] = False
        begins = hits.any(0) & ~hits[0]
        pairs |= {(min(slot, int(o)), max(slot, int(o))) for o in np.flatnonzero(begins)}
    return pairs, reacting
