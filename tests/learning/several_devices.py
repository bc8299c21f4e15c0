"""Train on one device and on several, in a process that simulates four: run by ``test_devices.py``."""

import shutil
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
from test_resume import ALGORITHMS, SHOWN

from drivax.errors import UsageError
from drivax.learning.algorithms.cql import CqlConfig
from drivax.learning.algorithms.iql import IqlConfig
from drivax.learning.algorithms.td3_bc import Td3BcConfig
from drivax.learning.config import TrainConfig
from drivax.learning.driving import Driving
from drivax.learning.loop import train
from drivax.learning.mixture import Mixture
from drivax.learning.program import Program, Seeds
from drivax.learning.self_play import SelfPlay, SelfPlayConfig
from drivax.scenario.bank.scenario_bank import ScenarioBank
from drivax.scenario.build.assemble import assemble
from drivax.scenario.schema import CAPACITIES
from drivax.scenario.store import ScenarioSet
from drivax.simulator.simulator import Simulator
from drivax.simulator.traffic.log import LogTraffic
from drivax.synthetic.generate import Generation, generate
from drivax.synthetic.world import generate_recording
from drivax.tasks.observations import ObservationConfig
from drivax.tasks.task import Task
from drivax.tracking.checkpoints import Checkpoints
from drivax.tracking.sinks import read_rows
from pendulum import Pendulum
from tiny_algorithms import TINY

#: With losses that are scaled by a mean over the batch, where there are any.
OFFLINE = {
    "driving_iql": IqlConfig(batch=8, updates=2, network=TINY),
    "driving_td3_bc": Td3BcConfig(batch=8, updates=2, network=TINY, delay=1),
    "driving_cql": CqlConfig(batch=8, updates=2, network=TINY, imitation=1.0, gap=0.1, next_actions=True),
}
OBSERVATION = ObservationConfig(agents=1, steps=1, road=0, lights=1, route=2)


def problem(name):
    """The learner of a name, and its data: the pendulum's, or for ``driving_*`` a scenario."""
    if not name.startswith("driving_"):
        return ALGORITHMS[name].build(Pendulum(), SHOWN, 6), SHOWN
    capacity = CAPACITIES["default"].with_egos(3)
    bank = ScenarioBank.from_scenarios([assemble(generate_recording(7, 0), capacity)])
    environment = Driving(Simulator(Task(observation=OBSERVATION, metrics=("steps",))), latest_start=60)
    if name == "driving_self_ppo":
        group = SelfPlay(environment.simulator, latest_start=60, config=SelfPlayConfig(2, past=1.0))
        mixture = Mixture((("log", environment), ("self", group)), (0.5, 0.5))
        return ALGORITHMS["ppo"].build(mixture, bank, 6), bank
    if config := OFFLINE.get(name):
        return config.build(environment, bank, 6), config.experience(environment, bank, None)
    return ALGORITHMS[name.removeprefix("driving_")].build(environment, bank, 6), bank


def run(learner, data, seeds, devices):
    """Parameters and logs after three iterations; shapes of what each device holds; bytes by part."""
    program = Program(Seeds(learner, seeds), data, devices)
    assert len(program.devices) == (devices or 4), program.devices
    for leaf in jax.tree.leaves(program.data):
        copies = {shard.data.unsafe_buffer_pointer() for shard in leaf.addressable_shards}
        assert leaf.nbytes < 1024 or len(copies) == 1, "cores share one copy of the data"
    state = program.initial_state()
    for _ in range(3):
        state, logs, _ = program.step(state)
    inner = getattr(state, "learner", state)
    environments = getattr(inner, "environments", None)
    held = {
        "over": getattr(environments, "over", None),
        "reward": getattr(getattr(inner, "replay", None), "reward", None),
    }
    shards = {name: leaf.sharding.shard_shape(leaf.shape) for name, leaf in held.items() if leaf is not None}
    spread = {len(leaf.sharding.device_set) for leaf in jax.tree.leaves((environments, state.parameters))}
    assert spread == {len(program.devices)}, spread
    return jax.device_get((state.parameters, logs)), shards, program.account().sizes


def same(one, other):
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=2e-3, atol=2e-5), one, other)


def check_environments(learner, data, counts):
    """Return the result of one device, after the same of several with their share of environments and replay buffer."""
    one, whole, sizes = run(learner, data, (3,), 1)
    for devices in counts:
        several, shards, parts = run(learner, data, (3,), devices)
        same(one, several)
        count = devices or 4
        assert shards == {name: (*shape[:-1], shape[-1] // count) for name, shape in whole.items()}, shards
        assert parts["environments"] == sizes["environments"] // count, parts
        # The replay's place in the ring is on every device.
        assert sizes["replay"] // count <= parts["replay"] <= sizes["replay"] // count + 8, parts
    return one


def check_seeds(learner, data, one):
    """Two seeds on two devices, one each: the first learns what it learns alone, the second something else."""
    pair, shards, _ = run(learner, data, (3, 4), 2)
    first, second = (Seeds(learner, (3, 4)).member(pair, number) for number in (0, 1))
    same(one, first)
    apart = jax.tree.map(lambda a, b: np.abs(a - b).max(), first[0], second[0])
    assert max(jax.tree.leaves(apart)) > 0.1, apart
    assert shards["over"] == (1, 4), shards


def check_refused(learner, data, devices, words):
    try:
        Program(Seeds(learner, (3,)), data, devices)
    except UsageError as error:
        assert words in str(error), error
    else:
        raise AssertionError(f"{devices} devices")


def check_batches(learner, data):
    """Without environments, every device has the whole state, and its share of the work."""
    one, _, _ = run(learner, data, (3,), 1)
    work = []
    for devices in (2, None):
        several, _, _ = run(learner, data, (3,), devices)
        same(one, several)
    pair, _, _ = run(learner, data, (3, 4), 2)
    same(one, Seeds(learner, (3, 4)).member(pair, 0))
    for devices in (1, 4):
        program = Program(Seeds(learner, (3,)), data, devices)
        work.append(program.compiled.cost_analysis()["flops"])
    assert work[1] < 0.6 * work[0], work
    check_refused(learner, data, 3, "8 steps per batch cannot be divided among 3 devices")


def whole_runs(folder):
    """A run on two devices equals one on one device: parameters, validations, and the last half once resumed."""
    generate(folder / "set", 2, 7, Generation(workers=0))
    data = ScenarioSet.open(folder / "set")
    task = Task(observation=OBSERVATION, metrics=("steps",))
    algorithm, count = ALGORITHMS["ppo"], 4
    config = TrainConfig(
        task=task, algorithm=algorithm, total_steps=count * algorithm.steps_per_iteration, latest_start=60,
        evaluate_every=2, checkpoint_every=2, keep=5, devices=2,
    )  # fmt: skip

    def driven(name, **changes):
        run = train(replace(config, **changes), data, folder / name, validation=data)
        rows = [row for row in read_rows(run.path / "metrics.jsonl") if "validation/vmax_score" in row]
        assert len(rows) == 2, rows
        return run, rows

    def parameters(run):
        shapes = jax.eval_shape(algorithm.build(environment, bank, count).init, bank, jax.random.key(0))
        return jax.device_get(Checkpoints(run.checkpoints).restore(shapes).parameters)

    environment, bank = config.environment(LogTraffic()), ScenarioBank.from_scenarios(data)
    (one, shown), (two, others) = driven("one", devices=1), driven("two")
    same(parameters(one), parameters(two))
    for row, other in zip(shown, others, strict=True):
        assert abs(row["validation/vmax_score"] - other["validation/vmax_score"]) < 1e-3, (row, other)
    before = parameters(two)
    last = sorted(two.checkpoints.glob("step-*"))[-1]
    shutil.rmtree(last)
    again = train(config, data, two.path, validation=data, resume=True)
    same(before, parameters(again))
    assert sorted(again.checkpoints.glob("step-*"))[-1] == last


def main(name, extent):
    if extent == "runs":
        with tempfile.TemporaryDirectory() as folder:
            whole_runs(Path(folder))
        print("same")
        return
    learner, data = problem(name)
    if extent == "batches":
        check_batches(learner, data)
    elif extent == "two":
        check_environments(learner, data, (2,))
    else:
        one = check_environments(learner, data, (2, None))
        check_seeds(learner, data, one)
        check_refused(learner, data, 3, "4 environments cannot be divided among 3 devices")
    print("same")


if __name__ == "__main__":
    main(*sys.argv[1:])
