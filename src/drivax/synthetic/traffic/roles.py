"""Road users of a scenario and their drivers, the staged changes, and the resulting motion."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float64, Int8

from drivax.scenario.schema import AgentKind
from drivax.simulator.idm import IdmParameters
from drivax.synthetic.roads.curves import STEP_M, Curve, Pose, resample
from drivax.synthetic.roads.network import RoadNetwork
from drivax.synthetic.traffic.paths import Path


@dataclass(frozen=True)
class Drivers:
    """Vehicles (and cyclists) and their drivers, one entry per vehicle.

    Attributes:
        kind: ``AgentKind``: VEHICLE or CYCLIST.
        size_m: Length, width and height.
        speed_factor: Preferred speed as a multiple of the limit.
        top_speed_mps: Maximum speed, independent of the limit.
        lateral_mps2: Largest lateral acceleration in bends.
        slowing_mps2: Deceleration towards slower stretches.
        yellow_mps2: Largest deceleration to stop at yellow.
        jerk_mps3: Jerk in ordinary driving.
        headway_s, acceleration_mps2, braking_mps2: Parameters of the IDM.
        politeness: Weight of others' accelerations in lane changes (MOBIL).
        reaction_s: Delay between a decision and its execution.
        critical_gap_s: Smallest accepted time gap to vehicles with priority.
    """

    kind: Int8[np.ndarray, " vehicle"]
    size_m: Float64[np.ndarray, "vehicle 3"]
    speed_factor: Float64[np.ndarray, " vehicle"]
    top_speed_mps: Float64[np.ndarray, " vehicle"]
    lateral_mps2: Float64[np.ndarray, " vehicle"]
    slowing_mps2: Float64[np.ndarray, " vehicle"]
    yellow_mps2: Float64[np.ndarray, " vehicle"]
    jerk_mps3: Float64[np.ndarray, " vehicle"]
    headway_s: Float64[np.ndarray, " vehicle"]
    acceleration_mps2: Float64[np.ndarray, " vehicle"]
    braking_mps2: Float64[np.ndarray, " vehicle"]
    politeness: Float64[np.ndarray, " vehicle"]
    reaction_s: Float64[np.ndarray, " vehicle"]
    critical_gap_s: Float64[np.ndarray, " vehicle"]

    def idm(self, rows: slice | np.ndarray = slice(None)) -> IdmParameters:
        """Parameters of the IDM of all or some drivers."""
        return IdmParameters(
            headway_s=self.headway_s[rows],
            acceleration_mps2=self.acceleration_mps2[rows],
            comfortable_braking_mps2=self.braking_mps2[rows],
        )

    @property
    def cyclist(self) -> Bool[np.ndarray, " vehicle"]:
        """Mask of cyclists."""
        return self.kind == AgentKind.CYCLIST

    def select(self, rows: np.ndarray) -> Drivers:
        """Return the drivers of some rows (indices or a mask), in that order."""
        return Drivers(**{name: value[rows] for name, value in vars(self).items()})

    def with_headway(self, row: int, headway_s: float) -> Drivers:
        """Return the drivers with one time gap changed."""
        headways = self.headway_s.copy()
        headways[row] = headway_s
        return replace(self, headway_s=headways)


@dataclass(frozen=True)
class Pedestrian:
    """A pedestrian that walks along a curve and waits at kerbs.

    Attributes:
        curve: Along a sidewalk, or over a crossing from one sidewalk to the other.
        start_m: Position along the curve when the warm-up begins.
        speed_mps: Free walking speed.
        crossing: Index of the crossing on the curve (-1: none).
        kerb_m, across_m: Positions along the curve of the kerbs before and after the crossing.
        size_m: Length, width, height.
    """

    curve: Curve
    start_m: float
    speed_mps: float
    crossing: int = -1
    kerb_m: float = 0.0
    across_m: float = 0.0
    size_m: tuple[float, float, float] = (0.6, 0.6, 1.75)

    @cached_property
    def samples(self) -> Curve:
        """The curve at equal distances of about ``STEP_M``, which all runs of a traffic share."""
        return resample(self.curve, STEP_M)


@dataclass(frozen=True)
class ScriptedUser:
    """A road user with a fixed trajectory, parked or an actor of an event; at negative speeds it reverses."""

    kind: AgentKind
    size_m: tuple[float, float, float]
    xy: Float64[np.ndarray, "time 2"]
    heading: Float64[np.ndarray, " time"]
    speed: Float64[np.ndarray, " time"]
    valid: Bool[np.ndarray, " time"]

    @classmethod
    def from_pose(
        cls, kind: AgentKind, size_m: tuple[float, float, float], pose: Pose, steps: int
    ) -> ScriptedUser:
        """Return a user that never moves."""
        xy = np.tile([pose.x, pose.y], (steps, 1))
        return cls(kind, size_m, xy, np.full(steps, pose.heading), np.zeros(steps), np.ones(steps, bool))

    @property
    def is_static(self) -> bool:
        """Whether the user exists and stands still at all steps."""
        return bool(self.valid.all() and not self.speed.any() and not np.ptp(self.xy, axis=0).any())


@dataclass(frozen=True)
class Roles:
    """All users of a scenario; row 0 of ``paths`` and ``drivers`` is ego.

    Attributes:
        paths: Paths of vehicles and of cyclists on lanes.
        distance_m, speed_mps: Initial positions of the vehicles' centres along the paths, and initial speeds.
        route: Lanes of ego's intended route, in order.
        parked: Cars parked next to or in the lanes.
    """

    network: RoadNetwork
    paths: list[Path]
    drivers: Drivers
    distance_m: Float64[np.ndarray, " vehicle"]
    speed_mps: Float64[np.ndarray, " vehicle"]
    route: tuple[int, ...]
    pedestrians: tuple[Pedestrian, ...] = ()
    parked: tuple[ScriptedUser, ...] = ()


@dataclass(frozen=True)
class Override:
    """Upper bound on a vehicle's acceleration from one step to another (both included)."""

    vehicle: int
    first_step: int
    last_step: int
    acceleration_mps2: float


@dataclass(frozen=True)
class Tailgate:
    """Time gap of a vehicle to its leader, which replaces its driver's headway."""

    vehicle: int
    headway_s: float


@dataclass(frozen=True)
class Staging:
    """Changes of an event to traffic.

    Attributes:
        extras: Additional users.
        removed: Rows of vehicles that would prevent the event and do not take part.
    """

    overrides: tuple[Override, ...] = ()
    extras: tuple[ScriptedUser, ...] = ()
    tailgates: tuple[Tailgate, ...] = ()
    removed: tuple[int, ...] = ()


@dataclass(frozen=True)
class EgoPlan:
    """Ego's planned pose and signed speed from a given step on."""

    first_step: int
    xy: Float64[np.ndarray, "time 2"]
    heading: Float64[np.ndarray, " time"]
    speed: Float64[np.ndarray, " time"]


@dataclass(frozen=True)
class Motion:
    """Motion of all users, in this order: vehicles and cyclists (ego first), pedestrians, parked, extras.

    Attributes:
        xy, heading, speed: Pose of the box centre and signed speed along the heading.
        valid: Mask of the steps at which a user is on the map.
        distance_m: Position along the path that each vehicle follows at the step.
        acceleration: Acceleration of each vehicle from each step to the next one.
        paths: Path of each vehicle at the last step of the run; empty: those of the roles.
    """

    kind: Int8[np.ndarray, " user"]
    size_m: Float64[np.ndarray, "user 3"]
    xy: Float64[np.ndarray, "user time 2"]
    heading: Float64[np.ndarray, "user time"]
    speed: Float64[np.ndarray, "user time"]
    valid: Bool[np.ndarray, "user time"]
    distance_m: Float64[np.ndarray, "vehicle time"]
    acceleration: Float64[np.ndarray, "vehicle time"]
    paths: list[Path] = field(default_factory=list)

    @property
    def vehicles(self) -> int:
        """Number of vehicles and cyclists on paths."""
        return len(self.distance_m)

    def from_step(self, step: int) -> Motion:
        """Return the motion from a given step on."""
        return self._select_steps(slice(step, None))

    def before_step(self, step: int) -> Motion:
        """Return the motion before a step."""
        return self._select_steps(slice(step))

    def every_nth(self, stride: int) -> Motion:
        """Return the motion at every n-th step."""
        return self._select_steps(slice(None, None, stride))

    def _select_steps(self, steps: slice) -> Motion:
        """Return the motion at some steps."""
        names = ("xy", "heading", "speed", "valid", "distance_m", "acceleration")
        return replace(self, **{name: getattr(self, name)[:, steps] for name in names})
