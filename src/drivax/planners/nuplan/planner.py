"""Run planners with nuPlan's interface (``AbstractPlanner``) outside the compiled program.

Each episode gets its own instance. The controller of the action space ``trajectory`` tracks the planned poses.
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
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.bank.sizes import last_used
from drivax.scenario.record import record, static
from drivax.scenario.schema import DT_S, AgentKind, LightState, Scenario
from drivax.simulator.types import HISTORY, MOTION_SPEED, SimState, Situation
from drivax.tasks.actions import ActionSpace, Trajectory, follow_log

#: Speed below which the steering angle of a logged motion counts as zero, m/s.
_STILL_MPS = 0.5
#: Movement in a step below which the slip of a logged motion counts as zero, m.
_STILL_M = 0.02
#: Tolerance for a plan that starts after the present time, s.
_LATE_S = 1e-3
_PLAN_METHOD = "compute_planner_trajectory"


def is_nuplan(candidate: Any) -> bool:
    """Return whether a class or object has nuPlan's interface of planners."""
    return callable(getattr(candidate, _PLAN_METHOD, None))


@record
class NuplanPlanner:
    """A planner with nuPlan's interface; action spaces other than ``trajectory`` follow its first poses.

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
        """Set the function that returns a scenario by its identity in the bank."""
        self.host.scenario_of = scenario_of

    def init(self, bank: ScenarioBank, state: SimState, key: Array) -> tuple[()]:
        """Return an empty carry; the memory is in the instances."""
        return ()

    def act(
        self, carry: Any, bank: ScenarioBank, state: SimState, situation: Situation, observation: Any, key: Array
    ) -> tuple[Float[Array, " D"], Any]:  # fmt: skip
        """Return the action that follows the plan; errors of the planner as in :func:`python_actions`."""
        context, frame = situation.context, situation.surroundings.frame
        trajectory = self.actions if isinstance(self.actions, Trajectory) else None
        steps = trajectory.steps if trajectory else 2
        # In other action spaces, the actuators are unknown.
        actuators = context.action[:3] if trajectory else jnp.full(3, jnp.nan)
        identity = bank.identity[context.index]
        inputs = (identity, state.start, context.step, context.history, actuators, frame)
        plan = python_actions(partial(self.host.plan, steps), identity, context.step, inputs, 3 * (steps + 1))
        if trajectory:
            return plan, carry
        poses = plan.reshape(-1, 3)
        speeds = jnp.linalg.norm(jnp.diff(poses[:, :2], axis=0), axis=-1) / DT_S
        first, second = (jnp.append(poses[k], speeds[k - 1]) for k in (1, 2))
        return follow_log(self.actions, bank, context, first, second), carry


@dataclass
class _Episode:
    """An instance of a planner in a scenario, with its history and its last plan."""

    planner: Any
    view: ScenarioView
    egos: deque[nuplan.EgoState]
    observations: deque[nuplan.DetectionsTracks]
    step: int
    inputs: Any = None
    plan: Any = None


class Host:
    """Instances of a planner, one per episode.

    Args:
        candidate: Class of the planner, or an instance to copy.
        name: Dotted name of the planner, for messages.

    Raises:
        UsageError: The planner cannot be made, or observes something other than ``DetectionsTracks``.
    """

    def __init__(self, candidate: Any, name: str) -> None:
        self._make = candidate if isinstance(candidate, type) else partial(copy.deepcopy, candidate)
        try:
            planner = self._make()
            self.name = str(planner.name())
            observation_type = getattr(planner, "observation_type", lambda: None)()
        except Exception as error:
            raise UsageError(f"planner {name!r}: {error_text(error)}", cure="fix the planner") from error
        observation_name = getattr(observation_type, "__name__", "")
        if observation_name not in ("", "DetectionsTracks"):
            cure = "only DetectionsTracks are known"
            raise UsageError(f"planner {name!r} observes {observation_name}", cure=cure)
        self.scenario_of: Callable[[int], Scenario] | None = None
        self._episodes: dict[int, _Episode] = {}
        self._failures: dict[int, PlannerError] = {}

    def plan(
        self, steps: int, identity: Any, start: Any, step: Any, *inputs: Any
    ) -> Float[np.ndarray, "n 3"]:
        """Return the planned poses of the box centre now and in the next ``steps`` steps, in the scenario's frame.

        ``inputs`` are history, actuators and frame at ``step``; ``start`` is the first step of the episode.

        Raises:
            PlannerError: The planner raises an error, now or at an earlier step, returns no trajectory from now on, or
                did not plan every step of the episode.
        """
        identity, start, step = int(identity), int(start), int(step)
        episode = self._episodes.get(identity)
        # A short batch repeats its last scenario, whose step must not be planned twice.
        if episode is not None and episode.step == step and _equal(episode.inputs, inputs):
            return episode.plan
        try:
            if step == start:
                episode = self._start_episode(identity, step, inputs[0])
            if episode is None or episode.step != step - 1:
                raise self._failures.get(identity) or PlannerError(
                    "the episode did not start with this planner"
                )
            episode.plan = self._plan(episode, steps, step, start, *inputs)
        except PlannerError as error:
            self._failures[identity] = error
            self._episodes.pop(identity, None)
            raise
        episode.step, episode.inputs = step, inputs
        return episode.plan

    def _start_episode(self, identity: int, step: int, history: Any) -> _Episode:
        """Make and initialise an instance with the logged history.

        Episodes of a batch advance together, so those at later steps are over: forget them.
        """
        if self.scenario_of is None:
            raise UsageError(
                f"planner {self.name} needs stored scenarios", cure="evaluate a set or drivax.load"
            )
        self._episodes = {key: episode for key, episode in self._episodes.items() if episode.step <= step}
        self._failures.pop(identity, None)
        view, planner = ScenarioView(self.scenario_of(identity)), self._make()
        past_steps, size = range(step - BUFFER, step), BUFFER + 1
        egos = [view.ego(past, history[: HISTORY - step + past]) for past in past_steps]
        observations = [view.logged_tracks(past) for past in past_steps]
        _call(planner.initialize, view.initialization())
        episode = _Episode(planner, view, deque(egos, size), deque(observations, size), step - 1)
        self._episodes[identity] = episode
        return episode

    def _plan(
        self, episode: _Episode, steps: int, step: int, start: int, history: Any, actuators: Any, frame: Any
    ) -> Float[np.ndarray, "n 3"]:
        """Append the present state to the episode's history, and return the poses of the planner's trajectory."""
        view = episode.view
        last_state = episode.egos[-1].dynamic_car_state if step > start else None
        episode.egos.append(view.ego(step, history, actuators, last_state))
        episode.observations.append(view.tracks(step, frame.box, frame.velocity, frame.valid, frame.kind))
        iteration = nuplan.SimulationIteration(nuplan.TimePoint.of_step(step), step - start)
        buffer = nuplan.SimulationHistoryBuffer(list(episode.egos), list(episode.observations))
        planner_input = nuplan.PlannerInput(iteration, buffer, view.lights(step, frame.lights))
        return view.poses(_call(getattr(episode.planner, _PLAN_METHOD), planner_input), step, steps)


class ScenarioView:
    """A scenario in nuPlan's terms; poses are in the source's frame."""

    def __init__(self, scenario: Scenario) -> None:
        self.scenario, self.map = scenario, MapApi(scenario)
        self.origin = np.asarray(scenario.origin, np.float64)[:2]
        self.vehicle = nuplan.VehicleParameters(*np.asarray(scenario.agent_size[0], np.float64).tolist())
        # Slots of a frame: moving agents, then parked ones.
        moving, parked = (
            int(last_used(valid.any(0)[None])[0]) for valid in (scenario.agent_valid, scenario.parked_valid)
        )
        self._track_ids = np.concatenate([scenario.agent_id[:moving], scenario.parked_id[:parked]]).tolist()
        sizes = np.concatenate([scenario.agent_size[:moving], scenario.parked_size[:parked]])
        self._heights = sizes[:, SizeColumn.HEIGHT].tolist()
        self._moving_count, self._parked_count = moving, parked

    def initialization(self) -> nuplan.PlannerInitialization:
        """Return route, goal and map."""
        scenario, count = self.scenario, int(self.scenario.route_points[0])
        goal = np.asarray(scenario.goal_xy, np.float64)
        heading = float(scenario.agent_heading[scenario.current_step, 0])
        if count:
            distance = np.linalg.norm(scenario.route_xy[0, :count] - goal, axis=1)
            heading = float(scenario.route_heading[0, distance.argmin()])
        x, y = (goal + self.origin).tolist()
        return nuplan.PlannerInitialization(self._route(), nuplan.StateSE2(x, y, heading), self.map)

    def _route(self) -> list[str]:
        """Return the roadblocks of the route, extended by a successor if there is only one.

        Raises:
            PlannerError: The scenario has no route on lanes.
        """
        scenario, count = self.scenario, int(self.scenario.route_points[0])
        indices = map(int, scenario.route_lane[0, :count])
        lanes = dict.fromkeys(index for index in indices if index in self.map.lanes)
        blocks = [self.map.block_of[index] for index in lanes]
        route = [name for k, name in enumerate(blocks) if k == 0 or name != blocks[k - 1]]
        if not route:
            raise PlannerError(f"scenario {scenario.text('scenario_id')} has no route")
        # The devkit's planners assume at least two roadblocks.
        if len(route) < 2:
            successors = self.map.blocks[route[0]].outgoing_edges
            route += [block.id for block in successors if block.id not in route][:1]
        return route

    def ego(
        self, step: int, history: Any, actuators: Any = None, last: nuplan.DynamicCarState | None = None
    ) -> nuplan.EgoState:
        """Return ego at a step, computed from its motions until then.

        ``history`` holds the motions up to the step. ``actuators`` (acceleration, steering angle and steering rate of
        the last step) determine acceleration and steering; if None or not finite, the motions do. With the ``last``
        simulated state, speed and steering determine the yaw rate, as in nuPlan's vehicle model.
        """
        now, before, earlier = (np.asarray(history[-k], np.float64) for k in (1, 2, 3))
        x, y, heading, speed = now.tolist()
        last_yaw_rate, yaw_rate = (
            float(wrap(b[2] - a[2])) / DT_S for a, b in ((earlier, before), (before, now))
        )
        last_axle_speed, axle_speed = _axle_speed(earlier, before), _axle_speed(before, now)
        wheelbase, steering_rate = self.vehicle.wheel_base, 0.0
        acceleration = (axle_speed - last_axle_speed) / DT_S
        yaw_acceleration = (yaw_rate - last_yaw_rate) / DT_S
        steering = math.atan(yaw_rate * wheelbase / speed) if speed > _STILL_MPS else 0.0
        if actuators is not None and np.isfinite(actuators).all():
            # The steering angle is that at the start of the last step.
            acceleration, steering, steering_rate = (float(value) for value in actuators)
            steering += steering_rate * DT_S
            if last is not None:
                axle_speed, yaw_rate = speed, speed * math.tan(steering) / wheelbase
                yaw_acceleration = (yaw_rate - last.angular_velocity) / DT_S
        dynamic = nuplan.DynamicCarState(
            nuplan.StateVector2D(axle_speed, 0.0), nuplan.StateVector2D(acceleration, 0.0),
            yaw_rate, yaw_acceleration, steering_rate, self.vehicle.rear_axle_to_center,
        )  # fmt: skip
        centre = nuplan.StateSE2(x + float(self.origin[0]), y + float(self.origin[1]), heading)
        vehicle = self.vehicle
        box = nuplan.CarFootprint(centre, vehicle.length, vehicle.width, vehicle.height, vehicle)
        return nuplan.EgoState(box, dynamic, steering, nuplan.TimePoint.of_step(step))

    def tracks(self, step: int, box: Any, velocity: Any, valid: Any, kind: Any) -> nuplan.DetectionsTracks:
        """Return the agents of a frame other than ego."""
        time_us, objects = nuplan.TimePoint.of_step(step).time_us, []
        for slot in np.flatnonzero(valid).tolist():
            if slot == 0:  # ego
                continue
            x, y, cos, sin, length, width = np.asarray(box[slot], np.float64).tolist()
            centre = nuplan.StateSE2(x + self.origin[0], y + self.origin[1], math.atan2(sin, cos))
            oriented_box = nuplan.OrientedBox(centre, length, width, self._heights[slot])
            vector = nuplan.StateVector2D(*np.asarray(velocity[slot], np.float64).tolist())
            track_id, agent_kind = self._track_ids[slot], AgentKind(int(kind[slot]))
            object_type = nuplan.TYPE_OF_KIND.get(agent_kind, nuplan.TrackedObjectType.GENERIC_OBJECT)
            objects.append(
                nuplan.TrackedObject(object_type, oriented_box, vector, str(track_id), track_id, time_us)
            )
        objects.sort(key=lambda item: item.tracked_object_type.value)
        return nuplan.DetectionsTracks(nuplan.TrackedObjects(objects))

    def logged_tracks(self, step: int) -> nuplan.DetectionsTracks:
        """Return the agents other than ego as logged; before the log, they keep their first velocity."""
        scenario, moving, parked = self.scenario, slice(self._moving_count), slice(self._parked_count)
        log_step = max(step, 0)
        velocity = scenario.agent_velocity[log_step, moving]
        moving_xy = scenario.agent_xy[log_step, moving] + (step - log_step) * DT_S * velocity
        xy = np.concatenate([moving_xy, scenario.parked_xy[parked]])
        heading = np.concatenate([scenario.agent_heading[log_step, moving], scenario.parked_heading[parked]])
        size = np.concatenate([scenario.agent_size[moving, :2], scenario.parked_size[parked, :2]])
        box = np.concatenate([xy, np.cos(heading)[:, None], np.sin(heading)[:, None], size], axis=1)
        velocity = np.concatenate([velocity, np.zeros((self._parked_count, 2))])
        valid = np.concatenate(
            [scenario.agent_valid[log_step, moving], scenario.parked_valid[log_step, parked]]
        )
        kind = np.concatenate([scenario.agent_kind[moving], scenario.parked_kind[parked]])
        return self.tracks(step, box, velocity, valid, kind)

    def lights(self, step: int, states: Any) -> list[nuplan.TrafficLightStatusData]:
        """Return the observed traffic lights of the map's lanes."""
        time_us, unknown = nuplan.TimePoint.of_step(step).time_us, nuplan.TrafficLightStatusType.UNKNOWN
        statuses = []
        for lane, state in zip(self.scenario.light_lane.tolist(), np.asarray(states).tolist(), strict=False):
            if lane in self.map.lanes and state >= 0:
                status = nuplan.STATUS_OF_LIGHT.get(LightState(state), unknown)
                lane_id = int(self.scenario.lane_id[lane])
                statuses.append(nuplan.TrafficLightStatusData(status, lane_id, time_us))
        return statuses

    def poses(self, trajectory: Any, step: int, steps: int) -> Float[np.ndarray, "n 3"]:
        """Return the poses of the box centre on a trajectory, 0.1 s apart from now on.

        Positions and headings are interpolated, and extrapolated after the end.
        """
        states = _call(_read_states, trajectory)
        if len(states) < 2:
            raise PlannerError(f"a trajectory of {len(states)} states; return two or more")
        times, x, y, heading = np.array(states).T
        now = nuplan.TimePoint.of_step(step).time_s
        if times[0] > now + _LATE_S or times[-1] <= now:
            raise PlannerError(
                f"the trajectory from {times[0]:g} to {times[-1]:g} s does not continue from now, {now:g} s"
            )
        if (np.diff(times) <= 0).any():
            raise PlannerError("the times of the trajectory do not increase")
        new_times, heading = now + np.arange(steps + 1) * DT_S, np.unwrap(heading)
        x, y, heading = (_interpolate(new_times, times, values) for values in (x, y, heading))
        ahead = self.vehicle.rear_axle_to_center
        centre = np.stack([x + ahead * np.cos(heading), y + ahead * np.sin(heading)], axis=-1) - self.origin
        return np.column_stack([centre, wrap(heading)]).astype(np.float32)


def _call(function: Callable[[Any], Any], argument: Any) -> Any:
    """Call a planner; raise its errors as :class:`PlannerError`, one line with the location in its code."""
    try:
        return function(argument)
    except Exception as error:
        raise PlannerError(error_text(error)) from error


def _read_states(trajectory: Any) -> list[tuple[float, float, float, float]]:
    """Return time (s) and pose of the rear axle of every state of a trajectory."""
    sample = getattr(trajectory, "get_sampled_trajectory", None)
    states = trajectory if sample is None else sample()
    poses = [(state.time_point.time_us * 1e-6, state.rear_axle) for state in states]
    return [(time_s, float(pose.x), float(pose.y), float(pose.heading)) for time_s, pose in poses]


def _axle_speed(before: Any, now: Any) -> float:
    """Return the speed of the rear axle after a step: the component of the centre's speed along the heading."""
    dx, dy = now[:2] - before[:2]
    if math.hypot(dx, dy) < _STILL_M:
        return float(now[MOTION_SPEED])
    # The centre moves along the mean heading of the step plus the slip angle.
    slip = math.atan2(dy, dx) - before[2] - float(wrap(now[2] - before[2])) / 2
    return float(now[MOTION_SPEED]) * math.cos(slip)


def _interpolate(new_times: Any, times: Any, values: Any) -> Any:
    """Interpolate linearly; after the last time, extrapolate with the last slope."""
    slope = (values[-1] - values[-2]) / (times[-1] - times[-2])
    return np.interp(new_times, times, values) + np.maximum(new_times - times[-1], 0.0) * slope


def _equal(a: Any, b: Any) -> bool:
    """Return whether two trees of arrays are equal, NaN included."""
    pairs = zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    return all(np.array_equal(x, y, equal_nan=x.dtype.kind == "f") for x, y in pairs)
