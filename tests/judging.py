"""Evaluate given motions of ego: every metric and step value, in one compiled program."""

from __future__ import annotations

from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np

from drivax.evaluation.rollout import evaluation_task
from drivax.metrics.episode import episode_metrics, event_steps
from drivax.metrics.steps import step_metrics
from drivax.simulator.simulator import Simulator
from drivax.simulator.traffic.log import logged_history
from drivax.tasks.task import Task
from scenes import bank_of

#: Scenarios of a program call; shorter batches are padded.
BATCH = 16
START = 10


@cache
def _program():
    simulator = Simulator(evaluation_task(Task()))

    def evaluate(bank, rows, motions):
        def step(state, pose):
            state, _ = simulator.replay(bank, state, pose, jnp.zeros(2))
            return state, step_metrics(simulator.situation(bank, state))

        begin = jax.vmap(lambda row: simulator.reset(bank, row, START))(rows)
        # Map the step, not the loop: to map a loop, JAX traces its body several times.
        states, series = jax.lax.scan(jax.vmap(step), begin, jnp.swapaxes(motions, 0, 1))
        metrics = jax.vmap(partial(episode_metrics, bank))(states)
        series = jax.tree.map(lambda leaf: jnp.swapaxes(leaf, 0, 1), series)
        return metrics, jax.vmap(event_steps)(states.episode), series

    def log(bank, row):
        return jax.vmap(lambda t: logged_history(bank, row, t, 0)[-1])(jnp.arange(bank.steps))

    return jax.jit(evaluate), jax.jit(jax.vmap(log, (None, 0)))


def judge(recordings, motions=None):
    """Metrics of ego's logs, or of other motions.

    Args:
        recordings: The recordings.
        motions: For each None (the log), or a function from the logged motion ``[91, 4]`` in the scenario's frame (x,
            y, heading, speed) to ego's motion, of which the rows after ``START`` count.

    Returns:
        For each recording a dict: metrics by name (None where undefined), ``<event>_step`` of the first events (-1 for
        none), and under ``series`` each step value as an array ``[80]``, NaN where undefined.
    """
    results = []
    judge_all, logs = _program()
    for first in range(0, len(recordings), BATCH):
        part = list(recordings[first : first + BATCH])
        count = len(part)
        bank = bank_of(*part, *[part[-1]] * (BATCH - count))
        log = np.asarray(logs(bank, jnp.arange(BATCH)), np.float64)
        for row in range(count):
            if motions is not None and motions[first + row] is not None:
                log[row] = motions[first + row](log[row])
        motion = jnp.asarray(log[:, START + 1 :], jnp.float32)
        values = jax.tree.map(np.asarray, judge_all(bank, jnp.arange(BATCH), motion))
        results += [_named(jax.tree.map(partial(_row, row), values)) for row in range(count)]
    return results


def _row(row, leaf):
    return leaf[row]


def _named(values):
    metrics, events, series = values
    named = {name: float(v.value) if v.defined else None for name, v in metrics.items()}
    named |= {f"{name}_step": int(step) for name, step in events.items()}
    named["series"] = {name: np.where(v.defined, v.value, np.nan) for name, v in series.items()}
    return named
