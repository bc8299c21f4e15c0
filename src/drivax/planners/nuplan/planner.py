"""Drive by a planner with nuPlan's interface (``AbstractPlanner``), called outside the compiled program.

Each episode gets an instance of its own. What it plans is tracked by the controller of the task.
"""

from __future__ import annotations

import copy
import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from drivax.errors import UsageError
from drivax.geometry.vectors import wrap
from drivax.planners.functions import PlannerError, error_text, python_actions
from drivax.planners.nuplan import interface as nuplan
from drivax.planners.nuplan.map import MapApi
from drivax.planners.nuplan.poses import BUFFER
from drivax.scenario.bank.columns import SizeColumn
from drivax.scenario.bank.scenario_bank import ScenarioBank, last_used
from drivax.scenario.record import record, static
from drivax.scenario.schema import DT_S, AgentKind, LightState, Scenario
from drivax.simulator.types import HISTORY, MOTION_SPEED, SimState, Situation
from drivax.tasks.actions import ActionSpace, Trajectory

#: Below these the steering angle of a logged motion (m/s), and its slip (m in a step), are taken as zero.
_STILL_MPS, _STILL_M = 0.5, 0.02
#: Latest time at which a plan may start, after the present one, s.
_LATE_S = 1e-3
_PLANS = "compute_planner_trajectory"


def is_nuplan(thing: Any) -> bool:
    """Return whether a class or object has nuPlan's interface of planners."""
    return callable(getattr(thing, _PLANS, None))


@record
class NuplanPlanner:
    """A planner with nuPlan's interface; without the action space ``trajectory`` its first poses are followed.

    Attributes:
        host: Instances and scenarios.
        actions: Action space.
    """

    host: Host = static()
    actions: ActionSpace = static(default=Trajectory())
    replays: bool = static(default=False)

    @property
    def name(self) -> str:
        """The planner's own name."""
        return self.host.name

    def prepare(self, scenario_of: Callable[[int], Scenario]) -> None:
        """Tell where the scenarios are, by their identity in the bank."""
        self.host.scenario_of = scenario_of

    def init(self, bank: ScenarioBank, state: SimState, key: Array) -> tuple[()]:
        """Return an empty carry: the instances remember."""
        return ()

    def act(
        self, carry: Any, bank: ScenarioBank, state: SimState, situation: Situation, observation: Any, key: Array
    ) -> tuple[Float[Array, " D"], Any]:  # fmt: skip
        """Return the action that follows the plan; NaN where the planner raised an error."""
        context, frame = situation.context, situation.surroundings.frame
        tracked = self.actions if isinstance(self.actions, Trajectory) else None
        steps = tracked.steps if tracked else 2
        # Under another action space the actuators are not known.
        actuators = context.action[:3] if tracked else jnp.full(3, jnp.nan)
        identity = bank.identity[context.index]
        seen = (identity, state.start, context.step, context.history, actuators, frame)
        plan = python_actions(partial(self.host.plan, steps), identity, context.step, seen, 3 * (steps + 1))
        if tracked:
            return plan, carry
        poses, motion = plan.reshape(-1, 3), context.history[-1]
        speeds = jnp.linalg.norm(jnp.diff(poses[:, :2], axis=0), axis=-1) / DT_S
        target, beyond = (jnp.append(poses[k], speeds[k - 1]) for k in (1, 2))
        return self.actions.expert(motion, target, beyond, bank.length_m(context.index, context.slot)), carry


@dataclass
class _Episode:
    """A planner in a scenario: its memory, and its last plan."""

    planner: Any
    view: View
    egos: deque[nuplan.EgoState]
    seen: deque[nuplan.DetectionsTracks]
    step: int
    inputs: Any = None
    plan: Any = None


class Host:
    """Instances of a planner, one per episode.

    Args:
        thing: Class of the planner, or an instance, which is copied.
        name: Its dotted name, for messages.
    """

    def __init__(self, thing: Any, name: str) -> None:
        self._make = thing if isinstance(thing, type) else partial(copy.deepcopy, thing)
        try:
            planner = self._make()
            self.name = str(planner.name())
        except Exception as error:
            raise UsageError(f"planner {name!r}: {error_text(error)}", cure="fix the planner") from error
        kind = (
            getattr(planner.observation_type(), "__name__", "")
            if hasattr(planner, "observation_type")
            else ""
        )
        if kind not in ("", "DetectionsTracks"):
            raise UsageError(f"planner {name!r} observes {kind}", cure="only DetectionsTracks are known")
        self.scenario_of: Callable[[int], Scenario] | None = None
        self._episodes: dict[int, _Episode] = {}
        self._failures: dict[int, PlannerError] = {}

    def plan(self, steps: int, identity: Any, start: Any, step: Any, *seen: Any) -> Float[np.ndarray, "n 3"]:
        """Return the planned poses of the box centre from now on, in the scenario's frame."""
        number, step = int(identity), int(step)
        episode = self._episodes.get(number)
        # A short batch repeats its last scenario.
        if episode is not None and episode.step == step and _equal(episode.inputs, seen):
            return episode.plan
        try:
            if step == int(start):
                episode = self._begin(number, step, seen[0])
            if episode is None or episode.step != step - 1:
                raise self._failures.get(number) or PlannerError("the episode did not start here")
            episode.plan = self._plan(episode, steps, step, int(start), *seen)
        except PlannerError as error:
            self._failures[number] = error
            self._episodes.pop(number, None)
            raise
        episode.step, episode.inputs = step, seen
        return episode.plan

    def _begin(self, number: int, step: int, history: Any) -> _Episode:
        if self.scenario_of is None:
            raise UsageError(
                f"planner {self.name} needs stored scenarios", cure="evaluate a set or drivax.load"
            )
        self._episodes = {key: old for key, old in self._episodes.items() if old.step <= step}
        self._failures.pop(number, None)
        view, planner = View(self.scenario_of(number)), self._make()
        earlier, size = range(step - BUFFER, step), BUFFER + 1
        egos = [view.ego(past, history[: HISTORY - step + past]) for past in earlier]
        seen = [view.logged(past) for past in earlier]
        _call(planner.initialize, view.initialization())
        episode = _Episode(planner, view, deque(egos, size), deque(seen, size), step - 1)
        self._episodes[number] = episode
        return episode

    def _plan(
        self, episode: _Episode, steps: int, step: int, start: int, history: Any, actuators: Any, frame: Any
    ) -> Float[np.ndarray, "n 3"]:
        view = episode.view
        last = episode.egos[-1].dynamic_car_state if step > start else None
        episode.egos.append(view.ego(step, history, actuators, last))
        episode.seen.append(view.tracks(step, frame.box, frame.velocity, frame.valid, frame.kind))
        iteration = nuplan.SimulationIteration(nuplan.TimePoint.of_step(step), step - start)
        buffer = nuplan.SimulationHistoryBuffer(list(episode.egos), list(episode.seen))
        known = nuplan.PlannerInput(iteration, buffer, view.lights(step, frame.lights))
        return view.poses(_call(getattr(episode.planner, _PLANS), known), step, steps)


class View:
    """A scenario in nuPlan's terms."""

    def __init__(self, scenario: Scenario) -> None:
        self.scenario, self.map = scenario, MapApi(scenario)
        self.origin = np.asarray(scenario.origin, np.float64)[:2]
        self.vehicle = nuplan.VehicleParameters(*np.asarray(scenario.agent_size[0], np.float64).tolist())
        # Slots of a frame: moving agents, then parked ones.
        moving, parked = (
            int(last_used(valid.any(0)[None])[0]) for valid in (scenario.agent_valid, scenario.parked_valid)
        )
        self._tracks = np.concatenate([scenario.agent_id[:moving], scenario.parked_id[:parked]]).tolist()
        sizes = np.concatenate([scenario.agent_size[:moving], scenario.parked_size[:parked]])
        self._heights, self._moving, self._parked = sizes[:, SizeColumn.HEIGHT].tolist(), moving, parked

    def initialization(self) -> nuplan.PlannerInitialization:
        """Return route, goal and map."""
        scenario, count = self.scenario, int(self.scenario.route_points[0])
        rows = dict.fromkeys(int(row) for row in scenario.route_lane[0, :count] if int(row) in self.map.lanes)
        blocks = [self.map.block_of[row] for row in rows]
        route = [name for k, name in enumerate(blocks) if k == 0 or name != blocks[k - 1]]
        if not route:
            raise PlannerError(f"scenario {scenario.text('scenario_id')} has no route")
        # The devkit's planners take two roadblocks for granted.
        if len(route) < 2:
            following = self.map.blocks[route[0]].outgoing_edges
            route += [block.id for block in following if block.id not in route][:1]
        goal = np.asarray(scenario.goal_xy, np.float64)
        heading = float(scenario.agent_heading[scenario.current_step, 0])
        if count:
            away = np.linalg.norm(scenario.route_xy[0, :count] - goal, axis=1)
            heading = float(scenario.route_heading[0, away.argmin()])
        x, y = (goal + self.origin).tolist()
        return nuplan.PlannerInitialization(route, nuplan.StateSE2(x, y, heading), self.map)

    def ego(
        self, step: int, history: Any, actuators: Any = None, last: nuplan.DynamicCarState | None = None
    ) -> nuplan.EgoState:
        """Return ego at a step, measured from its motions until then.

        ``actuators`` (if finite) give acceleration and steering; with the ``last`` driven state, speed and steering
        give the yaw rate, as in nuPlan's vehicle model.
        """
        now, before, earlier = (np.asarray(history[-k], np.float64) for k in (1, 2, 3))
        x, y, heading, speed = now.tolist()
        turn = [float(wrap(b[2] - a[2])) / DT_S for a, b in ((earlier, before), (before, now))]
        speeds = _axle_speed(earlier, before), _axle_speed(before, now)
        wheelbase, yaw_rate, rate = self.vehicle.wheel_base, turn[1], 0.0
        acceleration, change = (speeds[1] - speeds[0]) / DT_S, (turn[1] - turn[0]) / DT_S
        steering = math.atan(turn[1] * wheelbase / speed) if speed > _STILL_MPS else 0.0
        if actuators is not None and np.isfinite(actuators).all():
            acceleration, steering, rate = (float(value) for value in actuators)
            steering += rate * DT_S
            if last is not None:
                speeds, yaw_rate = (0.0, speed), speed * math.tan(steering) / wheelbase
                change = (yaw_rate - last.angular_velocity) / DT_S
        dynamic = nuplan.DynamicCarState(
            nuplan.StateVector2D(speeds[1], 0.0), nuplan.StateVector2D(acceleration, 0.0),
            yaw_rate, change, rate, self.vehicle.rear_axle_to_center,
        )  # fmt: skip
        centre = nuplan.StateSE2(x + float(self.origin[0]), y + float(self.origin[1]), heading)
        vehicle = self.vehicle
        box = nuplan.CarFootprint(centre, vehicle.length, vehicle.width, vehicle.height, vehicle)
        return nuplan.EgoState(box, dynamic, steering, nuplan.TimePoint.of_step(step))

    def tracks(self, step: int, box: Any, velocity: Any, valid: Any, kind: Any) -> nuplan.DetectionsTracks:
        """Return the other agents of a frame."""
        time_us, tracked = nuplan.TimePoint.of_step(step).time_us, []
        for slot in np.flatnonzero(valid)[1 if valid[0] else 0 :].tolist():
            x, y, cos, sin, length, width = np.asarray(box[slot], np.float64).tolist()
            centre = nuplan.StateSE2(x + self.origin[0], y + self.origin[1], math.atan2(sin, cos))
            own = nuplan.OrientedBox(centre, length, width, self._heights[slot])
            moves = nuplan.StateVector2D(*np.asarray(velocity[slot], np.float64).tolist())
            number = self._tracks[slot]
            of_kind = nuplan.TYPE_OF_KIND.get(
                AgentKind(int(kind[slot])), nuplan.TrackedObjectType.GENERIC_OBJECT
            )
            tracked.append(nuplan.TrackedObject(of_kind, own, moves, str(number), number, time_us))
        tracked.sort(key=lambda item: item.tracked_object_type.value)
        return nuplan.DetectionsTracks(nuplan.TrackedObjects(tracked))

    def logged(self, step: int) -> nuplan.DetectionsTracks:
        """Return the other agents as logged; before the log they keep their first velocity."""
        s, a, p, time, step = self.scenario, self._moving, self._parked, step, max(step, 0)
        early_s = (time - step) * DT_S
        xy = np.concatenate([s.agent_xy[step, :a] + early_s * s.agent_velocity[step, :a], s.parked_xy[:p]])
        heading = np.concatenate([s.agent_heading[step, :a], s.parked_heading[:p]])
        size = np.concatenate([s.agent_size[:a, :2], s.parked_size[:p, :2]])
        box = np.concatenate([xy, np.cos(heading)[:, None], np.sin(heading)[:, None], size], axis=1)
        velocity = np.concatenate([s.agent_velocity[step, :a], np.zeros((p, 2))])
        valid = np.concatenate([s.agent_valid[step, :a], s.parked_valid[step, :p]])
        return self.tracks(time, box, velocity, valid, np.concatenate([s.agent_kind[:a], s.parked_kind[:p]]))

    def lights(self, step: int, states: Any) -> list[nuplan.TrafficLightStatusData]:
        """Return the observed traffic lights of lanes of the map."""
        time_us, unknown = nuplan.TimePoint.of_step(step).time_us, nuplan.TrafficLightStatusType.UNKNOWN
        statuses = []
        for lane, state in zip(self.scenario.light_lane.tolist(), np.asarray(states).tolist(), strict=False):
            if lane in self.map.lanes and state >= 0:
                status = nuplan.STATUS_OF_LIGHT.get(LightState(state), unknown)
                number = int(self.scenario.lane_id[lane])
                statuses.append(nuplan.TrafficLightStatusData(status, number, time_us))
        return statuses

    def poses(self, trajectory: Any, step: int, steps: int) -> Float[np.ndarray, "n 3"]:
        """Return the poses of the box centre on a trajectory, 0.1 s apart from now on.

        Positions and headings are interpolated; beyond the trajectory they continue as at its end.
        """
        rows = _call(_rows, trajectory)
        if len(rows) < 2:
            raise PlannerError(f"a trajectory of {len(rows)} states; return two or more")
        time, x, y, heading = np.array(rows).T
        now = nuplan.TimePoint.of_step(step).time_s
        if time[0] > now + _LATE_S or time[-1] <= now:
            raise PlannerError(f"the trajectory is from {time[0]:g} to {time[-1]:g} s, and it is {now:g} s")
        if (np.diff(time) <= 0).any():
            raise PlannerError("the times of the trajectory do not increase")
        at, heading = now + np.arange(steps + 1) * DT_S, np.unwrap(heading)
        x, y, heading = (_interpolated(at, time, values) for values in (x, y, heading))
        ahead = self.vehicle.rear_axle_to_center
        centre = np.stack([x + ahead * np.cos(heading), y + ahead * np.sin(heading)], axis=-1) - self.origin
        return np.column_stack([centre, wrap(heading)]).astype(np.float32)


def _call(function: Callable[[Any], Any], argument: Any) -> Any:
    """Call the planner; its errors become a line that names their place in its code."""
    try:
        return function(argument)
    except Exception as error:
        raise PlannerError(error_text(error)) from error


def _rows(trajectory: Any) -> list[tuple[float, float, float, float]]:
    """Time (s) and pose of the rear axle of every state of a trajectory."""
    sampled = getattr(trajectory, "get_sampled_trajectory", None)
    states = trajectory if sampled is None else sampled()
    poses = [(state.time_point.time_us * 1e-6, state.rear_axle) for state in states]
    return [(time_s, float(pose.x), float(pose.y), float(pose.heading)) for time_s, pose in poses]


def _axle_speed(before: Any, now: Any) -> float:
    """Speed of the rear axle: that of the centre, along the heading."""
    dx, dy = now[:2] - before[:2]
    if math.hypot(dx, dy) < _STILL_M:
        return float(now[MOTION_SPEED])
    slip = math.atan2(dy, dx) - before[2] - float(wrap(now[2] - before[2])) / 2
    return float(now[MOTION_SPEED]) * math.cos(slip)


def _interpolated(at: Any, time: Any, values: Any) -> Any:
    """Linear interpolation; beyond the last time the last slope goes on."""
    slope = (values[-1] - values[-2]) / (time[-1] - time[-2])
    return np.interp(at, time, values) + np.maximum(at - time[-1], 0.0) * slope


def _equal(a: Any, b: Any) -> bool:
    """Return whether two trees of arrays are equal, NaN included."""
    pairs = zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    return all(np.array_equal(x, y, equal_nan=x.dtype.kind == "f") for x, y in pairs)
