"""Minari data sets: episodes of drivax for other programs, and episodes of other programs for offline algorithms.

Needs the extra ``minari``. Observations are those of the Gymnasium environments (:mod:`drivax.adapters.gym`).
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from drivax.adapters.gym import LIMIT, action_space, observation_space
from drivax.errors import DataError, UsageError, explain_missing_package
from drivax.files import replace_folder
from drivax.learning.recorded_episodes import StoredEpisode, StoredEpisodes, minari_folder
from drivax.reading import explain_damage, read_json
from drivax.tasks.task import Task

with explain_missing_package():
    import h5py
    import minari
    from gymnasium import spaces
    from minari.data_collector import EpisodeBuffer
    from minari.dataset.minari_dataset import parse_dataset_id
    from minari.dataset.minari_storage import METADATA_FILE_NAME, MinariStorage

_DATA_FILE = "main_data.hdf5"
_CURE = "download or export the data set again"
#: Largest size of the arrays that are read, bytes, or as a multiple of the file if that is more.
_MOST_BYTES, _MOST_RATIO = 2**30, 16
#: Episodes that are written at once.
_CHUNK = 256


def write_minari(
    out: Path, task: Task, episodes: Iterable[StoredEpisode], **metadata: Any
) -> tuple[int, int]:
    """Write episodes as the folder of a Minari data set; return the numbers of episodes and steps.

    The id is ``drivax/NAME-v0`` for a folder NAME, or its path below a folder ``drivax`` if that is an id.
    ``infos/clipped`` is 1 at steps whose action does not lead to the next state, for example because it was clipped.

    Args:
        out: Folder to write; it must not exist.
        task: The task of the episodes.
        episodes: The episodes.
        metadata: Further entries of the metadata, such as ``description``.

    Raises:
        UsageError: The name of the folder is not an id of Minari, or actions are not continuous in [-1, 1].
    """
    actions = action_space(task)
    if not isinstance(actions, spaces.Box):
        raise UsageError("actions are discrete", cure="export episodes of a continuous action space")
    name = out.name if "-v" in out.name else f"{out.name}-v0"
    try:
        parse_dataset_id(f"drivax/{name}")
    except ValueError as error:
        raise UsageError(
            f"{name!r} is not a name of a Minari data set", file=out, cure="use letters"
        ) from error
    stream = iter(episodes)
    count = steps = 0
    with replace_folder(out) as partial:
        (partial / "data").mkdir()
        storage: MinariStorage | None = None
        while chunk := list(itertools.islice(stream, _CHUNK)):
            if storage is None:
                observations = observation_space({k: v[0] for k, v in chunk[0].observation.items()})
                storage = MinariStorage.new(partial / "data", observations, actions)
                storage.update_metadata(
                    {"dataset_id": f"drivax/{name}", "minari_version": minari.__version__, **metadata}
                )
            storage.update_episodes([_buffer(episode) for episode in chunk])
            count, steps = count + len(chunk), steps + sum(len(episode.reward) for episode in chunk)
        if storage is None:
            raise DataError("no episode has a step", cure="record others")
    return count, steps


def _buffer(episode: StoredEpisode) -> EpisodeBuffer:
    groups = {name: values for name, values in episode.observation.items() if values.size}
    last = np.arange(len(episode.reward)) == len(episode.reward) - 1
    values: dict[str, Any] = {
        "observations": {
            name: values.astype(np.int8) if values.dtype == bool else np.clip(values, -LIMIT, LIMIT)
            for name, values in groups.items()
        },
        "actions": episode.action,
        "rewards": episode.reward,
        "terminations": last & episode.terminated,
        "truncations": last & (not episode.terminated),
        # Gymnasium has an info after the reset, too.
        "infos": {
            "clipped": np.append(False, episode.clipped).astype(np.int8),
            "scenario": np.full(len(last) + 1, episode.scenario, np.int32),
        },
    }
    return EpisodeBuffer(**values)


def read_minari(path: str | Path) -> StoredEpisodes:
    """Read a Minari data set: the folder of its id, or the ``data`` in it.

    Observations are a ``Box``, whose group is called ``observation``, or a ``Dict`` of arrays. Actions are scaled from
    the bounds of a ``Box`` to [-1, 1]. No environment is made, and none of the code that the metadata name is run.

    Raises:
        DataError: The data set is missing or damaged, or too large.
        UsageError: Actions are not a bounded ``Box``, or observations not arrays.
    """
    folder = minari_folder(path)
    if folder is None:
        raise DataError("not a Minari data set", file=path, cure=_CURE)
    metadata = read_json(folder / METADATA_FILE_NAME, _CURE)
    for name in ("observation_space", "action_space"):  # without these, Minari makes the environment
        if not isinstance(metadata, Mapping) or not isinstance(metadata.get(name), str):
            raise DataError(f"metadata lack {name}", file=folder, cure=_CURE)
    if metadata.get("data_format", "hdf5") != "hdf5":
        problem = f"its format is {metadata['data_format']}"
        raise UsageError(problem, file=folder, cure="convert it to hdf5, Minari's default")
    with explain_damage(folder, _CURE, "cannot be read"):
        most_bytes = max(_MOST_BYTES, _MOST_RATIO * (folder / _DATA_FILE).stat().st_size)
        _check_content(folder / _DATA_FILE, most_bytes)
        storage = MinariStorage.read(folder)
        low, high = _bounds(storage.action_space, folder)
        observations = storage.observation_space
        names = list(observations.spaces) if isinstance(observations, spaces.Dict) else ["observation"]
        groups = observations.spaces if isinstance(observations, spaces.Dict) else {names[0]: observations}
        for name, space in groups.items():
            if not (isinstance(space, spaces.MultiBinary) or np.dtype(space.dtype).kind == "f"):
                raise UsageError(f"observation {name} is {space}", file=folder, cure="use real numbers")
        episodes = [
            _episode(entry, groups, low, high)
            for entry in storage.get_episodes(range(storage.total_episodes))
        ]
    if not episodes:
        raise DataError("contains no episodes", file=folder, cure=_CURE)
    # Episodes are padded to the longest one.
    floats = sum(values[0].size for values in episodes[0].observation.values()) + len(low) + 1
    _check_bytes(4 * floats * len(episodes) * max(len(e.reward) + 1 for e in episodes), most_bytes, folder)
    return StoredEpisodes.of(episodes)


def _check_content(file: Path, most_bytes: int) -> None:
    """Check an HDF5 file.

    Raises:
        DataError: It contains links, or its arrays are too large, or lie in other files.
    """
    size = 0
    with h5py.File(file) as content:
        groups: list[Any] = [content]
        while groups:
            group = groups.pop()
            for name in group:
                if not isinstance(group.get(name, getlink=True), h5py.HardLink):
                    raise DataError(f"{name} is a link", file=file, cure=_CURE)
                item: Any = group[name]
                if isinstance(item, h5py.Group):
                    groups.append(item)
                elif item.external or item.is_virtual:
                    raise DataError(f"{name} lies in another file", file=file, cure=_CURE)
                else:
                    size += item.size * item.dtype.itemsize
    _check_bytes(size, most_bytes, file)


def _check_bytes(size: int, most_bytes: int, file: Path) -> None:
    if size > most_bytes:
        raise DataError(f"needs {size:,} bytes of memory", file=file, cure="take a smaller data set")


def _bounds(space: spaces.Space[Any], folder: Path) -> tuple[np.ndarray, np.ndarray]:
    """Return the bounds of actions."""
    if isinstance(space, spaces.Box) and space.is_bounded() and len(space.shape) == 1:
        return space.low, space.high
    raise UsageError(
        "actions have no bounds", file=folder, cure="take a data set of bounded continuous actions"
    )


def _episode(
    entry: Mapping[str, Any], groups: Mapping[str, Any], low: np.ndarray, high: np.ndarray
) -> StoredEpisode:
    """Return an episode of Minari.

    Raises:
        ValueError: Lengths or shapes differ, or a number is not finite.
    """
    action = np.asarray(entry["actions"], np.float32)
    reward = np.asarray(entry["rewards"], np.float32)
    length = len(reward)
    stored = entry["observations"]
    observation = {}
    for name, space in groups.items():
        values = np.asarray(stored[name] if isinstance(stored, dict) else stored)
        if values.shape != (length + 1, *space.shape):
            raise ValueError(f"observation {name} has the shape {values.shape}")
        observation[name] = values.astype(bool if values.dtype == np.int8 else np.float32)
    terminations = np.asarray(entry["terminations"], bool)
    if not length or action.shape != (length, len(low)) or terminations.shape != (length,):
        raise ValueError(f"{length} rewards, actions of the shape {action.shape}")
    if not all(np.isfinite(values).all() for values in (action, reward, *observation.values())):
        raise ValueError("a number is not finite")
    if terminations[:-1].any():
        raise ValueError("an episode goes on after its termination")
    scaled = 2.0 * (action - low) / (high - low) - 1.0
    infos = entry.get("infos") or {}
    clipped = np.asarray(infos["clipped"], bool)[1:] if "clipped" in infos else np.zeros(length, bool)
    clipped = clipped | (np.abs(scaled) > 1.0 + 1e-6).any(axis=1)
    scenario = int(infos["scenario"][0]) if "scenario" in infos else -1
    return StoredEpisode(
        observation, np.clip(scaled, -1.0, 1.0), reward, bool(terminations[-1]), clipped, scenario
    )
