"""The plan of a comparison: what is compared and how it is decided, written before it is run."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from drivax.errors import UsageError


@dataclass(frozen=True)
class ComparisonPlan:
    """What is compared and how it is decided; written as YAML before it is run.

    Attributes:
        name: For the heading of the page.
        a, b: Run folders of ``drivax evaluate``; the command line may name them instead.
        primary: The metric that decides.
        secondary: Further metrics to report; the primary one is left out of them.
        split: ``paired`` compares on every common scenario; ``random`` and ``stratified`` give each planner its own
            scenarios.
        ratio: Share of the recordings that A gets in a split.
        strata: Tags by which a stratified split balances the arms.
        minimum_scenarios: With fewer, nothing is decided.
        confidence: Of intervals; tests reject at 1 - confidence.
        power: With which the smallest difference is to be found, before "no difference" is said.
        smallest_difference: The smallest difference that matters, in the unit of the primary metric; null: a tenth of
            the standard deviation.
        test: Of means in pairs: ``permutation``, or ``bootstrap`` where differences are far from symmetric.
        resamples: Of bootstraps and permutations.
        seed: Of the split and of all resampling.
    """

    name: str = ""
    a: Path | None = None
    b: Path | None = None
    primary: str = "vmax_score"
    secondary: tuple[str, ...] = ("collision", "progress_ratio", "comfortable")
    split: Literal["paired", "random", "stratified"] = "paired"
    ratio: float = 0.5
    strata: tuple[str, ...] = ("difficulty", "type", "density")
    minimum_scenarios: int = 1000
    confidence: float = 0.95
    power: float = 0.80
    smallest_difference: float | None = None
    test: Literal["permutation", "bootstrap"] = "permutation"
    resamples: int = 10_000
    seed: int = 0

    def __post_init__(self) -> None:
        for name in ("ratio", "confidence", "power"):
            if not 0 < getattr(self, name) < 1:
                raise UsageError(
                    f"{name} {getattr(self, name)} cannot be", cure="use a number between 0 and 1"
                )
        if self.minimum_scenarios < 2 or self.resamples < 100:
            raise UsageError("too few to say anything", cure="use 2 scenarios and 100 resamples or more")
        if self.smallest_difference is not None and not self.smallest_difference > 0:
            raise UsageError("the smallest difference that matters is above 0", cure="give its size, or null")
        if len(set(self.secondary)) < len(self.secondary):
            raise UsageError("a metric is named twice", cure="name each metric once")
        # So that another primary metric can be chosen without a second list.
        others = tuple(name for name in self.secondary if name != self.primary)
        object.__setattr__(self, "secondary", others)
        if self.split != "paired" and self.test == "bootstrap":
            raise UsageError(
                "the bootstrap test is for pairs", cure="use test: permutation, or split: paired"
            )
