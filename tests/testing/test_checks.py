"""Checks of user-defined components: built-in components pass, and each rule has a component that violates it."""

import inspect
import itertools
import re

import jax
import jax.numpy as jnp
import pytest
from flax import nnx

import own_terms
from drivax.metrics.catalogue import METRICS, Metric
from drivax.metrics.steps import StepValue
from drivax.networks.attention import EntityConfig
from drivax.networks.encoders import MlpConfig
from drivax.networks.transformers import LqConfig, LqhConfig, MtrConfig, WayformerConfig
from drivax.tasks.observations import View
from drivax.tasks.rewards import TERMS
from drivax.testing import (
    BrokenContract,
    check_criticality,
    check_encoder,
    check_feature,
    check_metric,
    check_reward,
)
from drivax.testing.worlds import moments


def refused(check, term, words):
    with pytest.raises(BrokenContract) as error:
        check(term)
    assert re.search(words, str(error.value)), str(error.value)
    assert "\n" not in str(error.value) and "; " in str(error.value)


@pytest.mark.slow
def test_worlds_cover_the_facts_of_terms():
    result = moments().situation
    facts = result.facts
    for name in ("collision", "offroad", "off_route", "ttc_defined", "straddling", "wrong_way"):
        assert 0 < float(getattr(facts, name).mean()) < 1, name
    kinds = result.surroundings.frame.kind[result.surroundings.frame.valid]
    assert {1, 2} <= set(kinds.tolist())


def some(names, *quick):
    """Return names as parameters; most are marked slow, because each compiles its own programs."""
    slow = [pytest.param(name, marks=pytest.mark.slow) for name in names if name not in quick]
    return [*quick, *slow]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["own_terms:Crowded", *TERMS])
def test_valid_reward_terms_pass(name):
    check_reward(own_terms.Crowded(5.0) if name.endswith("Crowded") else TERMS.get(name, name))


def frame_of(around):
    return around.frame.box[:, 0], around.frame.valid


count = itertools.count()
#: Each breaks one rule.
WRONG_TERMS = {
    "cannot be compiled": lambda b, n, a: jnp.ones(()) if n.speed_mps > 3 else jnp.zeros(()),
    "is not deterministic": lambda b, n, a: n.speed_mps * 0.0 + float(next(count)),
    "instead of one float32 number": lambda b, n, a: n.collision,
    r"float32\[4\] instead of one": lambda b, n, a: jnp.stack([n.speed_mps] * 4),
    "is not finite": lambda b, n, a: 1.0 / n.speed_mps,
    "rows of absent agents change": lambda b, n, a: jnp.max(jnp.abs(a.frame.velocity)),
    "empty slots are added": lambda b, n, a: a.frame.valid.mean(dtype=jnp.float32),
    "order of agents changes": lambda b, n, a: a.frame.valid[5].astype(jnp.float32),
    "rotated and shifted": lambda b, n, a: jnp.abs(a.frame.box[0, 2]),
}


@pytest.mark.parametrize("words", some(WRONG_TERMS, "cannot be compiled", "rotated and shifted"))
def test_invalid_reward_terms_fail(words):
    def term(before, now, around):
        return WRONG_TERMS[words](before, now, around)

    refused(check_reward, term, words)


@pytest.mark.parametrize(
    ("number", "kind"), [((0.0, 1.0), "tuple"), ({"a": 0.0}, "dict"), (None, "NoneType")]
)
def test_terms_that_return_no_number_fail(number, kind):
    refused(
        check_reward, lambda before, now, around: number, f"'<lambda>' gives {kind} instead of one float32"
    )


def test_values_that_are_no_components_fail():
    refused(check_reward, "math:pi", "reward term 'float' cannot be called")
    refused(inspect.unwrap(check_metric), len, "is not a Metric")
    refused(check_feature, "math:pi", "observation feature 'float' is no function")
    refused(check_feature, View, "observation feature 'View' is no function")


def test_batched_terms_fail():
    def term(before, now, around):
        inside = jnp.ndim(now.speed_mps) == 0 and isinstance(now.speed_mps, jax.core.Tracer)
        return now.speed_mps if inside else now.speed_mps + 1.0

    refused(check_reward, term, "differs when compiled")


@pytest.mark.parametrize("name", some(METRICS, "own_terms:nearest_other"))
def test_valid_metrics_pass(name):
    check_metric(METRICS.get(name, name))


def metric(read, reads=frozenset(), **more):
    return Metric(
        "m", "low", "a wrong one", step_value=StepValue("wrong", "m", read, reads), operator="max", **more
    )


def test_metrics_without_a_pair_fail():
    refused(check_metric, metric(lambda m: m.facts.speed_mps), "reads no pair; return the number and whether")


def test_invalid_metrics_fail():
    refused(check_metric, metric(lambda m: (m.facts.speed_mps, True)), "'reads' does not declare")
    with pytest.raises(ValueError, match="unknown fact 'speed'"):
        metric(lambda m: (m.facts.speed_mps, True), frozenset({"speed"}))
    divided = metric(lambda m: (1.0 / m.facts.speed_mps, True), frozenset({"speed_mps"}))
    refused(check_metric, divided, "is not finite")
    guarded = metric(lambda m: (1.0 / m.facts.speed_mps, m.facts.speed_mps > 0), frozenset({"speed_mps"}))
    check_metric(guarded)
    refused(
        check_metric,
        metric(lambda m: (m.situation.surroundings.frame.box[0, 0], True)),
        "rotated and shifted",
    )
    refused(
        check_metric, Metric("m", "low", "text", compute=lambda e, v, k: v.value), "does not compute a Value"
    )
    refused(check_metric, Metric("", "low", "text", compute=lambda e, v, k: v), "no unit or definition")


@pytest.mark.slow
@pytest.mark.parametrize("name", ["walkers", "goal"])
def test_valid_features_pass(name):
    check_feature(f"own_terms:{name}")


WRONG_FEATURES = {
    "cannot be compiled": lambda b, s, f: jnp.asarray([float(s.history[-1, 3])]),
    r"gives int32": lambda b, s, f: s.step[None, None],
    r"float32\[\] for": lambda b, s, f: s.history[-1, 3],
    "gives float; return an array": lambda b, s, f: 1.0,
    "gives tuple; return an array": lambda b, s, f: (s.history, None),
    r"bool\[2\] as the mask of \[1, 2\]": lambda b, s, f: (s.history[-1:, 2:] * 0.0, jnp.ones(2, bool)),
    "is not finite": lambda b, s, f: jnp.log(s.history[-1:, 3:]),
    r"reaches \d+": lambda b, s, f: s.history[-1:, 3:] * 100.0,
    "rows of absent agents change": lambda b, s, f: jnp.max(f(0).velocity)[None] / 100.0,
    "empty slots are added": lambda b, s, f: jnp.where(f(0).valid, 1.0, 0.0).mean()[None],
    "order of agents changes": lambda b, s, f: jnp.where(f(0).valid, f(0).box[:, 4], 0.0)[1:9],
    "the log's future changes": lambda b, s, f: (
        View.of(s).point(b.agents[s.index, s.step + 5, 0, :2])[None] / 50.0
    ),
    "rotated and shifted": lambda b, s, f: s.history[-1:, 2] / 3.0,
}


@pytest.mark.parametrize(
    "words", some(WRONG_FEATURES, "the log's future changes", "gives float; return an array")
)
def test_invalid_features_fail(words):
    def feature(bank, context, frames):
        return WRONG_FEATURES[words](bank, context, frames)

    refused(check_feature, feature, words)


@pytest.mark.slow
def test_custom_encoder_passes():
    check_encoder("own_terms:MeanConfig")


_TINY = {"width": 8, "heads": 2, "layers": 1}


@pytest.mark.slow
@pytest.mark.parametrize(
    "config",
    [
        MlpConfig(rows=(), hidden=(8,)), MlpConfig(rows=(8,), hidden=(8,)), EntityConfig(width=8), LqConfig(**_TINY),
        LqhConfig(**_TINY), MtrConfig(**_TINY, dtype="bfloat16"), WayformerConfig(**_TINY),
        WayformerConfig(**_TINY, fusion="early", factorised=True), WayformerConfig(**_TINY, fusion="hierarchical"),
    ],
)  # fmt: skip
def test_built_in_encoders_pass(config):
    check_encoder(config)


class Wrong(nnx.Module):
    """An encoder with a fault."""

    def __init__(self, fault, spec, rngs):
        self.fault, self.width = fault, 3
        self.layer = nnx.Linear(spec["ego"][-1], 3, rngs=nnx.Rngs(next(count)) if fault == "seed" else rngs)
        if fault == "state":
            self.seen = nnx.BatchStat(jnp.zeros(()))
        self.masked = next(name.removesuffix("_mask") for name in spec if name.endswith("_mask"))

    def __call__(self, groups):
        ego = groups["ego"][..., -1, :]
        x = self.layer(ego) * (0.0 if self.fault == "constant" else 1.0)
        rows, mask = groups[self.masked], groups[f"{self.masked}_mask"]
        axes = tuple(range(-len(mask.shape) + ego.ndim - 1, 0)) if ego.ndim > 1 else None
        if self.fault == "mask":
            x = x + jnp.mean(rows, axis=(*(a - 1 for a in axes), -1) if axes else None)[..., None]
        if self.fault == "nobody":
            x = x / jnp.sum(mask, axis=axes)[..., None]
        if self.fault == "gradient":
            x = x + jnp.where(mask.any(axes), jnp.sqrt(jnp.sum(x * 0.0, -1)), 0.0)[..., None]
        if self.fault == "batch" and x.ndim > 1:
            x = x - x.mean(0)
        return {"width": x[..., :2], "tree": (x, x)}.get(self.fault, x)


class WrongConfig:
    def __init__(self, fault):
        self.fault = fault

    def build(self, spec, rngs):
        return Wrong(self.fault, spec, rngs)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("fault", "words"),
    {
        "width": "with width 3", "tree": r"float32\[6, 3\], float32\[6, 3\] with", "state": "not parameters",
        "seed": "other initial parameters",
        "batch": "differs in a batch", "constant": "all observations equally", "mask": "changes with masked rows",
        "nobody": "without rows is not finite", "gradient": "non-finite gradients",
        "blind": "ignores the group 'agents'",
    }.items(),
)  # fmt: skip
def test_invalid_encoders_fail(fault, words):
    refused(check_encoder, WrongConfig(fault), words)


def test_objects_that_are_not_encoders_fail():
    refused(check_encoder, "own_terms:hurry", "has no build")


#: Each breaks one rule.
WRONG_CRITICALITIES = {
    "cannot be compiled": lambda bank, log: {"a": jnp.ones(91) if log.motion[0, 3] > 3 else jnp.zeros(91)},
    "gives no dict": lambda bank, log: jnp.ones(91),
    r"'a' of .* is float32\[\], not float32\[91\]": lambda bank, log: {"a": jnp.ones(())},
    r"outside \[0, 1\] at": lambda bank, log: {"a": log.motion[:, 3]},
    "is not finite": lambda bank, log: {"a": log.motion[:, 3] / 0.0},
    "changes when": lambda bank, log: {"a": jnp.clip(log.frame.box[:, 1, 0] * 1e-3, 0.0, 1.0)},
}


@pytest.mark.slow
@pytest.mark.parametrize("name", ["drivax.curation.kinematic:KinematicConfig", "own_terms:Speeds"])
def test_valid_criticality_methods_pass(name):
    check_criticality(name)


def test_valid_criticality_function_passes():
    check_criticality("own_terms:proximity")


@pytest.mark.parametrize("words", some(WRONG_CRITICALITIES, "gives no dict", "changes when"))
def test_wrong_criticality_methods_are_refused(words):
    refused(check_criticality, WRONG_CRITICALITIES[words], words)
