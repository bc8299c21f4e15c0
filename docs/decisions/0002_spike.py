"""Spike for decision 0002: do the core types carry everything that is to be built on them?

A toy bank (straight roads, toy facts, tiny networks) and the six uses that pull hardest on the types: SAC that replays
states, PPO, offline sampling from logs, hypothetical poses, reactive traffic, two controlled agents. Run it:
``python docs/decisions/0002_spike.py``. Nothing of it is imported by the package.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from drivax.geometry.boxes import overlap
from drivax.simulator.idm import IdmParameters, idm_acceleration

T, A, R, H, DT, START = 91, 6, 300, 5, 0.1, 10
record = lambda cls: jax.tree_util.register_dataclass(dataclass(frozen=True)(cls))  # noqa: E731


@record
class Bank:
    """Stacked scenarios. agents: x, y, cos, sin, speed, valid; route: x, y, heading at 1 m."""

    agents: jax.Array  # [N, T, A, 6]
    size: jax.Array  # [N, A, 2]
    route: jax.Array  # [N, R, 3]


@record
class Scene:
    """All that an observation depends on, beside the bank: what a replay stores."""

    index: jax.Array
    step: jax.Array
    slot: jax.Array
    history: jax.Array  # [H, 4] of the driven agent: x, y, heading, speed; the last row is now
    action: jax.Array  # [2] the last one
    route_m: jax.Array  # monotone projection on the route
    traffic: Any  # () when the others replay; arc length and speed per agent when they react


@record
class Facts:
    """Scalars measured at one pose; kept in the state."""

    collision: jax.Array
    offroad: jax.Array
    progress: jax.Array


@record
class State:
    """A scene plus what metrics need to remember about it."""

    scene: Scene
    facts: Facts
    contacts: jax.Array  # [A] int8: 0 absent, 1 apart, 2 touching, 3 ignored until they part
    start: jax.Array


@record
class Transition:
    """One step, with the states on both sides; ``after`` is never a reset state."""

    before: State
    after: State
    action: jax.Array
    reward: jax.Array
    terminated: jax.Array
    truncated: jax.Array


def toy_bank(key: jax.Array, n: int = 64) -> Bank:
    speed = jax.random.uniform(key, (n, A), minval=4.0, maxval=12.0)
    x = jnp.arange(A) * 14.0 + speed[:, None] * (jnp.arange(T)[:, None] - START) * DT
    zero, one = jnp.zeros_like(x), jnp.ones_like(x)
    agents = jnp.stack([x, zero + 3.5 * (jnp.arange(A) % 2), one, zero, speed[:, None] * one, one], -1)
    route = jnp.stack([jnp.arange(R) - 30.0, jnp.zeros(R), jnp.zeros(R)], -1)
    return Bank(agents, jnp.full((n, A, 2), jnp.array([4.8, 2.0])), jnp.tile(route, (n, 1, 1)))


def bicycle(motion: jax.Array, action: jax.Array) -> jax.Array:
    x, y, psi, v = motion
    a, k = 6.0 * action[0], 0.3 * action[1]
    after = jnp.maximum(v + a * DT, 0.0)
    d = jnp.where(v + a * DT < 0, v * v / jnp.maximum(2 * jnp.abs(a), 1e-6), (v + after) / 2 * DT)
    turned = psi + k * d
    mean = (psi + turned) / 2
    return jnp.stack([x + d * jnp.cos(mean), y + d * jnp.sin(mean), turned, after])


def row(motion: jax.Array) -> jax.Array:
    x, y, psi, v = motion
    return jnp.stack([x, y, jnp.cos(psi), jnp.sin(psi), v, jnp.ones(())])


def frame_at(bank: Bank, scene: Scene, back: int, cast: Scene) -> jax.Array:
    """Everyone ``back`` steps ago, [A, 6]; ``cast`` stacks the scenes of all driven agents [K]."""
    log = bank.agents[scene.index, scene.step - back]
    if not isinstance(scene.traffic, tuple):
        log = (
            log.at[:, 0]
            .set(scene.traffic[H - 1 - back, :, 0])
            .at[:, 4]
            .set(scene.traffic[H - 1 - back, :, 1])
        )
    return log.at[cast.slot].set(jax.vmap(row)(cast.history[:, H - 1 - back]))


def alone(scene: Scene) -> Scene:
    return jax.tree.map(lambda leaf: leaf[None], scene)


def box(agents: jax.Array, size: jax.Array) -> jax.Array:
    return jnp.concatenate([agents[..., :4], size], -1)


def offroad(bank: Bank, index: jax.Array, xy: jax.Array) -> jax.Array:
    """The map query: pure, per pose; the toy road is the band |y| < 6."""
    return jnp.abs(xy[1]) > 6.0


def measure(
    bank: Bank, scene: Scene, contacts: jax.Array, frame: jax.Array
) -> tuple[Facts, jax.Array, Scene]:
    me, size = frame[scene.slot], bank.size[scene.index]
    others = jnp.arange(A) != scene.slot
    hit = overlap(box(me, size[scene.slot])[None], box(frame, size)) & (frame[:, 5] > 0) & others
    old = (contacts == 3) | (contacts == 0)
    now = jnp.where(frame[:, 5] > 0, jnp.where(hit, jnp.where(old, 3, 2), 1), 0).astype(jnp.int8)
    along = jax.lax.dynamic_slice(bank.route[scene.index], (scene.route_m.astype(int), 0), (32, 3))
    nearest = jnp.argmin(jnp.sum((along[:, :2] - me[:2]) ** 2, -1))
    scene = replace(scene, route_m=scene.route_m + nearest)
    return Facts((now == 2).any(), offroad(bank, scene.index, me[:2]), scene.route_m), now, scene


def traffic_start(bank: Bank, index: jax.Array, step: jax.Array, reactive: bool) -> Any:
    if not reactive:
        return ()
    past = bank.agents[index, step - jnp.arange(H - 1, -1, -1)]
    return past[:, :, jnp.array([0, 4])]


def traffic_step(scene: Scene, frame: jax.Array) -> Any:
    if isinstance(scene.traffic, tuple):
        return ()
    x, v = scene.traffic[-1, :, 0], scene.traffic[-1, :, 1]
    ahead = frame[None, :, 0] - x[:, None]
    ahead = jnp.where(
        (ahead > 0.1) & (jnp.abs(frame[None, :, 1] - frame[:, None, 1]) < 2), ahead - 4.8, jnp.inf
    )
    leader = jnp.argmin(ahead, 1)
    a = idm_acceleration(v, jnp.full(A, 12.0), ahead.min(1), frame[leader, 4], IdmParameters())
    after = jnp.maximum(v + a * DT, 0)
    now = jnp.stack([x + (v + after) / 2 * DT, after], -1)
    return jnp.concatenate([scene.traffic[1:], now[None]])


def scene_from_log(bank: Bank, index: Any, step: Any, slot: Any, reactive: bool) -> Scene:
    """Idea 4: a logged moment is the same record as a simulated one."""
    past = bank.agents[index, step - jnp.arange(H - 1, -1, -1), slot]
    history = jnp.stack([past[:, 0], past[:, 1], jnp.arctan2(past[:, 3], past[:, 2]), past[:, 4]], -1)
    route_m = jnp.argmin(jnp.sum((bank.route[index, :, :2] - past[-1, :2]) ** 2, -1)).astype(float)
    step = jnp.asarray(step)
    traffic = traffic_start(bank, index, step, reactive)
    return Scene(jnp.asarray(index), step, jnp.asarray(slot), history, jnp.zeros(2), route_m, traffic)


def reset(bank: Bank, index: Any, slot: Any = 0, step: Any = START, reactive: bool = False) -> State:
    scene = scene_from_log(bank, index, step, slot, reactive)
    facts, contacts, scene = measure(
        bank, scene, jnp.full(A, 3, jnp.int8), frame_at(bank, scene, 0, alone(scene))
    )
    return State(scene, facts, contacts, scene.step)


def move(bank: Bank, state: State, action: jax.Array, motion: jax.Array | None, cast: Scene) -> State:
    scene = state.scene
    now = bicycle(scene.history[-1], action) if motion is None else motion
    return replace(
        state,
        scene=replace(
            scene,
            step=scene.step + 1,
            history=jnp.concatenate([scene.history[1:], now[None]]),
            action=action,
            traffic=traffic_step(scene, frame_at(bank, scene, 0, cast)),
        ),
    )


def settle(bank: Bank, before: State, moved: State, cast: Scene) -> Transition:
    facts, contacts, scene = measure(bank, moved.scene, before.contacts, frame_at(bank, moved.scene, 0, cast))
    after = replace(moved, scene=scene, facts=facts, contacts=contacts)
    bad = facts.collision | facts.offroad
    reward = 0.2 * jnp.clip((facts.progress - before.facts.progress) / 1.2, 0, 1) - bad
    return Transition(before, after, scene.action, reward, bad, scene.step >= T - 1)


def step(bank: Bank, state: State, action: jax.Array, motion: jax.Array | None = None) -> Transition:
    moved = move(bank, state, action, motion, alone(state.scene))
    return settle(bank, state, moved, alone(moved.scene))


def step_together(bank: Bank, states: State, actions: jax.Array) -> Transition:
    """Several driven agents of one scenario: a stack of states [K] that see each other through the frame."""
    moved = jax.vmap(lambda s, a: move(bank, s, a, None, states.scene))(states, actions)
    return jax.vmap(lambda s, m: settle(bank, s, m, moved.scene))(states, moved)


def observe(bank: Bank, scene: Scene, cast: Scene | None = None) -> jax.Array:
    cast = alone(scene) if cast is None else cast
    frame, old = frame_at(bank, scene, 0, cast), frame_at(bank, scene, 2, cast)
    me = frame[scene.slot]
    near = jnp.concatenate([(frame - me)[:, :2] / 50, (old - me)[:, :2] / 50, frame[:, 4:5] / 15], -1)
    own = jnp.stack([me[4] / 15, scene.history[-1, 2], me[1] / 5, *scene.action])
    return jnp.concatenate([own, near.ravel()])


def expert_action(bank: Bank, scene: Scene) -> jax.Array:
    v = bank.agents[scene.index, jnp.minimum(scene.step + 1, T - 1), scene.slot, 4]
    return jnp.stack([jnp.clip((v - scene.history[-1, 3]) / DT / 6, -1, 1), 0.0])


def reset_where(bank: Bank, key: jax.Array, t: Transition, reactive: bool) -> State:
    n = bank.agents.shape[0]
    fresh = jax.vmap(lambda k: reset(bank, jax.random.randint(k, (), 0, n), reactive=reactive))
    done = t.terminated | t.truncated
    new = fresh(jax.random.split(key, done.shape[0]))
    return jax.tree.map(lambda a, b: jnp.where(done.reshape(-1, *[1] * (a.ndim - 1)), a, b), new, t.after)


# --- the six uses ---------------------------------------------------------------------------------------------------
def net(key: jax.Array, *sizes: int) -> list[jax.Array]:
    keys = jax.random.split(key, len(sizes))
    return [
        jax.random.normal(k, (a, b)) / np.sqrt(a) for k, a, b in zip(keys, sizes, sizes[1:], strict=False)
    ]


def apply(w: list[jax.Array], x: jax.Array) -> jax.Array:
    for layer in w[:-1]:
        x = jax.nn.tanh(x @ layer)
    return x @ w[-1]


def sac_update(bank: Bank, w: dict[str, Any], replay: Transition, rows: jax.Array) -> Any:
    """Critic step on replayed states: observed when sampled, on both sides of the step."""
    look = jax.vmap(partial(observe, bank))
    at = jax.tree.map(lambda leaf: leaf[rows], replay)
    now, then = look(at.before.scene), look(at.after.scene)
    target_action = jnp.tanh(apply(w["policy"], then))
    bootstrap = jnp.where(at.terminated, 0.0, 0.99 * apply(w["target"], jnp.c_[then, target_action])[:, 0])
    target = jax.lax.stop_gradient(at.reward + bootstrap)
    loss = lambda q: jnp.mean((apply(q, jnp.c_[now, at.action])[:, 0] - target) ** 2)  # noqa: E731
    value, grad = jax.value_and_grad(loss)(w["critic"])
    return {**w, "critic": jax.tree.map(lambda p, g: p - 1e-2 * g, w["critic"], grad)}, value


def collect(
    bank: Bank, policy: list[jax.Array], states: State, key: jax.Array, steps: int, reactive: bool
) -> Any:
    def one(carry: tuple[State, jax.Array], _: None) -> Any:
        states, key = carry
        key, act_key, reset_key = jax.random.split(key, 3)
        mean = jnp.tanh(apply(policy, jax.vmap(partial(observe, bank))(states.scene)))
        action = jnp.clip(mean + jax.random.normal(act_key, mean.shape), -1, 1) * jnp.array([0.5, 0.01])
        t = jax.vmap(partial(step, bank))(states, action)
        return (reset_where(bank, reset_key, t, reactive), key), t

    return jax.lax.scan(one, (states, key), None, steps)


def main() -> None:
    key = jax.random.key(0)
    bank = toy_bank(key)
    batch = jax.vmap(lambda i: reset(bank, i))(jnp.arange(32))
    dim = observe(bank, jax.tree.map(lambda leaf: leaf[0], batch.scene)).shape[0]
    w = {
        "policy": net(key, dim, 32, 2),
        "critic": net(key, dim + 2, 32, 1),
        "target": net(key, dim + 2, 32, 1),
    }

    # 1 PPO-style collection: resets inside, truncation bootstraps the final state because ``after`` is never a reset.
    (_, _), rollout = jax.jit(partial(collect, steps=100, reactive=False))(bank, w["policy"], batch, key)
    assert bool(rollout.truncated.any()) and int(rollout.after.scene.step.max()) == T - 1
    assert bool((rollout.before.scene.step[1:] <= rollout.after.scene.step[1:]).all())

    # 2 SAC: what is replayed is the scene; observing it later gives bit for bit what the policy saw.
    replay = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), rollout)
    stored = sum(leaf.nbytes for leaf in jax.tree.leaves(replay.before.scene)) // replay.reward.shape[0]
    update = jax.jit(sac_update)
    losses = []
    for k in jax.random.split(key, 200):
        w, loss = update(bank, w, replay, jax.random.randint(k, (256,), 0, replay.reward.shape[0]))
        losses.append(float(loss))
    assert np.mean(losses[-20:]) < 0.5 * np.mean(losses[:20])

    # 3 Offline: (scenario, step) -> the same transition as driving the expert there.
    driven = reset(bank, 3)
    for _ in range(7):
        t = step(bank, driven, expert_action(bank, driven.scene))
        driven = t.after
    sampled = reset(bank, 3, step=START + 7)
    gap = jnp.abs(observe(bank, driven.scene)[:3] - observe(bank, sampled.scene)[:3]).max()
    assert float(gap) < 1e-4, gap

    # 4 PDM: hypothetical poses are rows of numbers, tested by the same queries: 15 proposals x 40 steps, no state.
    poses = jax.vmap(
        lambda k: jax.lax.scan(lambda m, _: (bicycle(m, k),) * 2, driven.scene.history[-1], None, 40)[1]
    )(jax.random.uniform(key, (15, 2), minval=-1, maxval=1))
    off = jax.vmap(jax.vmap(lambda p: offroad(bank, driven.scene.index, p[:2])))(poses)
    assert off.shape == (15, 40) and bool(off.any()) and not bool(off.all())

    # 5 Reactive traffic: a standing ego is no longer driven into.
    crash = {}
    for reactive in (False, True):
        stand = reset(bank, 5, slot=2, reactive=reactive)
        hits = 0
        for _ in range(80):
            t = jax.jit(step)(bank, stand, jnp.array([-1.0, 0.0]))
            stand, hits = t.after, hits + int(t.after.facts.collision)
        crash[reactive] = hits
    assert crash[True] == 0 < crash[False], crash

    # 6 Two controlled agents: a stack of states; each sees the other's driven pose, not its log.
    pair = jax.vmap(lambda slot: reset(bank, 5, slot))(jnp.array([0, 2]))
    for _ in range(10):
        pair = jax.jit(step_together)(bank, pair, jnp.array([[0.0, 0.0], [-1.0, 0.0]])).after
    seen = frame_at(bank, jax.tree.map(lambda leaf: leaf[0], pair.scene), 0, pair.scene)
    assert float(jnp.abs(seen[2, 0] - pair.scene.history[1, -1, 0])) < 1e-5
    assert float(bank.agents[5, 20, 2, 0] - seen[2, 0]) > 2.0
    print(
        f"replayed scene: {stored} B; stored observation: {4 * dim} B; critic loss {losses[0]:.3f} -> {losses[-1]:.4f}"
    )


if __name__ == "__main__":
    main()
