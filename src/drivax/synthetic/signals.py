"""Traffic lights: groups of movements, the phases that serve them, and their states over time."""

from __future__ import annotations

import enum
from dataclasses import dataclass

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
    """A fixed-time plan: phases in turn, each green, then yellow, then red for everyone.

    Attributes:
        groups: The light groups.
        phases: Per phase the indices of the groups that are green.
        green_s: Duration of green of each phase, s.
        yellow_s: Yellow of every phase, s.
        all_red_s: Red for everyone after every yellow, s.
        offset_s: Time at which phase 0 turns green, s.
    """

    groups: tuple[LightGroup, ...]
    phases: tuple[tuple[int, ...], ...]
    green_s: tuple[float, ...]
    yellow_s: float = 3.0
    all_red_s: float = 1.5
    offset_s: float = 0.0

    @property
    def starts_s(self) -> tuple[float, ...]:
        """When each phase turns green, s after phase 0 does."""
        ends = np.cumsum([green + self.yellow_s + self.all_red_s for green in self.green_s])
        return (0.0, *(float(end) for end in ends[:-1]))

    @property
    def cycle_s(self) -> float:
        """Duration of the whole cycle, s."""
        return sum(self.green_s) + len(self.phases) * (self.yellow_s + self.all_red_s)

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
        for phase, begin in enumerate(self.starts_s):
            # A hair later than the true time: a change that falls on a step shows at that step on every machine.
            since = (times_s + 1e-6 - self.offset_s - begin) % self.cycle_s
            green = since < self.green_s[phase]
            to_red = self.green_s[phase] + self.yellow_s - since
            yellow = ~green & (to_red > 0)
            for lane in (lane for group in self.phases[phase] for lane in self.groups[group].lanes):
                colour[green, lane] = Colour.GREEN
                colour[yellow, lane] = Colour.YELLOW
                left[yellow, lane] = to_red[yellow]
        return colour, left


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
