"""Events at junctions: somebody who runs a red light across ego's way, and somebody who turns left across it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float64

from drivax.scenario.schema import DT_S, AgentKind
from drivax.synthetic.events.actors import CAR_M, along_curve
from drivax.synthetic.events.adversary import comes_close, first_blocked, in_its_lane, required_by_samples
from drivax.synthetic.events.destinations import Aim
from drivax.synthetic.events.ego_view import EARLIEST, FULL_SWING, LATEST, NOTICED, Scene
from drivax.synthetic.events.kinds import SEVERITY_MPS2, EventKind, Proposal
from drivax.synthetic.roads.curves import Curve, joined
from drivax.synthetic.roads.network import Control, Lane, RoadNetwork
from drivax.synthetic.roads.signals import Colour
from drivax.synthetic.traffic.roles import Scripted, Staging

#: Actors come from so far, and are followed so far beyond the junction, m.
_FROM_M, _BEYOND_M = 180.0, 60.0
#: Who is to stop at a line and needs more than this to do so will not, m/s2: from then on ego can know.
_BRAKING_MPS2 = 5.0
#: How hard a turn slows its driver before it, m/s2, and how much lateral acceleration it takes.
_SLOWING_MPS2, _LATERAL_MPS2 = 2.0, 3.0
#: Who turns less goes straight on, rad; whose directions have a larger cosine than this drive along one road.
_TURN_RAD, _ALONG = math.radians(45.0), 0.7


@dataclass(frozen=True)
class _Way:
    """Where an actor drives: a curve, and where on it the junction begins."""

    curve: Curve
    line_m: float
    limit_mps: float

    @classmethod
    def through(cls, scene: Scene, way: int, rng: np.random.Generator) -> _Way:
        """The way through a connector, from far before it."""
        lanes = scene.roles.network.lanes
        before, after = _chain(lanes, way, -1, _FROM_M, rng), _chain(lanes, way, 1, _BEYOND_M, rng)
        ahead = [lanes[i].curve for i in reversed(before)]
        line = sum(float(curve.arc_m[-1]) for curve in ahead)
        curve = joined(*ahead, lanes[way].curve, *(lanes[i].curve for i in after))
        limit = lanes[before[0]].limit_mps if before else lanes[way].limit_mps
        return cls(curve, line, limit)

    @cached_property
    def arc_m(self) -> Float64[np.ndarray, " point"]:
        """Distances of the curve's samples."""
        return self.curve.arc_m

    def distances(
        self, fastest_mps: float, times_s: Float64[np.ndarray, " time"]
    ) -> Float64[np.ndarray, " time"]:
        """Where a driver is at times; at time 0 its front reaches the line.

        It drives at a speed from which bends are reached with ordinary braking, as everybody's speed profile.
        """
        arc = self.arc_m
        rate = np.abs(
            np.gradient(self.curve.heading, np.maximum.accumulate(arc + 1e-9 * np.arange(len(arc))))
        )
        smooth = np.convolve(np.pad(rate, 4, mode="edge"), np.full(9, 1 / 9), mode="valid")
        cap = np.minimum(fastest_mps**2, _LATERAL_MPS2 / np.maximum(smooth, 1e-6))
        ramp = 2 * _SLOWING_MPS2 * arc
        down = np.minimum.accumulate((cap + ramp)[::-1])[::-1] - ramp
        speed = np.sqrt(np.minimum.accumulate(down - ramp) + ramp)
        clock = np.concatenate([[0.0], np.cumsum(np.diff(arc) * 2 / (speed[1:] + speed[:-1]))])
        zero = float(np.interp(self.line_m - CAR_M[0] / 2, arc, clock))
        before = np.minimum(times_s + zero, 0.0) * speed[0]
        beyond = np.maximum(times_s + zero - clock[-1], 0.0) * speed[-1]
        return np.interp(times_s + zero, clock, arc) + before + beyond


def _chain(
    lanes: tuple[Lane, ...], first: int, way: int, length_m: float, rng: np.random.Generator
) -> list[int]:
    """Lanes before (-1) or after (1) a lane, in the order in which they are met, until they are long enough."""
    result: list[int] = []
    total, at = 0.0, first
    while total < length_m:
        links = lanes[at].successors if way > 0 else lanes[at].predecessors
        if not links:
            break
        at = int(rng.choice(links))
        result.append(at)
        total += lanes[at].length_m
    return result


def _straight_on(lane: Lane) -> bool:
    return abs(float(lane.curve.heading[-1] - lane.curve.heading[0])) < _TURN_RAD


@dataclass(frozen=True)
class CrossTraffic:
    """Somebody crosses ego's way in a junction although ego goes first.

    Attributes:
        turning: Somebody oncoming, who turns left and does not yield; else somebody who runs a red light.
        speed_share: The actor's speed before the junction as a share of its limit, low and high.
        arrival_s: Ego should come to the junction so long after the recording's beginning, low and high.
    """

    turning: bool = False
    speed_share: tuple[float, float] = (0.7, 1.1)
    arrival_s: tuple[float, float] = (2.5, 5.5)

    @property
    def kind(self) -> EventKind:
        """See :class:`EventScript`."""
        return EventKind.TURN_CONFLICT if self.turning else EventKind.RED_LIGHT_RUNNER

    def possible(self, network: RoadNetwork) -> bool:
        """See :class:`EventScript`."""
        return bool(self.aims(network))

    def aims(self, network: RoadNetwork) -> tuple[Aim, ...]:
        """See :class:`AimedScript`: stop lines of ways that somebody may cross who ought to wait."""
        if network.signals is None and not self.turning:
            return ()
        return tuple(
            Aim(index, (0.0, 0.0), self.arrival_s)
            for index, lane in enumerate(network.lanes)
            if lane.connector and lane.predecessors and self._crossing(network, index)
        )

    def propose(self, scene: Scene, severity_mps2: float, rng: np.random.Generator) -> Proposal | None:
        """See :class:`EventScript`."""
        ways = self._ways(scene)
        share = float(rng.uniform(*self.speed_share))
        if not ways:
            return None
        lane = int(rng.choice(ways))
        way = _Way.through(scene, lane, rng)
        fastest = share * way.limit_mps
        # When the actor comes too late to stop: from there on it does what it should not.
        decides = max(3, round(float(rng.uniform(0.3, fastest / (2 * _BRAKING_MPS2))) / DT_S))
        found = self._timed(scene, lane, way, (fastest, decides), severity_mps2)
        if found is None:
            return None
        entry, threat, required = found
        leaves = int(np.argmax(~np.isfinite(first_blocked(scene, threat, entry))[8:])) + 8 + entry
        # The queue at its light would hold the actor: in the scenario with the event there is none.
        removed = in_its_lane(scene, threat, entry + 5)
        return Proposal(
            Staging(extras=(threat,), removed=removed),
            required,
            threat,
            entry - decides,
            min(max(leaves, entry + 10), scene.last_step),
        )

    def _ways(self, scene: Scene) -> list[int]:
        """Connectors of actors that cross one that ego will drive through during the recording."""
        network = scene.roles.network
        return sorted({other for mine in scene.connectors for other in self._crossing(network, mine)})

    def _crossing(self, network: RoadNetwork, mine: int) -> list[int]:
        """Connectors whose users would cross this one's, which lead straight on, although they ought to wait."""
        lane = network.lanes[mine]
        if not _straight_on(lane):
            return []
        others = np.flatnonzero(network.conflicts[mine]).tolist()
        return [other for other in others if self._suits(lane, network.lanes[other], mine)]

    def _suits(self, mine: Lane, other: Lane, index: int) -> bool:
        if not other.predecessors or not other.connector:
            return False
        along = math.cos(float(other.curve.heading[0] - mine.curve.heading[0]))
        if self.turning:
            left = not _straight_on(other) and float(other.curve.heading[-1]) > float(other.curve.heading[0])
            return left and along < -_ALONG and index in other.yields_to
        lit = other.control == mine.control == Control.SIGNAL
        return lit and _straight_on(other) and abs(along) < _ALONG

    def _timed(
        self, scene: Scene, lane: int, way: _Way, pace: tuple[float, int], wanted: float
    ) -> tuple[int, Scripted, float] | None:
        """The step at which the actor enters the junction so that it requires about this deceleration of ego."""
        (fastest, decides), steps, track = pace, np.arange(scene.steps), scene.track
        first = scene.first_step + EARLIEST + decides
        last = min(scene.first_step + LATEST + decides, scene.last_step - 15)

        def entering(entry: int) -> Scripted:
            distance = way.distances(fastest, DT_S * (steps - entry))
            return along_curve(way.curve, distance, AgentKind.VEHICLE, CAR_M)

        if first > last:
            return None
        # What it blocks, and when, is the same for all timings but for the shift.
        blocked = first_blocked(scene, entering(first), first - decides)
        requires = np.zeros(last + 1)
        for entry in range(first, last + 1):
            begin = entry - decides + NOTICED
            speed = float(scene.motion.speed[0, begin])
            if speed > 4.0:
                room = blocked[NOTICED:][: scene.last_step + 1 - begin] - track.at[begin]
                requires[entry] = required_by_samples(speed, room)
        low, high = SEVERITY_MPS2
        # The step at which the actor comes into ego's way, in time with the entry.
        enters = np.arange(last + 1) - decides + int(np.argmax(np.isfinite(blocked)))
        in_time = enters < scene.first_step + FULL_SWING
        fits = np.flatnonzero((requires > low) & (requires < high) & in_time)
        for entry in fits[np.argsort(np.abs(requires[fits] - wanted), kind="stable")[:6]].tolist():
            # An ego that keeps its speed may be through before the actor comes.
            threat = entering(entry)
            if comes_close(scene, threat, entry - decides) and self._fits_lights(scene, lane, entry):
                return entry, threat, float(requires[entry])
        return None

    def _fits_lights(self, scene: Scene, lane: int, entry: int) -> bool:
        """A runner enters at red (not just now), a turner without a red light."""
        network = scene.roles.network
        if network.signals is None:
            return self.turning
        colour, _ = network.signals.colours(scene.times_s, len(network.lanes))
        seen = colour[entry - 12 : entry + 1, lane]
        return bool(np.all(seen != Colour.RED)) if self.turning else bool(np.all(seen == Colour.RED))
