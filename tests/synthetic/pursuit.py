"""Pure pursuit with a kinematic bicycle, as an oracle of whether roads can be driven; many routes at once."""

from __future__ import annotations

import numpy as np

#: Wheelbase, rear axle to rear bumper, length and width of the car, m; largest steering angle, rad; time step, s.
WHEELBASE, OVERHANG, LENGTH, WIDTH, STEER, DT = 2.8, 1.0, 4.8, 2.0, 0.62, 0.1


def covering_routes(network):
    """Routes from end to end of the map that together use every lane, none of them twice on a route."""
    routes, covered = [], set()
    for lane in sorted(range(len(network.lanes)), key=lambda i: not network.lanes[i].connector):
        if lane in covered:
            continue
        route = [lane]
        while before := [k for k in network.lanes[route[0]].predecessors if k not in route]:
            # From the edge of the map rather than once more around a roundabout.
            route.insert(0, min(before, key=lambda k: len(network.lanes[k].predecessors)))
        while after := [k for k in network.lanes[route[-1]].successors if k not in route]:
            route.append(after[0])
        routes.append(tuple(route))
        covered |= set(route)
    return routes


def _line(network, route):
    xy = np.concatenate(
        [network.lanes[lane].curve.xy[(0 if k == 0 else 1) :] for k, lane in enumerate(route)]
    )
    arc = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(xy, axis=0).T))])
    at = np.arange(0.0, arc[-1], 0.5)
    return np.stack([np.interp(at, arc, xy[:, k]) for k in (0, 1)], axis=-1)


def _speeds(line, fastest, lateral):
    """As fast as bends allow, 4 m of them at a time, braking ahead of them at 2 m/s2."""
    heading = np.unwrap(np.arctan2(*np.diff(line, axis=0).T[::-1]))
    rate = np.abs(np.convolve(np.gradient(heading, 0.5), np.full(8, 1 / 8), mode="same"))
    cap = np.minimum(fastest**2, lateral / np.maximum(np.append(rate, rate[-1]), 1e-6))
    ramp = 2 * 2.0 * 0.5 * np.arange(len(cap))
    return np.sqrt(np.minimum.accumulate((cap + ramp)[::-1])[::-1] - ramp)


def driven(network, routes, speed_mps, lateral_mps2):
    """Corners ``[point, 2]`` of the car's box at all steps of all routes."""
    lines = [_line(network, route) for route in routes]
    last = np.array([len(line) - 1 for line in lines])
    size = last.max() + 1
    xy = np.stack([np.pad(line, ((0, size - len(line)), (0, 0)), mode="edge") for line in lines])
    fast = [_speeds(line, speed_mps, lateral_mps2) for line in lines]
    fast = np.stack([np.pad(speeds, (0, size - len(speeds)), mode="edge") for speeds in fast])
    rows, index = np.arange(len(lines)), np.full(len(lines), 4)
    at = xy[rows, index].copy()
    ahead = xy[rows, index + 4] - at
    heading = np.arctan2(ahead[:, 1], ahead[:, 0])
    window, corners, active = np.arange(8), [], np.ones(len(lines), bool)
    while active.any():
        near = np.minimum(index[:, None] + window, last[:, None])
        index = index + np.argmin(np.sum((xy[rows[:, None], near] - at[:, None]) ** 2, axis=-1), axis=1)
        # The front of the car stays on the map.
        active &= index + 10 < last
        corners.append(_corners(at, heading)[active].reshape(-1, 2))
        speed = fast[rows, index]
        target = (
            xy[rows, np.minimum(index + np.round(np.maximum(3.0, 0.6 * speed) / 0.5).astype(int), last)] - at
        )
        reach = np.maximum(np.hypot(*target.T), 0.5)
        aside = -target[:, 0] * np.sin(heading) + target[:, 1] * np.cos(heading)
        steer = np.clip(np.arctan(2 * aside / reach**2 * WHEELBASE), -STEER, STEER)
        turned = heading + speed * DT * np.tan(steer) / WHEELBASE
        middle = (heading + turned) / 2
        at = at + (speed * DT * active)[:, None] * np.stack([np.cos(middle), np.sin(middle)], axis=-1)
        heading = np.where(active, turned, heading)
    return np.concatenate(corners)


def _corners(rear, heading):
    """Corners of boxes whose rear axle is here, ``[car, 4, 2]``."""
    c, s = np.cos(heading), np.sin(heading)
    forward, left = np.stack([c, s], axis=-1), np.stack([-s, c], axis=-1)
    return np.stack(
        [
            rear + (along * forward) + (side * left)
            for along in (-OVERHANG, LENGTH - OVERHANG)
            for side in (-WIDTH / 2, WIDTH / 2)
        ],
        axis=1,
    )
