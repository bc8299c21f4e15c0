"""Traffic lights: groups of movements, the phases that serve them, and their states over time."""

from __future__ import annotations

import enum
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64, Int8, Int64

from drivax.scenario.schema import LightState


class Colour(enum.IntEnum):
    """What a driver sees."""

    NONE = 0
    GREEN = 1
    YELLOW = 2
    RED = 3


@dataclass(frozen=True)
class LightGroup:
    """Movements that always show the same colour: indices of connector lanes, and whether lamps are arrows."""

    lanes: tuple[int, ...]
    arrow: bool


@dataclass(frozen=True)
class SignalPlan:
    """Fixed-time plans of all junctions of a network: phases in turn, each green, then yellow, then red for everyone.

    Attributes:
        groups: The light groups.
        phases: Per phase the indices of the groups that are green.
        green_s: Duration of green of each phase, s.
        yellow_s: Yellow of every phase, s.
        all_red_s: Red for everyone at the junction after every yellow, s.
        offset_s: Time at which phase 0 turns green, s.
        programs: Per junction its phases in turn, each program on its own cycle; empty: one junction with them all.
        lags_s: Per program the time from ``offset_s`` until its first phase turns green, s; empty: no lags.
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
        """When each phase turns green, s after ``offset_s``."""
        starts = [0.0] * len(self.phases)
        programs = self._programs
        for program, lag in zip(programs, self.lags_s or (0.0,) * len(programs), strict=True):
            at = lag
            for phase in program:
                starts[phase] = at
                at += self.green_s[phase] + self.yellow_s + self.all_red_s
        return tuple(starts)

    @property
    def cycle_s(self) -> float:
        """Duration of the whole cycle, s; the longest one where junctions have their own."""
        return max(map(self._duration_s, self._programs))

    @property
    def _programs(self) -> tuple[tuple[int, ...], ...]:
        return self.programs or (tuple(range(len(self.phases))),)

    def _duration_s(self, program: tuple[int, ...]) -> float:
        return sum(self.green_s[phase] for phase in program) + len(program) * (self.yellow_s + self.all_red_s)

    def stretched(self, cycle_s: float) -> SignalPlan:
        """The plan with a longer green in its first phase, so that a cycle takes this long (one junction only)."""
        extra = cycle_s - self.cycle_s
        return replace(self, green_s=(self.green_s[0] + extra, *self.green_s[1:]))

    def phase_of(self, lane: int) -> int:
        """The phase that serves a connector lane.

        Raises:
            KeyError: When no light controls it.
        """
        for phase, groups in enumerate(self.phases):
            if any(lane in self.groups[group].lanes for group in groups):
                return phase
        raise KeyError(lane)

    def colours(
        self, times_s: Float64[np.ndarray, " time"], lanes: int
    ) -> tuple[Int8[np.ndarray, "time lane"], Float64[np.ndarray, "time lane"]]:
        """What every lane's driver sees.

        Args:
            times_s: Times, s.
            lanes: Number of lanes of the network.

        Returns:
            The :class:`Colour` of each lane (NONE without a light) and, where it is yellow, the seconds until
            it turns red (0 elsewhere).
        """
        colour = np.zeros((len(times_s), lanes), np.int8)
        left = np.zeros((len(times_s), lanes))
        for group in self.groups:
            colour[:, list(group.lanes)] = Colour.RED
        starts = self.starts_s
        for program in self._programs:
            cycle = self._duration_s(program)
            for phase in program:
                # A hair later than the true time: a change that falls on a step shows at that step on every machine.
                since = (times_s + 1e-6 - self.offset_s - starts[phase]) % cycle
                green = since < self.green_s[phase]
                to_red = self.green_s[phase] + self.yellow_s - since
                yellow = ~green & (to_red > 0)
                for lane in (lane for group in self.phases[phase] for lane in self.groups[group].lanes):
                    colour[green, lane] = Colour.GREEN
                    colour[yellow, lane] = Colour.YELLOW
                    left[yellow, lane] = to_red[yellow]
        return colour, left


def yellow_time_s(limit_mps: float) -> float:
    """How long yellow lasts on an approach: a second to react, then a stop with 3.05 m/s2, at least 3 s.

    The kinematic formula of the Institute of Transportation Engineers (Guidelines for Determining Traffic Signal
    Change and Clearance Intervals, 2020) on level ground: ``t + v / (2 a)``.
    """
    return max(3.0, 1.0 + limit_mps / (2 * 3.05))


def side_by_side(first: SignalPlan, second: SignalPlan, lag_s: float) -> SignalPlan:
    """One plan of the lights of two junctions, each with its own cycle.

    Args:
        first: Plan of one junction, without programs; its yellow and all-red hold for both.
        second: Plan of the other one.
        lag_s: How long after phase 0 of ``first`` phase 0 of ``second`` turns green, s.
    """
    groups, phases = len(first.groups), len(first.phases)
    return SignalPlan(
        groups=first.groups + second.groups,
        phases=first.phases + tuple(tuple(groups + g for g in phase) for phase in second.phases),
        green_s=first.green_s + second.green_s,
        yellow_s=first.yellow_s,
        all_red_s=first.all_red_s,
        offset_s=first.offset_s,
        programs=(tuple(range(phases)), tuple(range(phases, phases + len(second.phases)))),
        lags_s=(0.0, lag_s),
    )


_ROUND = {
    Colour.NONE: LightState.UNOBSERVED,
    Colour.GREEN: LightState.GO,
    Colour.YELLOW: LightState.CAUTION,
    Colour.RED: LightState.STOP,
}
_ARROW = {
    Colour.NONE: LightState.UNOBSERVED,
    Colour.GREEN: LightState.ARROW_GO,
    Colour.YELLOW: LightState.ARROW_CAUTION,
    Colour.RED: LightState.ARROW_STOP,
}


def light_states(colour: Int8[np.ndarray, " time"], arrow: bool) -> Int8[np.ndarray, " time"]:
    """Colours as the light states of the scenario schema."""
    table: Int64[np.ndarray, " 4"] = np.array([(_ARROW if arrow else _ROUND)[c] for c in Colour])
    return table[colour].astype(np.int8)
