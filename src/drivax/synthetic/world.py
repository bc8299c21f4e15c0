"""The built-in traffic world: one recording per seed and index, whose expert neither collides nor leaves the road.

Every ``numpy.random.default_rng`` is seeded with the seed, the number of the scenario (for roads, of the map) and the
number of the attempt, so a recording depends neither on the number of workers nor on other recordings.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Generator, Iterable, Iterator
from dataclasses import dataclass, field, replace
from functools import lru_cache

import numpy as np
from jaxtyping import Float64

from drivax.errors import UsageError
from drivax.geometry.vectors import wrap
from drivax.scenario.recording import Event, Light, Recording, Tracks
from drivax.scenario.schema import CURRENT_STEP, DT_S, STEPS, Flag
from drivax.synthetic.domains import DOMAINS, Domain
from drivax.synthetic.events import (
    EgoView,
    EventKind,
    StagedEvent,
    destinations_for,
    draw_severity,
    endangers_ego,
    possible,
    stage,
)
from drivax.synthetic.events.conflict_start import critical_steps
from drivax.synthetic.events.destinations import Destination
from drivax.synthetic.expert import driver as expert
from drivax.synthetic.expert.violations import EGO_SKIN_M
from drivax.synthetic.roads.families import RoadFamily
from drivax.synthetic.roads.network import RoadNetwork, feature_id, map_features
from drivax.synthetic.roads.signals import light_states
from drivax.synthetic.sensing import NoiseConfig, SensorConfig, add_perception_noise, largest_shift_m, sight
from drivax.synthetic.traffic.placement import LARGEST_VEHICLE_M
from drivax.synthetic.traffic.role_assignment import SignalTiming, assign_roles, conflicts_on
from drivax.synthetic.traffic.roles import Motion, Roles, Staging
from drivax.synthetic.traffic.simulation import Run, WorldTraffic, run_all

#: Increased when the same seed gives another world; part of every scenario id.
WORLD_VERSION = 2
#: Traffic runs this long before a recording that does not begin at a critical step, s.
_WARM_UP_S = 4.0
_WARM_UP = round(_WARM_UP_S / DT_S)
#: Candidate first steps of a critical recording: earliest, largest delay after the warm-up, stride.
_EARLIEST_STEP, _MAX_DELAY_STEPS, _CRITICAL_STRIDE = 28, 16, 4
#: Ego's first plan may react to an event this many steps before it begins (:func:`expert.driver.drive_ego`).
_LEAD_STEPS = 8
#: Lights are recorded within the bounding rectangle of ego's log and this margin, m.
_LIGHTS_M = 95.0
#: Largest number of draws of a scenario (and of roads for an event), on one map, and with one kind of event.
_ATTEMPTS, _PER_MAP, _PER_KIND = 400, 12, 60
#: Causes of rejection other than violations: the event cannot happen, or does not endanger ego.
UNSUITED = _NO_OCCASION, _NO_THREAT = "no_occasion", "no_threat"
#: Largest number of stagings with the same roles.
_STAGINGS = 3
#: Largest number of recorded users other than ego: the actors of the event and the users nearest to ego.
_RECORDED = 76


@dataclass(frozen=True)
class WorldConfig:
    """Settings of the world.

    Attributes:
        domain: Name of the domain (``grid`` or ``ring``), a tag of every scenario.
        rare_rate: Share of scenarios in which a rare event is staged.
        critical_share: Share of the scenarios without an event in which ego must give way, if the roads allow it; the
            recording begins at a critical step (:mod:`events.conflict_start`), if there is one.
        lane_change_share: Share of random routes with room for it on which ego plans a lane change; routes past a
            destination for an event or a conflict have none.
        signal_timing: Shares of states of ego's next light after the warm-up: green, turning green, turning yellow.
        scenarios_per_map: Number of consecutive indices whose scenarios share roads and a segment, except those with an
            event; new roads are drawn after 12 rejected draws.
        noise: Perception noise of the tracks of all users but ego.
        sensor: Ego's sensor.
    """

    domain: str = "grid"
    rare_rate: float = 0.05
    critical_share: float = 0.8
    lane_change_share: float = 0.35
    signal_timing: SignalTiming = (0.34, 0.33, 0.33)
    scenarios_per_map: int = 2
    noise: NoiseConfig = field(default_factory=NoiseConfig)
    sensor: SensorConfig = field(default_factory=SensorConfig)

    def check(self) -> Domain:
        """Check the settings and return the domain.

        Raises:
            UsageError: A setting is invalid.
        """
        if self.domain not in DOMAINS:
            raise UsageError(f"unknown domain {self.domain!r}", cure=f"use one of {', '.join(DOMAINS)}")
        for name in ("rare_rate", "critical_share", "lane_change_share"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise UsageError(f"{name} is {getattr(self, name)}", cure="use a share from 0 to 1")
        timing = self.signal_timing
        # numpy.random refuses probabilities whose sum differs from 1 by more than about 1.49e-8.
        if len(timing) != 3 or min(timing) < 0.0 or not math.isclose(sum(timing), 1.0, abs_tol=1.4e-8):
            raise UsageError(f"signal_timing is {list(timing)}", cure="use three shares that add up to 1")
        self.noise.check()
        self.sensor.check()
        if self.scenarios_per_map < 1:
            raise UsageError(f"scenarios_per_map is {self.scenarios_per_map}", cure="use 1 or more")
        if largest_shift_m(self.noise, *LARGEST_VEHICLE_M) > EGO_SKIN_M:
            raise UsageError(
                f"noise (noise.level {self.noise.level}) could exceed the margin of {EGO_SKIN_M} m around ego",
                cure="use a smaller level or smaller deviations",
            )
        return DOMAINS[self.domain]


@dataclass(frozen=True)
class GeneratedRecording:
    """A recording with its road family and domain, and the numbers of rejected draws by family and cause."""

    recording: Recording
    family: str
    domain: str
    rejected: dict[tuple[str, str], int]


def generate_recording(
    seed: int, index: int, config: WorldConfig | None = None, steps: int = STEPS
) -> Recording:
    """Generate the recording of a seed and an index, neither of them negative; see :func:`generate_many`."""
    return generate_one(seed, index, config or WorldConfig(), steps).recording


def generate_one(seed: int, index: int, config: WorldConfig, steps: int = STEPS) -> GeneratedRecording:
    """Generate one recording: :func:`generate_many` for one index."""
    return next(generate_many(seed, [index], config, steps))


def generate_many(
    seed: int, indices: Iterable[int], config: WorldConfig, steps: int = STEPS
) -> Iterator[GeneratedRecording]:
    """Generate recordings of ``steps`` steps, at least 91, with their families and rejected attempts.

    Their traffic is simulated together, which is faster and changes no recording. The kind of event is drawn first and
    replaced only after 60 attempts, so kinds that fail more often are hardly rarer. A scenario with an event has its
    own roads, new ones for each attempt, on which the event can happen.

    Raises:
        UsageError: A setting is invalid, there are too few steps, seed or index is negative, no roads suit the event,
            or no draw gives a clean expert.
    """
    domain = config.check()
    if steps < STEPS:
        raise UsageError(f"steps is {steps}", cure=f"use {STEPS} or more")
    return run_all(_generate(seed, index, config, domain, steps) for index in indices)


def _generate(
    seed: int, index: int, config: WorldConfig, domain: Domain, steps: int
) -> Generator[Run, Motion, GeneratedRecording]:
    """Repeat attempts until one gives a recording; raise a UsageError after ``_ATTEMPTS``."""
    if seed < 0 or index < 0:
        raise UsageError(f"seed {seed} and index {index} must not be negative", cure="choose 0 or more")
    events, severity = _draw_events(config, np.random.default_rng([seed, 0, index]))
    rejected: Counter[tuple[str, str]] = Counter()
    for attempt in range(_ATTEMPTS):
        event = events[attempt // _PER_KIND % len(events)]
        map_number = (index, attempt) if event else (index // config.scenarios_per_map, attempt // _PER_MAP)
        family, network = _draw_roads(config.domain, event, (seed, 3 if event else 1, *map_number))
        rng = np.random.default_rng([seed, 2, index, attempt])
        destinations = destinations_for(event, network, attempt > 0) if event else ()
        inputs = _AttemptInputs(network, destinations, event, severity, steps)
        result = yield from _attempt(inputs, domain, config, rng)
        if isinstance(result, str):
            rejected[family.name, result] += 1
            continue
        prefix = f"w{WORLD_VERSION}-{config.domain}-s{seed}"
        suffix = f"-t{steps}" if steps != STEPS else ""
        recording = replace(
            result,
            scenario_id=f"{prefix}{suffix}-{index:06d}-{family.name}",
            segment=f"{prefix}-{'r' if event else 'm'}{map_number[0]:06d}.{map_number[1]}",
            tags={"family": family.name, "domain": config.domain, **result.tags},
        )
        return GeneratedRecording(recording, family.name, config.domain, dict(rejected))
    causes = ", ".join(f"{cause} in {family} {n}" for (family, cause), n in sorted(rejected.items()))
    raise UsageError(
        f"no clean expert in {_ATTEMPTS} attempts for seed {seed}, index {index}: {causes}",
        cure="choose another seed",
    )


def _draw_events(config: WorldConfig, rng: np.random.Generator) -> tuple[list[EventKind], float]:
    """Draw the kinds of event in the order in which to attempt them, or only ``NONE``, and the severity, m/s2."""
    kinds = [kind for kind in EventKind if kind]
    is_rare, order = rng.random() < config.rare_rate, rng.permutation(len(kinds)).tolist()
    return ([kinds[k] for k in order] if is_rare else [EventKind.NONE]), draw_severity(rng)


@lru_cache(maxsize=1)
def _draw_roads(name: str, event: EventKind, seed: tuple[int, ...]) -> tuple[RoadFamily, RoadNetwork]:
    """Draw roads of a domain until they suit the event; cached for consecutive draws."""
    domain, rng = DOMAINS[name], np.random.default_rng(seed)
    for _ in range(_ATTEMPTS):
        family = domain.draw_family(rng)
        network = family.build(rng, domain.style)
        if not event or possible(event, network):
            return family, network
    raise UsageError(
        f"no roads of the domain {domain.name} allow the event {event.name.lower()}",
        cure="use another domain or a rare_rate of 0",
    )


@dataclass(frozen=True)
class _AttemptInputs:
    """Arguments of an attempt: roads, candidate destinations of ego, event (or none), severity, number of steps."""

    network: RoadNetwork
    destinations: tuple[Destination, ...]
    event: EventKind
    severity_mps2: float
    steps: int


def _attempt(
    inputs: _AttemptInputs, domain: Domain, config: WorldConfig, rng: np.random.Generator
) -> Generator[Run, Motion, Recording | str]:
    """Return the recording of one draw, or the cause of its rejection."""
    critical = not inputs.event and rng.random() < config.critical_share
    times = (np.arange(_WARM_UP + inputs.steps + _MAX_DELAY_STEPS * critical) - _WARM_UP) * DT_S
    shares = config.lane_change_share, config.signal_timing
    roles = assign_roles(inputs.network, domain, times, *shares, rng, inputs.destinations, critical)
    traffic = WorldTraffic(roles, times)
    if inputs.event:
        result = yield from _stage_event(inputs, traffic, rng)
    else:
        result = yield from _drive_without_event(traffic, inputs.steps, critical, rng)
    return result if isinstance(result, str) else _add_perception(result, config, rng)


def _drive_without_event(
    traffic: WorldTraffic, steps: int, critical: bool, rng: np.random.Generator
) -> Generator[Run, Motion, Recording | str]:
    """Return a recording without perception noise, or the cause of its rejection.

    With ``critical`` it begins at a critical step, if there is one.
    """
    motion, begin, tags = (yield Run(traffic)), _WARM_UP, {}
    step = _critical_step(traffic, motion, rng) if critical else None
    if step is not None:
        begin, tags = step, {"critical": "yes"}
    end = begin + steps
    traffic, motion = traffic.before_step(end), motion.before_step(end)
    motion, cause = yield from expert.drive_ego(traffic, Staging(), begin, unplanned=motion)
    return cause or replace(_to_recording(traffic.roles, motion, begin, None, steps), tags=tags)


def _stage_event(
    inputs: _AttemptInputs, traffic: WorldTraffic, rng: np.random.Generator
) -> Generator[Run, Motion, Recording | str]:
    """Return a recording of the event without perception noise, or the reason for none: no occasion, or a rejection."""
    view, cause = EgoView(traffic.roles, (yield Run(traffic)), _WARM_UP), _NO_OCCASION
    for _ in range(_STAGINGS):
        staged = stage(inputs.event, view, inputs.severity_mps2, rng)
        if staged is None:
            break
        aware_step = staged.first_step - _LEAD_STEPS
        motion, cause = yield from expert.drive_ego(traffic, staged.staging, _WARM_UP, aware_step)
        if not cause and endangers_ego(view, motion, staged):
            return _to_recording(traffic.roles, motion, _WARM_UP, staged, inputs.steps)
        cause = cause or _NO_THREAT
    return cause


def _add_perception(recording: Recording, config: WorldConfig, rng: np.random.Generator) -> Recording:
    """Add perception noise and the visibility mask."""
    tracks, ego = recording.tracks, recording.ego
    is_visible = sight(tracks, ego, config.sensor)
    return replace(recording, tracks=add_perception_noise(tracks, ego, rng, config.noise), seen=is_visible)


def _critical_step(traffic: WorldTraffic, motion: Motion, rng: np.random.Generator) -> int | None:
    """Draw one of the candidate first steps that are critical (:func:`critical_steps`), if there is one."""
    network = traffic.roles.network
    if not conflicts_on(network, motion.paths[0]):
        return None
    steps = np.arange(_EARLIEST_STEP, _WARM_UP + _MAX_DELAY_STEPS + 1, _CRITICAL_STRIDE)
    candidates = np.flatnonzero(critical_steps(network, motion, traffic.colour, steps))
    return int(steps[rng.choice(candidates)]) if len(candidates) else None


def _to_recording(
    roles: Roles, motion: Motion, first_step: int, staged: StagedEvent | None, steps: int
) -> Recording:
    """Return the recording of ``steps`` steps from ``first_step`` on, without id and segment."""
    network, motion = roles.network, motion.from_step(first_step)
    times = np.arange(steps) * DT_S
    events, tags = (), {}
    if staged is not None:
        tags = {"event": staged.kind.name.lower(), "severity_mps2": f"{staged.severity_mps2:.1f}"}
        begin, last = staged.first_step - first_step, staged.last_step - first_step
        actors = tuple(user + 1 for user in staged.actors)
        events = (Event(int(staged.kind), begin, min(last, steps - 1), actors),)
    return Recording(
        scenario_id="",
        dataset="drivax",
        segment="",
        timestamps_s=times,
        current_step=CURRENT_STEP,
        ego=0,
        tracks=_tracks(motion, () if staged is None else staged.actors),
        features=map_features(network),
        lights=_lights(network, motion, (first_step - _WARM_UP) * DT_S + times),
        # After a wide detour of ego, the adjacent lanes that it occupied follow at the end.
        route_lanes=tuple(map(feature_id, dict.fromkeys(span.lane for span in motion.paths[0].spans))),
        events=events,
        tags=tags,
        # Lights are known to be complete, so the red-light metric is defined on roads without lights.
        flags=Flag.LANE_GRAPH | Flag.SPEED_LIMITS | Flag.CLOSED_EDGES | Flag.LIGHTS,
    )


def _lights(network: RoadNetwork, motion: Motion, times_s: Float64[np.ndarray, " time"]) -> tuple[Light, ...]:
    """Return the lights near the bounding rectangle of ego's trajectory."""
    if network.signals is None:
        return ()
    colour, _ = network.signals.colours(times_s, len(network.lanes))
    low, high = motion.xy[0].min(axis=0) - _LIGHTS_M, motion.xy[0].max(axis=0) + _LIGHTS_M
    lights = []
    for group in network.signals.groups:
        for lane in group.lanes:
            stop = network.lanes[lane].curve.xy[0]
            if np.all((low <= stop) & (stop <= high)):
                states = light_states(colour[:, lane], group.arrow)
                lights.append(Light(feature_id(lane), np.array([*stop, 0.0]), states))
    return tuple(lights)


def _tracks(motion: Motion, actors: tuple[int, ...]) -> Tracks:
    """Return tracks of ego, an event's actors and the users nearest to ego, with zeros where invalid."""
    valid = motion.valid
    distance_m = np.hypot(*np.moveaxis(motion.xy - motion.xy[:1], -1, 0))
    least_distance_m = np.where(valid, distance_m, np.inf).min(axis=1)
    least_distance_m[[0, *actors]] = -1.0
    rows = np.sort(np.argsort(least_distance_m, kind="stable")[: _RECORDED + 1])
    rows = rows[np.isfinite(least_distance_m[rows])]
    valid = valid[rows]
    heading = np.where(valid, wrap(motion.heading[rows]), 0.0)
    speed: Float64[np.ndarray, "v t"] = np.where(valid, motion.speed[rows], 0.0)
    return Tracks(
        xy=np.where(valid[..., None], motion.xy[rows], 0.0),
        z=np.zeros(valid.shape),
        heading=heading,
        velocity=speed[..., None] * np.stack([np.cos(heading), np.sin(heading)], axis=-1),
        size=np.where(valid[..., None], motion.size_m[rows, None], 0.0),
        valid=valid,
        kind=motion.kind[rows],
        track_id=(rows + 1).astype(np.int64),
    )
