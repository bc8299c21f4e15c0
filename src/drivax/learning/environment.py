"""What an algorithm acts in: driving (``learning.driving``), or a control task whose known results judge the algorithm.

An environment is configuration only; its data (for driving the scenario bank) is an argument of everything, and all
functions but :meth:`Environment.observe` act on a batch.
"""

from __future__ import annotations

from typing import Any, ClassVar, Protocol, runtime_checkable

from jaxtyping import Array, Bool, Float

from drivax.scenario.record import record


@record
class Environments:
    """A batch of environments between two collections.

    Attributes:
        state: Their states.
        over: Whether each one's episode has ended; the next step begins a new one.
        observation: What each one's policy sees now.
        environment_axis: The axis that counts environments; several devices divide it among them.
    """

    environment_axis: ClassVar[int] = 0

    state: Any
    over: Bool[Array, "*batch"]
    observation: dict[str, Array]


@record
class Outcome:
    """What one step of a batch came to. Where an environment was over, all but ``looked`` means nothing.

    Attributes:
        reward: The rewards.
        terminated: The episode ended for good: bootstrap zero.
        truncated: It was cut off: bootstrap the value of the state that the step led to.
        looked: :meth:`Environment.look` of the state that the step led to.
        totals: Sums over the batch to log, ``"<name>"`` with ``"<name>/n"``, the number that it is a sum of, or
            ``"reward/<name>"`` over steps; nothing of environments that were over is in them.
    """

    reward: Float[Array, " B"]
    terminated: Bool[Array, " B"]
    truncated: Bool[Array, " B"]
    looked: Any
    totals: dict[str, Array]


@runtime_checkable
class Environment(Protocol):
    """Something to act in."""

    @property
    def action_size(self) -> int:
        """Numbers in an action; each lies in [-1, 1]."""
        ...

    @property
    def levels(self) -> tuple[tuple[float, ...], ...] | None:
        """The values that each number of an action can have, ascending; None where any will do."""
        ...

    def shapes(self, data: Any) -> dict[str, tuple[int, ...]]:
        """Shapes of one observation by group; of the data only shapes are looked at."""
        ...

    def start(self, data: Any, key: Array, count: int) -> Environments:
        """So many environments, at staggered points of their episodes, so that their ends are staggered too."""
        ...

    def stored(self, state: Any) -> Any:
        """What replay stores of states: as little as an observation can be made of."""
        ...

    def observe(self, data: Any, stored: Any) -> dict[str, Array]:
        """The observation of one stored state (not of a batch)."""
        ...

    def observe_all(self, data: Any, stored: Any) -> dict[str, Array]:
        """The observations of a batch of stored states."""
        ...

    def look(self, data: Any, state: Any) -> Any:
        """What steps look at beside states, and what the next one can use again: passed on, never stored."""
        ...

    def step(
        self, data: Any, now: Environments, looked: Any, action: Float[Array, "B D"], key: Array
    ) -> tuple[Environments, Outcome]:
        """One step of every environment.

        One that is over begins its next episode instead: it pays with a step, and in exchange nothing is measured or
        observed twice, and every state that a policy sees, final ones included, is seen once.

        Args:
            data: The data.
            now: The environments.
            looked: :meth:`look` of their states.
            action: What each does if its episode goes on.
            key: For whatever is drawn.
        """
        ...
