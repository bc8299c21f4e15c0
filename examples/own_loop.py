"""Train SAC with your own training loop; the parameters equal those of ``drivax.train(..., validation=None)``."""

import tempfile
from dataclasses import replace
from pathlib import Path

import jax

import drivax
from drivax.learning import ReplayConfig, SacConfig, TrainConfig, make_agent

folder = Path(tempfile.mkdtemp())
drivax.generate(folder / "set", scenarios=4, seed=0)
data = drivax.load(folder / "set")
algorithm = SacConfig(replay=ReplayConfig(1_000), environments=4, unroll=8, batch=16, warm_up=32)
config = TrainConfig(algorithm=algorithm, total_steps=128)
agent = make_agent(config, data.bank)
environment = agent.environment


@jax.jit
def iteration(bank, state):
    """Collect ``unroll`` steps in all environments, add them to the replay buffer, and update."""

    def step(carry, _):
        now, cache, key = carry
        key, act_key, step_key = jax.random.split(key, 3)
        sampled = agent.sample_action(state, now.observation, act_key)
        drawn = environment.draw(bank, step_key, algorithm.environments)
        after, outcome = environment.step(bank, now, cache, sampled.action, drawn)
        return (after, outcome.cache, key), agent.transition(now, sampled, outcome)

    cache = environment.cache(bank, state.environments.state)
    first = (state.environments, cache, agent.rollout_key(state))
    (environments, _, _), rollout = jax.lax.scan(step, first, None, algorithm.unroll)
    replay = agent.buffer.add(state.replay, rollout)
    return agent.update(bank, replace(state, environments=environments, replay=replay))


state = jax.jit(agent.init)(data.bank, jax.random.key(config.seed))
for _ in range(config.iterations):
    state, logs = iteration(data.bank, state)
planner = agent.planner(state.parameters, "my_policy", samples=False)
success = drivax.evaluate(planner, data, task=config.task).summary()["metrics"]["success"]
print(f"success {success['mean']:.2f} in {success['n']} scenarios")
