"""Traffic lights: groups of movements, phases, and colours over time."""

from __future__ import annotations

import enum
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64, Int8

from drivax.scenario.schema import LightState


class Colour(enum.IntEnum):
    """Colour of a light."""

    NONE = 0
    GREEN = 1
    YELLOW = 2
    RED = 3


@dataclass(frozen=True)
class LightGroup:
    """Connector lanes with the same colour at all times, and whether their lights are arrows."""

    lanes: tuple[int, ...]
    arrow: bool


@dataclass(frozen=True)
class SignalPlan:
    """Fixed-time plan of all junctions of a network: each phase is green, then yellow, then its junction is all red.

    Attributes:
        phases: Indices of the groups that are green, per phase.
        green_s: Duration of green of each phase, s.
        offset_s: Time at which phase 0 turns green (without a lag), s.
        programs: Phases of each junction in order, each program on its own cycle; empty: one junction with all phases.
        lags_s: Time from ``offset_s`` until the first phase of each program turns green, s; empty: no lags.
    """

    groups: tuple[LightGroup, ...]
    phases: tuple[tuple[int, ...], ...]
    green_s: tuple[float, ...]
    yellow_s: float = 3.0
    all_red_s: float = 1.5
    offset_s: float = 0.0
    programs: tuple[tuple[int, ...], ...] = ()
    lags_s: tuple[float, ...] = ()

    @property
    def starts_s(self) -> tuple[float, ...]:
        """Time at which each phase turns green, s after ``offset_s``."""
        starts = [0.0] * len(self.phases)
        programs = self._programs
        for program, lag in zip(programs, self.lags_s or (0.0,) * len(programs), strict=True):
            green_at = lag
            for phase in program:
                starts[phase] = green_at
                green_at += self.green_s[phase] + self.yellow_s + self.all_red_s
        return tuple(starts)

    @property
    def cycle_s(self) -> float:
        """Duration of the longest cycle, s."""
        return max(map(self._duration_s, self._programs))

    @property
    def _programs(self) -> tuple[tuple[int, ...], ...]:
        return self.programs or (tuple(range(len(self.phases))),)

    def _duration_s(self, program: tuple[int, ...]) -> float:
        return sum(self.green_s[phase] for phase in program) + len(program) * (self.yellow_s + self.all_red_s)

    def stretch(self, cycle_s: float) -> SignalPlan:
        """Lengthen the first green so that the cycle takes ``cycle_s`` (one junction only)."""
        extra = cycle_s - self.cycle_s
        return replace(self, green_s=(self.green_s[0] + extra, *self.green_s[1:]))

    def phase_of(self, lane: int) -> int:
        """Return the phase that serves a connector lane.

        Raises:
            KeyError: No light controls the lane.
        """
        for phase, groups in enumerate(self.phases):
            if any(lane in self.groups[group].lanes for group in groups):
                return phase
        raise KeyError(lane)

    def colours(
        self, times_s: Float64[np.ndarray, " time"], lanes: int
    ) -> tuple[Int8[np.ndarray, "time lane"], Float64[np.ndarray, "time lane"]]:
        """Return the colours of ``lanes`` lanes (NONE without a light), and the remaining yellow time, s (else 0)."""
        colour = np.zeros((len(times_s), lanes), np.int8)
        remaining_s = np.zeros((len(times_s), lanes))
        for group in self.groups:
            colour[:, list(group.lanes)] = Colour.RED
        starts = self.starts_s
        for program in self._programs:
            cycle = self._duration_s(program)
            for phase in program:
                # The microsecond keeps rounding from delaying a change that falls on a step.
                elapsed_s = (times_s + 1e-6 - self.offset_s - starts[phase]) % cycle
                is_green = elapsed_s < self.green_s[phase]
                to_red = self.green_s[phase] + self.yellow_s - elapsed_s
                is_yellow = ~is_green & (to_red > 0)
                for lane in (lane for group in self.phases[phase] for lane in self.groups[group].lanes):
                    colour[is_green, lane] = Colour.GREEN
                    colour[is_yellow, lane] = Colour.YELLOW
                    remaining_s[is_yellow, lane] = to_red[is_yellow]
        return colour, remaining_s


def yellow_time_s(limit_mps: float) -> float:
    """Duration of yellow, s: 1 s of reaction and half the time of a stop from the limit at 3.05 m/s2; at least 3 s.

    Kinematic formula ``t + v / (2 a)`` of the Institute of Transportation Engineers (Guidelines for Determining
    Traffic Signal Change and Clearance Intervals, 2020) on level ground.
    """
    return max(3.0, 1.0 + limit_mps / (2 * 3.05))


def combine_plans(first: SignalPlan, second: SignalPlan, lag_s: float) -> SignalPlan:
    """Combine the plans of two junctions, each with its own cycle; phase 0 of ``second`` turns green ``lag_s`` later.

    Offset, yellow and all-red times of ``first`` hold for both; each plan has one junction.
    """
    groups, phases = len(first.groups), len(first.phases)
    return replace(
        first,
        groups=first.groups + second.groups,
        phases=first.phases + tuple(tuple(groups + g for g in phase) for phase in second.phases),
        green_s=first.green_s + second.green_s,
        programs=(tuple(range(phases)), tuple(range(phases, phases + len(second.phases)))),
        lags_s=(0.0, lag_s),
    )


#: Light states by colour: of round lights, and of arrows.
_STATES = (
    (LightState.UNOBSERVED, LightState.GO, LightState.CAUTION, LightState.STOP),
    (LightState.UNOBSERVED, LightState.ARROW_GO, LightState.ARROW_CAUTION, LightState.ARROW_STOP),
)


def light_states(colour: Int8[np.ndarray, " time"], arrow: bool) -> Int8[np.ndarray, " time"]:
    """Convert colours to light states of the scenario schema."""
    return np.array(_STATES[arrow], np.int8)[colour]
