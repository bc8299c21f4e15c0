"""The attention encoders again, in NumPy and with loops, from their equations; one observation, float64.

Parameters are the plain nested dictionaries of ``nnx.to_pure_dict``.
"""

import numpy as np


def softmax(logits):
    weights = np.exp(logits - np.max(logits))
    return weights / weights.sum()


def norm(x, p):
    centred = x - x.mean(-1, keepdims=True)
    return centred / np.sqrt((centred**2).mean(-1, keepdims=True) + 1e-6) * p["scale"] + p["bias"]


def dense(x, p):
    return x @ p["kernel"] + p["bias"]


def attention(queries, tokens, mask, p):
    """Every head of every query by itself."""
    _, heads, size = p["query"].shape
    there = np.flatnonzero(mask)
    out = np.zeros_like(queries)
    for number, asked in enumerate(queries):
        for head in range(heads if len(there) else 0):
            q = asked @ p["query"][:, head]
            logits = np.array([q @ (tokens[k] @ p["key"][:, head]) for k in there]) / np.sqrt(size)
            weights = softmax(logits)
            found = sum(w * (tokens[k] @ p["value"][:, head]) for w, k in zip(weights, there, strict=True))
            out[number] += found @ p["out"][head]
    return out


def attend(x, p, tokens=None, mask=None):
    normed = norm(x, p["norm"])
    tokens = normed if tokens is None else tokens
    mask = np.ones(len(tokens), bool) if mask is None else mask
    return x + attention(normed, tokens, mask, p["attention"])


def feed_forward(x, p):
    wide = dense(norm(x, p["norm"]), p["wide"])
    gelu = 0.5 * wide * (1 + np.tanh(np.sqrt(2 / np.pi) * (wide + 0.044715 * wide**3)))
    return x + dense(gelu, p["narrow"])


def self_attention(x, p, mask=None):
    return feed_forward(attend(x, p["attend"], mask=mask), p["feed_forward"])


def time_code(times, width):
    code = np.zeros((times, width))
    for step in range(times):
        for axis in range(width):
            angle = (times - 1 - step) / 10_000 ** (2 * (axis // 2) / width)
            code[step, axis] = np.sin(angle) if axis % 2 == 0 else np.cos(angle)
    return code


def rows_of(groups, name):
    """A group as ``[rows, times, F]`` with its mask, and whether it has times."""
    value, mask = np.asarray(groups[name], float), groups.get(f"{name}_mask")
    if mask is None:
        series = value.ndim > 1
        value = value[None] if series else value[None, None]
        return value, np.ones(value.shape[:2], bool), series
    mask, series = np.asarray(mask), value.ndim > 2
    value = value if series else value[:, None]
    mask = mask if series else mask[:, None]
    return np.where(mask[..., None], value, 0.0), mask, series


def tokens(groups, name, p):
    x, mask, series = rows_of(groups, name)
    for number in sorted(p.get("hidden", {}).get(name, {})):
        x = np.maximum(dense(x, p["hidden"][name][number]), 0.0)
    x = dense(x, p["out"][name])
    if series:
        x = x + time_code(x.shape[1], x.shape[2])
    return norm(x, p["norms"][name]), mask


def latents(x, mask, p):
    found = p["first"]
    for number in sorted(p["layers"]):
        if number in p["looks"]:
            found = attend(found, p["looks"][number], x, mask)
        found = self_attention(found, p["layers"][number])
    return norm(found, p["norm"])


def factorised(x, mask, p):
    x = np.stack([self_attention(row, p["time"], m) for row, m in zip(x, mask, strict=True)])
    columns = [self_attention(x[:, t], p["space"], mask[:, t]) for t in range(x.shape[1])]
    return norm(np.stack(columns, axis=1), p["norm"])


def latent_encoder(groups, names, p):
    """``lq``, ``lqh`` and every ``wayformer``: which parts there are says which."""
    parts = []
    for name in names:
        x, mask = tokens(groups, name, p["embedding"])
        if name in p.get("before", {}):
            x = factorised(x, mask, p["before"][name])
        x, mask = x.reshape(-1, x.shape[-1]), mask.ravel()
        if name in p.get("local", {}):
            x = latents(x, mask, p["local"][name])
            mask = np.ones(len(x), bool)
        parts.append((x, mask))
    x, mask = (np.concatenate(side) for side in zip(*parts, strict=True))
    for number in sorted(p.get("whole", {})):
        x = latents(x, mask, p["whole"][number])
    return x.mean(0)


def mean(x, mask):
    return x[mask].mean(0) if mask.any() else np.zeros(x.shape[-1])


def mtr(groups, movers, around, own, p):
    places, own_rows, masks = [], [], []
    for name in movers:
        x, mask = tokens(groups, name, p["embedding"])
        series = rows_of(groups, name)[2]
        for row, m in zip(x, mask, strict=True):
            places.append(mean(self_attention(row, p["time"], m), m) if series else row[0])
            masks.append(m.any())
            own_rows.append(name in own)
    seen = [tokens(groups, name, p["embedding"]) for name in around]
    x, mask = np.array(places), np.array(masks)
    for number in sorted(p["feed_forward"]):
        x = attend(x, p["among"][number], mask=mask)
        if seen:
            here = np.concatenate([t.reshape(-1, t.shape[-1]) for t, _ in seen])
            x = attend(x, p["around"][number], here, np.concatenate([m.ravel() for _, m in seen]))
        x = feed_forward(x, p["feed_forward"][number])
    return mean(norm(x, p["norm"]), mask & np.array(own_rows))


def entity(groups, parts, p):
    """``parts`` are the names of groups by part, ego, others, goal and context."""

    def entities(name):
        x, mask, series = rows_of(groups, name)
        numbers = [np.concatenate([row.ravel(), m if series else []]) for row, m in zip(x, mask, strict=True)]
        return np.maximum(dense(np.array(numbers), p["layers"][name]), 0.0), mask.any(-1)

    rows = {part: [entities(name) for name in names] for part, names in parts.items() if names}
    rows = {
        part: tuple(np.concatenate(side) for side in zip(*found, strict=True)) for part, found in rows.items()
    }
    found = {part: mean(*entities) for part, entities in rows.items()}
    asks = found.get("ego", 0.0) + found.get("goal", 0.0)
    found["others"] = norm(attention(asks[None], *rows["others"], p["attention"])[0], p["norm"])
    return np.concatenate([found[part] for part in ("ego", "others", "goal", "context") if part in found])
