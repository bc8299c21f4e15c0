"""Selected metrics equal those of the full set, and other metrics are neither computed nor carried."""

import re
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from drivax import settings
from drivax.errors import UsageError
from drivax.evaluation.rollout import evaluation_task
from drivax.kernels import without_kernels
from drivax.learning.config import TrainConfig
from drivax.metrics import steps
from drivax.metrics.catalogue import METRICS, SETS, metric_specs, select_metrics
from drivax.metrics.episode import episode_add, episode_metrics, episode_start, event_steps
from drivax.metrics.steps import STEP_VALUES
from drivax.simulator import contact, situation
from drivax.simulator.simulator import Simulator
from drivax.simulator.types import FACTS
from drivax.tasks.task import Task
from scenes import RED, bank_of, car, straight_road

BANK = bank_of(straight_road([car(speed=10.0), car(30.0), car(0, 3.7, 0, 9)], light=RED))


def test_step_metrics_of_no_values_are_empty():
    simulator = Simulator(evaluation_task(Task()))

    def read(values):
        return steps.step_metrics(simulator.situation(BANK, simulator.reset(BANK, 0)), values)

    immediate = {name for name, value in STEP_VALUES.items() if not value.delayed}
    assert jax.eval_shape(partial(read, ())) == {}
    assert jax.eval_shape(partial(read, None)).keys() == immediate


#: Work that only some metrics need.
COSTLY = ("time_to_collision", "classify_contacts", "check_lights", "check_comfort")


@dataclass(frozen=True)
class Traced:
    """A traced step of a task: shapes of its state, number of operations, and calls of costly functions."""

    state: object
    operations: int
    called: frozenset[str]


@pytest.fixture(scope="module")
def traced():
    """The default task with each set and with a single metric, by name."""
    result = {}
    # Native kernels compute some of it in other functions.
    with pytest.MonkeyPatch.context() as patch, without_kernels():
        called = set()

        def record_calls(module, name):
            function = getattr(module, name)

            def recorded(*arguments):
                called.add(name)
                return function(*arguments)

            patch.setattr(module, name, recorded)

        for name in COSTLY:
            record_calls({"check_comfort": steps, "check_lights": situation}.get(name, contact), name)
        for reference in ("none", "training", "full", ("at_fault_collision",)):
            called.clear()
            simulator = Simulator(Task(metrics=reference))
            state = jax.eval_shape(lambda bank, simulator=simulator: simulator.reset(bank, 0), BANK)
            step = jax.make_jaxpr(lambda bank, s, of=simulator: of.step(bank, s, jnp.zeros(2))[0])(
                BANK, state
            )
            result[reference] = Traced(state, str(step).count(" = "), frozenset(called))
    return result


def size(tree):
    return sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(tree))


def test_sets_contain_catalogue_metrics():
    assert SETS["none"] == () and SETS["full"] == tuple(METRICS)
    assert set(SETS["training"]) < set(METRICS)
    for name, metric in METRICS.items():
        assert set(metric.inputs) <= set(METRICS) and metric.definition and metric.unit, name
    assert {value.name for value in select_metrics("full").step_values()} == set(STEP_VALUES)


def test_list_of_sets_and_metrics_adds_their_inputs():
    reference = select_metrics(("training", "comfortable", "min_ttc", "min_ttc"))
    assert reference.names == (*SETS["training"], "comfortable", "min_ttc")
    assert "comfort" in dict(reference.metrics) and "comfort" not in reference.names
    order = [name for name, _ in reference.metrics]
    for name, metric in reference.metrics:
        assert all(order.index(needed) < order.index(name) for needed in metric.inputs)
    assert select_metrics(("min_ttc",)).reads == {"ttc_s", "ttc_defined"}
    assert select_metrics("none").reads == frozenset() and select_metrics("full").reads == FACTS
    assert list(metric_specs(("min_ttc", "ade"))) == ["min_ttc", "ade"]
    assert select_metrics(("full", "own_terms:lane_changes")).reads == FACTS | {"lane_changed"}


def test_misspelt_names_fail_with_one_line():
    for reference in ("trainin", ("training", "min_tcc")):
        with pytest.raises(UsageError, match="did you mean"):
            Task(metrics=reference)
    with pytest.raises(UsageError, match=r"task.*: unknown metric 'ful'.*'full'"):
        settings.load(TrainConfig, {"task": {"metrics": "ful"}})


def test_configuration_files_choose_a_set():
    load = settings.load
    assert load(TrainConfig, {}).task.metrics == "training"
    assert load(TrainConfig, {"task": {"ends": ["collision"]}}).task.metrics == "training"
    assert load(TrainConfig, {"task": {"metrics": "none"}}).task.metrics == "none"
    listed = load(TrainConfig, {"task": {"metrics": ["training", "min_ttc"]}})
    assert listed.task.metrics == ("training", "min_ttc")
    assert load(TrainConfig, {}, ["--task.metrics", "[vmax_score]"]).task.metrics == ("vmax_score",)
    assert load(TrainConfig, {}, ["--task.metrics", "full"]).task.metrics == "full"
    assert load(TrainConfig, settings.parse_yaml(settings.dump(listed))) == listed
    assert Task().metrics == "full"


def test_unselected_metrics_are_not_computed(traced):
    assert traced["none"].called == traced["training"].called == {"check_lights"}
    assert traced["full"].called == set(COSTLY)
    assert traced[("at_fault_collision",)].called == {"check_lights", "classify_contacts"}
    assert traced["none"].operations < traced["training"].operations < 0.85 * traced["full"].operations


def test_unselected_metrics_are_not_carried(traced):
    for less, more in pairwise(traced[name].state for name in ("none", "training", "full")):
        assert size(less.episode) < size(more.episode) and size(less.facts) < size(more.facts)
    assert size(traced["none"].state.episode) == 0 and size(traced["full"].state.episode) <= 200


def test_unread_facts_are_none(traced):
    facts = traced["none"].state.facts
    kept = {name for name in FACTS if getattr(facts, name) is not None}
    assert kept == Task(metrics="none").reads
    assert kept == {"collision", "offroad", "red_light", "left_map", "off_route", "progress_m", "routed"}


def random_situations(count=60):
    """Random measurements of steps 11 to 10 + ``count`` of scenario 0, stacked."""
    simulator, rng = Simulator(Task()), np.random.default_rng(5)
    shape = jax.eval_shape(lambda bank: simulator.situation(bank, simulator.reset(bank, 0)), BANK)

    def filled(leaf):
        if leaf.dtype == bool:
            return jnp.asarray(rng.random((count, *leaf.shape)) < 0.1)
        if jnp.issubdtype(leaf.dtype, jnp.floating):
            return jnp.asarray(rng.uniform(0.0, 2.0, (count, *leaf.shape)), leaf.dtype)
        return jnp.zeros((count, *leaf.shape), leaf.dtype)

    result = jax.tree.map(filled, shape)
    kinds = jnp.asarray(rng.choice([0, 0, 0, 2, 3], count), result.facts.collision_type.dtype)
    facts = replace(result.facts, collision_type=kinds, limit_mps=result.facts.limit_mps - 0.5)
    return replace(result, facts=facts, context=replace(result.context, step=jnp.arange(11, 11 + count)))


def episode(reference, result, empty):
    """Metrics and first events of measured steps."""
    last = 10 + result.context.step.shape[0]

    @jax.jit
    def run(result):
        def one(episode, now):
            return episode_add(episode, now, jnp.asarray(10), now.context.step == last), None

        summed = jax.lax.scan(one, episode_start(reference), result)[0]
        context = jax.tree.map(lambda leaf: leaf[-1], result.context)
        state = replace(empty, context=context, episode=summed, start=jnp.asarray(10))
        return episode_metrics(BANK, state), event_steps(summed)

    return jax.tree.map(np.asarray, run(result))


LEAN = ("vmax_score", "min_ttc", "max_jerk", "fde", "wrong_way_worst", "collision_type")


def zeros(shapes):
    return jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)


@pytest.mark.slow
def test_operators_and_selection_do_not_change_values(traced):
    result, empty = random_situations(), zeros(traced["none"].state)
    full, events = episode("full", result, empty)
    facts = jax.tree.map(np.asarray, result.facts)
    ttc = facts.ttc_s[facts.ttc_defined]
    over = np.maximum(facts.speed_mps - facts.limit_mps, 0)[facts.limit_mps > 0]
    wrong = np.where(facts.wrong_way, facts.moved_m, 0)
    expected = {
        "collision": facts.collision.any(), "red_light": facts.red_light.any(), "min_ttc": ttc.min(),
        "average_ttc": ttc.mean(), "speeding_mean": over.mean(), "speeding_max": over.max(), "wrong_way": wrong.sum(),
        "wrong_way_worst": max(wrong[k : k + 10].sum() for k in range(51)),
        "lane_straddle": 0.1 * facts.straddling.sum(), "ade": facts.log_divergence_m[facts.logged].mean(),
        "fde": facts.log_divergence_m[facts.logged][-1], "goal_distance": facts.goal_distance_m[-1],
        "collision_type": facts.collision_type[facts.collision_type > 0][0], "distance": facts.moved_m.sum(),
        "route_deviation_max": facts.route_deviation_m.max(), "steps": 60,
    }  # fmt: skip
    for name, value in expected.items():
        assert full[name].value == pytest.approx(float(value), rel=1e-5), name
    for name in ("collision", "offroad", "red_light"):
        assert events[name] == 11 + np.argmax(getattr(facts, name)), name
    for reference in ("training", LEAN):
        lean, lean_events = episode(reference, result, empty)
        assert set(lean) == set(select_metrics(reference).names)
        for name, value in lean.items():
            np.testing.assert_allclose(value.value, full[name].value, rtol=1e-6, err_msg=name)
            assert value.defined == full[name].defined, name
        assert lean_events.items() <= events.items()


@pytest.mark.slow
def test_a_selection_changes_no_value_in_simulation():
    def drive_straight_on(task):
        simulator = Simulator(replace(task, to_the_end=True))

        @jax.jit
        def run(bank):
            state = simulator.reset(bank, 0)
            state = jax.lax.fori_loop(0, 60, lambda _, s: simulator.step(bank, s, jnp.zeros(2))[0], state)
            return episode_metrics(bank, state)

        return jax.tree.map(np.asarray, run(BANK))

    full = drive_straight_on(Task())
    assert full["collision"].value == 1.0
    for reference in ("training", LEAN):
        for name, value in drive_straight_on(Task(metrics=reference)).items():
            np.testing.assert_allclose(value.value, full[name].value, rtol=1e-5, atol=1e-5, err_msg=name)
            assert value.defined == full[name].defined, name


def test_evaluation_uses_the_full_set_whatever_the_task_learned_with():
    for metrics in ("none", ("training", "min_ttc")):
        assert select_metrics(evaluation_task(Task(metrics=metrics)).metrics).names == tuple(METRICS)


def test_only_step_counts_are_defined_before_the_first_step(traced):
    state = replace(zeros(traced["full"].state), episode=episode_start("full"))
    result = jax.jit(episode_metrics)(BANK, state)
    assert {name for name, value in result.items() if bool(value.defined)} == {"steps", "last_step"}


def test_the_guide_lists_every_metric_with_its_unit(repository):
    page = (repository / "docs" / "guide" / "metrics.md").read_text()
    rows = dict(re.findall(r"^\| `(\w+)` \| ([\w/-]+) \|", page.partition("## Events")[2], re.M))
    assert rows == {name: metric.unit for name, metric in METRICS.items()}
    training = next(line for line in page.splitlines() if line.startswith("| `training`"))
    assert tuple(re.findall(r"`(\w+)`", training)[1:]) == SETS["training"]
