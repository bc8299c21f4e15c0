"""The built-in traffic world: one recording per seed and index, whose expert neither collides nor leaves the road.

Everything is drawn from ``numpy.random.default_rng`` seeded with (seed, index, attempt), so a recording depends on
nothing else: not on the number of workers, nor on what was generated before. Perception is perfect: no noise, no
occlusion.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Bool, Float64

from drivax.errors import UsageError
from drivax.geometry.angles import wrap
from drivax.scenario.recording import Event, Light, Recording, Tracks
from drivax.scenario.schema import CURRENT_STEP, DT_S, STEPS, AgentKind, Flag
from drivax.synthetic import expert
from drivax.synthetic.drivers import Drivers
from drivax.synthetic.events import SCRIPTS, EventKind, Staged
from drivax.synthetic.families import FAMILIES, RoadFamily
from drivax.synthetic.paths import Path, Sway, lane_path, random_lanes
from drivax.synthetic.population import Density, drawn_drivers, joined_drivers, placed
from drivax.synthetic.roads import RoadNetwork, feature_id, map_features
from drivax.synthetic.signals import SignalPlan, light_states
from drivax.synthetic.traffic import Motion, Traffic, speed_profile

#: Raised whenever the same seed gives another world; part of every scenario id.
WORLD_VERSION = 1
#: Traffic runs this long before the recording begins, s.
_WARM_UP_S = 6.0
_ATTEMPTS = 60


@dataclass(frozen=True)
class WorldConfig:
    """What the world is like.

    Attributes:
        domain: Name of the domain, a tag of every scenario.
        density: How full the roads are.
        lane_change_share: Share of scenarios with room for it in which ego plans a lane change.
        event_rate: Share of scenarios in which an event is staged where there is occasion.
        signal_timing: Shares of what the light does for ego: green on arrival, turning green, turning red.
    """

    domain: str = "grid"
    density: Density = field(default_factory=Density)
    lane_change_share: float = 0.35
    event_rate: float = 0.1
    signal_timing: tuple[float, float, float] = (0.34, 0.33, 0.33)


@dataclass(frozen=True)
class Generated:
    """A recording and how it came about.

    Attributes:
        recording: The log.
        family: Its family of roads.
        domain: Its domain.
        rejected: How many attempts were thrown away before this one, by cause.
    """

    recording: Recording
    family: str
    domain: str
    rejected: dict[str, int]

    @property
    def tags(self) -> dict[str, str]:
        """Words for filters: ``family``, ``domain``, and ``event`` where one is labelled."""
        tags = {"family": self.family, "domain": self.domain}
        if self.recording.events:
            tags["event"] = EventKind(self.recording.events[0].kind).name.lower()
        return tags


@dataclass(frozen=True)
class _Cast:
    """Everything that is decided before anybody moves; row 0 is ego."""

    network: RoadNetwork
    paths: list[Path]
    drivers: Drivers
    distance_m: Float64[np.ndarray, " vehicle"]
    speed_mps: Float64[np.ndarray, " vehicle"]
    route: tuple[int, ...]


def generate_recording(seed: int, index: int, config: WorldConfig | None = None) -> Recording:
    """The recording of this seed and index.

    Args:
        seed: Seed of the set, not negative.
        index: Number of the scenario in the set, not negative.
        config: What the world is like.
    """
    return generate_one(seed, index, config or WorldConfig()).recording


def generate_one(seed: int, index: int, config: WorldConfig) -> Generated:
    """Like :func:`generate_recording`, and tells the family and what was rejected.

    Raises:
        UsageError: When seed or index are negative, or no attempt gives a clean expert.
    """
    if seed < 0 or index < 0:
        raise UsageError(f"seed {seed} and index {index} must not be negative", cure="choose 0 or more")
    family = FAMILIES[int(np.random.default_rng([seed, index]).integers(len(FAMILIES)))]
    rejected: Counter[str] = Counter()
    for attempt in range(_ATTEMPTS):
        rng = np.random.default_rng([seed, index, attempt])
        scenario_id = f"w{WORLD_VERSION}-s{seed}-{index:06d}-{family.name}"
        recording, cause = _attempt(scenario_id, family, config, rng)
        if recording is not None:
            return Generated(recording, family.name, config.domain, dict(rejected))
        rejected[cause] += 1
    raise UsageError(
        f"no clean expert in {_ATTEMPTS} attempts for seed {seed}, index {index}: {dict(rejected)}",
        cure="lower the density of traffic",
    )


def _attempt(
    scenario_id: str, family: RoadFamily, config: WorldConfig, rng: np.random.Generator
) -> tuple[Recording | None, str]:
    """One draw: the recording, or None and why it was thrown away."""
    cast = _cast(family.build(rng), config, rng)
    warm_up = round(_WARM_UP_S / DT_S)
    times = (np.arange(warm_up + STEPS) - warm_up) * DT_S
    motion = _drive(cast, times)
    staged = None
    if rng.random() < config.event_rate:
        staged = SCRIPTS[int(rng.integers(len(SCRIPTS)))].stage(motion, cast.paths, warm_up, rng)
        if staged is not None:
            motion = _drive(cast, times, staged)
    motion = Motion(**{name: value[:, warm_up:] for name, value in vars(motion).items()})
    hardest = expert.HARDEST_MPS2 if staged is None else expert.HARDEST_IN_EVENT_MPS2
    cause = _fault(cast, motion, times[warm_up:], hardest)
    if cause:
        return None, cause
    return _recorded(scenario_id, cast, motion, _label(staged, warm_up)), ""


def _drive(cast: _Cast, times: Float64[np.ndarray, " time"], staged: Staged | None = None) -> Motion:
    traffic = Traffic(cast.network, cast.paths, cast.drivers, cast.distance_m, cast.speed_mps, times)
    return traffic.run(() if staged is None else (staged.override,))


def _cast(network: RoadNetwork, config: WorldConfig, rng: np.random.Generator) -> _Cast:
    """Draws ego, its way and lights, then the others and theirs."""
    start = network.starts[int(rng.integers(len(network.starts)))]
    lanes, change = expert.expert_lanes(network, start.lane, config.lane_change_share, rng)
    driver = expert.drawn_expert(rng)
    path = expert.expert_path(network, lanes, change, rng)
    if network.signals is not None:
        way = next(lane for lane in lanes if network.lanes[lane].connector)
        network = replace(network, signals=_timed(network.signals, way, config.signal_timing, rng))
    # Ego begins so far back that the warm-up brings it to where the recording should begin.
    cruise = 0.9 * float(driver.speed_factor[0]) * network.lanes[start.lane].limit_mps
    first = next(span for span in path.spans if span.lane == start.lane)
    at = first.begin_m + rng.uniform(start.low_m, start.high_m) - _WARM_UP_S * cruise
    at = max(12.0, float(at))
    here = max((span for span in path.spans if span.begin_m <= at), key=lambda span: span.begin_m)
    others = placed(network, here.lane, at - here.begin_m, config.density, rng)
    drivers = joined_drivers(driver, drawn_drivers(len(others.lane), config.density.truck_share, rng))
    ways = [random_lanes(network, lane, rng) for lane in others.lane]
    paths = [path] + [lane_path(network, way, Sway.drawn(rng, 0.2)) for way in ways]
    distance = np.array([at, *others.along_m])
    speed = _first_speeds(network, paths, drivers, distance, rng)
    return _Cast(network, paths, drivers, distance, speed, lanes)


def _timed(
    plan: SignalPlan, way: int, shares: tuple[float, float, float], rng: np.random.Generator
) -> SignalPlan:
    """Sets the plan's clock so that ego's light does something of interest during the recording (time 0 on)."""
    phase = plan.phase_of(way)
    what = int(rng.choice(3, p=shares))
    if what == 0:  # green for a while before ego comes
        green_at = -rng.uniform(0.0, 3.0)
    elif what == 1:  # turns green
        green_at = rng.uniform(0.5, 5.0)
    else:  # turns yellow, then red
        green_at = rng.uniform(0.3, 4.5) - plan.green_s[phase]
    return replace(plan, offset_s=float(green_at) - plan.starts_s[phase])


def _first_speeds(
    network: RoadNetwork,
    paths: list[Path],
    drivers: Drivers,
    distance: Float64[np.ndarray, " vehicle"],
    rng: np.random.Generator,
) -> Float64[np.ndarray, " vehicle"]:
    """Speeds from which everybody can still stop at the next stop line, whatever the light will do."""
    speeds = []
    for i, path in enumerate(paths):
        fastest = speed_profile(
            path, drivers.speed_factor[i], drivers.lateral_mps2[i], drivers.slowing_mps2[i]
        )
        speed = fastest[min(int(distance[i] / path.step_m), len(fastest) - 1)] * rng.uniform(0.7, 1.0)
        front = distance[i] + drivers.size_m[i, 0] / 2
        lines = [s.begin_m - front for s in path.spans if network.lanes[s.lane].connector]
        room = min((line for line in lines if line >= 0), default=math.inf)
        speeds.append(min(float(speed), math.sqrt(2 * 1.5 * max(room - 2.0, 0.0))))
    return np.array(speeds)


def _fault(cast: _Cast, motion: Motion, times: Float64[np.ndarray, " time"], hardest_mps2: float) -> str:
    """Why this scenario must not be shown, or an empty string."""
    if motion.distance_m[0, -1] - motion.distance_m[0, 0] < 5.0:
        return "ego_hardly_moves"
    if not motion.valid[0].all():
        return "ego_leaves_map"
    if motion.acceleration[0].min() < -hardest_mps2:
        return "ego_brakes_hard"
    size = np.broadcast_to(cast.drivers.size_m[:, None], (*motion.speed.shape, 3))
    box = expert.boxes(motion.xy, motion.heading, size)
    pairs = expert.touching(box, motion.valid)
    if pairs.any():
        return "ego_collides" if pairs[0].any() else "others_collide"
    if expert.leaves_road(cast.network, box[0]):
        return "ego_leaves_road"
    front = motion.distance_m + cast.drivers.size_m[:, None, 0] / 2
    for i, path in enumerate(cast.paths):
        if expert.runs_red(cast.network, path, front[i], times):
            return "ego_runs_red" if i == 0 else "other_runs_red"
    return ""


def _label(staged: Staged | None, warm_up: int) -> tuple[Event, ...]:
    if staged is None:
        return ()
    first, last = staged.override.first_step - warm_up, staged.override.last_step - warm_up
    return (Event(int(staged.kind), first, min(last, STEPS - 1), (_track_id(staged.override.vehicle),)),)


def _track_id(vehicle: int) -> int:
    return vehicle + 1


def _recorded(scenario_id: str, cast: _Cast, motion: Motion, events: tuple[Event, ...]) -> Recording:
    network = cast.network
    times = np.arange(STEPS) * DT_S
    # The world knows where there are no lights, so a road without them has its red-light metric defined.
    flags = Flag.LANE_GRAPH | Flag.SPEED_LIMITS | Flag.CLOSED_EDGES | Flag.LIGHTS
    lights: tuple[Light, ...] = ()
    if network.signals is not None:
        colour, _ = network.signals.colours(times, len(network.lanes))
        lights = tuple(
            Light(
                lane_id=feature_id(lane),
                stop_point=np.array([*network.lanes[lane].curve.xy[0], 0.0]),
                states=light_states(colour[:, lane], group.arrow),
            )
            for group in network.signals.groups
            for lane in group.lanes
        )
    return Recording(
        scenario_id=scenario_id,
        dataset="drivax",
        segment=scenario_id,
        timestamps_s=times,
        current_step=CURRENT_STEP,
        ego=0,
        tracks=_tracks(cast.drivers, motion),
        features=map_features(network),
        lights=lights,
        route_lanes=tuple(map(feature_id, cast.route)),
        events=events,
        flags=flags,
    )


def _tracks(drivers: Drivers, motion: Motion) -> Tracks:
    """The vehicles that were seen; zeros where they were not."""
    seen = np.flatnonzero(motion.valid.any(axis=1))
    valid: Bool[np.ndarray, "v t"] = motion.valid[seen]
    heading = np.where(valid, wrap(motion.heading[seen]), 0.0)
    speed = np.where(valid, motion.speed[seen], 0.0)
    return Tracks(
        xy=np.where(valid[..., None], motion.xy[seen], 0.0),
        z=np.zeros(valid.shape),
        heading=heading,
        velocity=speed[..., None] * np.stack([np.cos(heading), np.sin(heading)], axis=-1),
        size=np.where(valid[..., None], drivers.size_m[seen, None], 0.0),
        valid=valid,
        kind=np.full(len(seen), AgentKind.VEHICLE, np.int8),
        track_id=(seen + 1).astype(np.int64),
    )
