"""Checkpoints are restored bit for bit, superseded ones are deleted, and errors name what does not match."""

from __future__ import annotations

import errno
import json
import os
import resource
import shutil
import subprocess
import sys
import zlib
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tensorstore

from drivax import reading
from drivax.errors import DataError
from drivax.tracking.checkpoints import Checkpoints, is_part, pack, unpack


class State(NamedTuple):
    key: Any
    keys: Any
    params: Any
    step: int
    lr: float
    done: bool
    host: Any
    nothing: Any
    empty: Any


def make_state(seed: int) -> State:
    key = jax.random.key(seed)
    params = {
        "w": jax.random.normal(key, (7, 3)),
        "half": jax.random.normal(key, (5,), jnp.bfloat16),
        "count": jnp.int32(seed),
        "mask": jnp.array([True, False]),
        "bytes": jnp.arange(4, dtype=jnp.uint8),
        "odd": jnp.array([jnp.nan, -0.0, jnp.inf, 1e-45], jnp.float32),
    }
    return State(
        key=key,
        keys=jax.random.split(jax.random.key(seed, impl="rbg"), 3),
        params=params,
        step=2**40 + seed,
        lr=0.1 + seed,
        done=bool(seed % 2),
        host=np.array([2**40 + seed, -1], np.int64),
        nothing=None,
        empty=jnp.zeros((0, 3)),
    )


def bits(state: State) -> list[Any]:
    leaves = []
    for leaf in jax.tree_util.tree_leaves(state):
        if isinstance(leaf, jax.Array) and jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
            leaves.append((str(leaf.dtype), np.asarray(jax.random.key_data(leaf)).tobytes()))
        else:
            leaves.append((type(leaf), np.asarray(leaf).dtype, np.shape(leaf), np.asarray(leaf).tobytes()))
    return leaves


def test_states_are_restored_bit_for_bit(tmp_path: Path):
    checkpoints = Checkpoints(tmp_path / "checkpoints")
    state = make_state(1)
    path = checkpoints.save(100, state)
    again = checkpoints.restore(make_state(0))
    assert bits(again) == bits(state)
    assert jax.random.uniform(again.key) == jax.random.uniform(state.key)
    assert jax.random.bits(again.keys[2]) == jax.random.bits(state.keys[2])
    assert isinstance(again.host, np.ndarray)
    assert path.name == "step-000000100"
    assert [item.name for item in (tmp_path / "checkpoints").iterdir()] == [path.name]


def test_parts_are_restored_by_their_paths(tmp_path: Path):
    checkpoints = Checkpoints(tmp_path)
    state = {"critic": jnp.arange(3.0), "critics": jnp.zeros(2), "policy": {"w": jnp.ones(2)}}
    checkpoints.save(5, state)
    result = checkpoints.restore_parts(
        {"['policy']": {"w": jnp.zeros(2)}, "['critic']": jax.ShapeDtypeStruct((3,), jnp.float32)}
    )
    np.testing.assert_array_equal(result["['critic']"], [0, 1, 2])
    np.testing.assert_array_equal(result["['policy']"]["w"], [1, 1])
    named = [".critic['w']", ".critics", ".critic"]
    assert [is_part(leaf, [".critic"]) for leaf in named] == [True, False, True]
    with pytest.raises(DataError, match=r"no \['policy'\]\['v'\]; begin elsewhere"):
        checkpoints.restore_parts({"['policy']": {"v": jnp.zeros(2)}}, cure="begin elsewhere")


def test_shapes_suffice_as_template(tmp_path: Path):
    """Like a new process, which computes nothing for the template."""
    checkpoints = Checkpoints(tmp_path)

    def initial(seed: int) -> dict[str, Any]:
        key = jax.random.key(seed)
        return {"key": key, "w": jax.random.normal(key, (4,)), "n": jnp.int32(3)}

    state = initial(5)
    checkpoints.save(1, state)
    again = checkpoints.restore(jax.eval_shape(lambda: initial(5)))
    np.testing.assert_array_equal(again["w"], state["w"])
    assert jax.random.uniform(again["key"]) == jax.random.uniform(state["key"])


def test_newest_and_best_checkpoints_are_kept(tmp_path: Path):
    checkpoints = Checkpoints(tmp_path, keep=2)
    for step, score in ((10, 0.1), (20, 0.9), (30, None), (40, float("nan")), (50, 0.3)):
        checkpoints.save(step, {"step": step}, score)
    assert checkpoints.steps() == [20, 40, 50]
    assert checkpoints.best() == 20
    assert checkpoints.restore({"step": 0}) == {"step": 50}
    assert checkpoints.restore({"step": 0}, checkpoints.best()) == {"step": 20}
    assert checkpoints.about(40)["score"] is None
    checkpoints.save(60, {"step": 60}, 0.9)
    assert checkpoints.best() == 60  # of equals the later one
    assert checkpoints.steps() == [50, 60]


def test_without_scores_only_the_newest_are_kept(tmp_path: Path):
    checkpoints = Checkpoints(tmp_path, keep=1)
    for step in (1, 2, 3):
        checkpoints.save(step, {"step": step})
    assert checkpoints.steps() == [3]
    assert checkpoints.best() is None


def test_saving_a_step_again_replaces_it(tmp_path: Path):
    checkpoints = Checkpoints(tmp_path)
    checkpoints.save(1, {"a": 1})
    checkpoints.save(1, {"a": 2})
    assert checkpoints.restore({"a": 0}) == {"a": 2}


def test_a_failed_save_leaves_nothing_and_harms_nothing(tmp_path: Path):
    checkpoints = Checkpoints(tmp_path)
    checkpoints.save(1, {"a": 1})
    with pytest.raises(TypeError, match="str"):
        checkpoints.save(2, {"a": "text"})
    assert checkpoints.steps() == [1]
    assert len(list(tmp_path.iterdir())) == 1


def test_a_full_disk_reports_the_size_of_the_checkpoint(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    def full(path: Path, arrays: Any) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("drivax.tracking.checkpoints._save_arrays", full)
    message = r"step-000000003: no space left on device \(.+ free, of about 4\d{2} kB needed\)"
    with pytest.raises(DataError, match=message):
        Checkpoints(tmp_path).save(3, {"weights": np.zeros((100, 1000), np.float32)})
    assert list(tmp_path.iterdir()) == []


def test_files_of_a_killed_process_are_no_checkpoints(tmp_path: Path):
    (tmp_path / ".step-5.partial-123").mkdir()
    for name in ("step-x", "step-1", "step-0000000001"):  # The last are not names of step 1.
        (tmp_path / name).mkdir()
    checkpoints = Checkpoints(tmp_path)
    assert checkpoints.steps() == []
    with pytest.raises(DataError, match="no checkpoint found; start the training again, with --overwrite"):
        checkpoints.restore({"a": 0})


@pytest.mark.parametrize(
    ("template", "message"),
    [
        ({"w": jnp.zeros(3), "b": 0}, r"has no \['b'\]"),
        ({}, r"contains \['w'\], which the template lacks"),
        ({"w": jnp.zeros(4)}, r"\['w'\] is float32\[3\] in the checkpoint, not float32\[4\]"),
        ({"w": jnp.zeros(3, jnp.int32)}, r"\['w'\] is float32\[3\] in the checkpoint, not int32\[3\]"),
        ({"w": jax.random.split(jax.random.key(0), 3)}, r"not key<fry>\[3\]"),
    ],
)
def test_template_that_does_not_fit_is_refused(tmp_path: Path, template: dict[str, Any], message: str):
    checkpoints = Checkpoints(tmp_path)
    checkpoints.save(1, {"w": jnp.ones(3)})
    with pytest.raises(DataError, match=message):
        checkpoints.restore(template)


def test_unknown_step_is_refused(tmp_path: Path):
    checkpoints = Checkpoints(tmp_path)
    checkpoints.save(1, {"a": 1})
    with pytest.raises(DataError, match="no checkpoint of step 7; available steps: 1"):
        checkpoints.restore({"a": 0}, 7)


def write_former(path: Path, **changes: Any) -> dict[str, Any]:
    """Write ``about.json`` as version 0.1.0 did, without checksums of files."""
    about = json.loads((path / "about.json").read_text())
    about = {name: about[name] for name in ("step", "score", "leaves")} | changes
    (path / "about.json").write_text(json.dumps(about))
    return about


def test_checkpoints_without_checksums_of_files_are_read(tmp_path: Path):
    checkpoints, state = Checkpoints(tmp_path), make_state(2)
    path = checkpoints.save(1, state, 0.25)
    about = write_former(path)
    assert bits(checkpoints.restore(make_state(0))) == bits(state) and checkpoints.best() == 1
    about["leaves"][0]["crc"] ^= 1
    write_former(path, leaves=about["leaves"])
    with pytest.raises(DataError, match=r"checksum mismatch in \.key; use another checkpoint"):
        checkpoints.restore(state)
    (path / "arrays" / "_METADATA").write_text("{}")
    with pytest.raises(DataError, match="arrays cannot be read"):
        checkpoints.restore(state)


def test_damage_is_found_before_orbax_reads(tmp_path: Path, capfd: pytest.CaptureFixture[str]):
    """Flips, truncations and deletions of each file, twelve of each; Orbax would print tracebacks of its threads."""
    checkpoints, rng = Checkpoints(tmp_path), np.random.default_rng(5)
    state = {"w": rng.normal(size=(50, 40)).astype(np.float32), "n": np.int32(4)}
    path = checkpoints.save(1, state, 0.5)
    files = sorted(file for file in path.rglob("*") if file.is_file())
    for number in range(36):
        file = files[number % len(files)]
        whole = file.read_bytes()
        if number % 3 == 0:
            spoilt = bytearray(whole)
            spoilt[rng.integers(len(whole))] ^= 1 << int(rng.integers(8))
            file.write_bytes(spoilt)
        elif number % 3 == 1:
            file.write_bytes(whole[: rng.integers(len(whole))])
        else:
            file.unlink()
        with pytest.raises(DataError, match="use another checkpoint, or train again") as raised:
            checkpoints.restore(state)
        assert raised.value.file == file and "\n" not in str(raised.value)
        if file.name == "about.json":
            with pytest.raises(DataError, match=r"about\.json: (is|file not found)"):
                checkpoints.best()
        file.write_bytes(whole)
    restored = checkpoints.restore(state)
    assert all((restored[name] == state[name]).all() for name in state)
    assert capfd.readouterr().err == ""


def test_file_far_larger_than_the_arrays_is_refused_unread(tmp_path: Path):
    checkpoints = Checkpoints(tmp_path)
    path = checkpoints.save(1, {"a": np.zeros(3)})
    file = max((path / "arrays").rglob("*"), key=lambda file: file.stat().st_size * file.is_file())
    os.truncate(file, 1 << 40)
    with pytest.raises(DataError, match=r"has 1.1 TB, more than the 17 MB that are read; use another"):
        checkpoints.restore({"a": np.zeros(3)})


def test_edited_score_is_found(tmp_path: Path):
    checkpoints = Checkpoints(tmp_path)
    about = checkpoints.save(1, {"a": 1}, 0.25) / "about.json"
    about.write_text(about.read_text().replace('"score": 0.25', '"score": 0.95'))
    with pytest.raises(DataError, match=r"about\.json: is damaged .*checksum mismatch"):
        checkpoints.best()


def edit(path: Path, **changes: Any) -> None:
    """Change entries of ``about.json``, with a checksum that is right, as a stranger can."""
    about = json.loads((path / "about.json").read_text()) | changes
    del about["crc"]
    about["crc"] = zlib.crc32(json.dumps(about, sort_keys=True).encode())
    (path / "about.json").write_text(json.dumps(about))


LEAF = {"name": "['a']", "type": "float32", "shape": [3], "crc": 0}


@pytest.mark.parametrize(
    "changes",
    [
        {"score": "abc"},
        {"score": {"a": 1}},
        {"score": [0.5, None]},
        {"files": ["a"]},
        {"files": {"/dev/null": 0}},
        {"files": {"../../outside": zlib.crc32(b"secret")}},
        {"files": {"arrays/device": 0}},
        {"leaves": 5},
        {"leaves": [{"name": "['a']"}]},
        {"leaves": [LEAF | {"shape": 5}]},
        {"leaves": [LEAF | {"name": 5}]},
    ],
)
def test_checkpoint_of_a_stranger_is_refused_in_one_line(tmp_path: Path, changes: dict[str, Any]):
    (tmp_path / "outside").write_bytes(b"secret")
    checkpoints, state = Checkpoints(tmp_path / "checkpoints"), {"a": np.ones(3, np.float32)}
    path = checkpoints.save(1, state, 0.5)
    os.mkfifo(path / "arrays" / "device")
    edit(path, **changes)
    with pytest.raises(DataError, match="use another checkpoint, or train again") as raised:
        checkpoints.restore(state)
    assert str(raised.value).startswith(f"{path}/") and "\n" not in str(raised.value)
    if "files" not in changes or isinstance(changes["files"], list):
        with pytest.raises(DataError, match=r"about\.json: is damaged"):
            checkpoints.best()


def test_links_in_a_checkpoint_are_refused(tmp_path: Path):
    checkpoints, state = Checkpoints(tmp_path / "checkpoints"), {"a": np.ones(3, np.float32)}
    path = checkpoints.save(1, state)
    for name in ("arrays", "arrays/manifest.ocdbt", "about.json"):
        (path / name).rename(tmp_path / "moved")
        (path / name).symlink_to(tmp_path / "moved")
        with pytest.raises(DataError, match=f"{name}: is a symbolic link; replace the link"):
            checkpoints.restore(state)
        (path / name).unlink()
        (tmp_path / "moved").rename(path / name)
    assert (checkpoints.restore(state)["a"] == state["a"]).all()


def test_state_larger_than_the_memory_is_refused(tmp_path: Path):
    state = jax.ShapeDtypeStruct((1 << 40,), np.float32)
    checkpoints, problem = (
        Checkpoints(tmp_path / "checkpoints"),
        r"states 4\.4 TB of arrays, more than the .* of memory",
    )
    path = checkpoints.save(1, {"a": np.ones(3, np.float32)})
    edit(path, leaves=[{**checkpoints.about(1)["leaves"][0], "shape": [1 << 40]}])
    with pytest.raises(DataError, match=f"step-000000001: {problem}; use another checkpoint"):
        checkpoints.restore({"a": state})
    (tmp_path / "policy.npz").touch()
    os.truncate(tmp_path / "policy.npz", 1 << 42)
    with pytest.raises(DataError, match=rf"policy\.npz: {problem}"):
        unpack(tmp_path / "policy.npz", {"a": state})


def test_state_larger_than_the_limit_of_the_process_is_refused(tmp_path: Path, monkeypatch):
    file, state = tmp_path / "policy.npz", {"a": np.ones(300, np.float32)}
    pack(file, state)
    monkeypatch.setattr(resource, "getrlimit", lambda kind: (1000, resource.RLIM_INFINITY))
    with pytest.raises(DataError, match=r"states .* of arrays, more than the .* of memory"):
        unpack(file, state)


def test_chunks_larger_than_their_array_are_refused(tmp_path: Path):
    """A chunk of equal values unpacks from few bytes to any size."""
    checkpoints, state = Checkpoints(tmp_path), {"a": np.ones(3, np.float32)}
    path = checkpoints.save(1, state)
    arrays = path / "arrays"
    shutil.rmtree(arrays / "d")
    shutil.rmtree(arrays / "ocdbt.process_0")
    (arrays / "manifest.ocdbt").unlink()
    store = {"driver": "ocdbt", "base": f"file://{arrays}/", "path": "00000/"}
    metadata = {"shape": [3], "chunks": [1 << 36], "dtype": "<f4"}
    tensorstore.open({"driver": "zarr", "kvstore": store, "metadata": metadata}, create=True).result()
    edit(path, files={})
    with pytest.raises(DataError, match=r"arrays cannot be read \(array 00000 has 3 values, but chunks of"):
        checkpoints.restore(state)


def test_large_about_is_not_read(tmp_path: Path):
    path = Checkpoints(tmp_path).save(1, {"a": 1})
    os.truncate(path / "about.json", 1 << 40)
    with pytest.raises(DataError, match=r"about\.json: has 1\.1 TB, more than"):
        Checkpoints(tmp_path).restore({"a": 0})


def test_array_of_another_shape_than_its_leaf_is_not_read(tmp_path: Path):
    path, small = Checkpoints(tmp_path).save(1, {"a": np.zeros((1000, 1000))}), {"a": np.zeros(2)}
    leaf = json.loads((path / "about.json").read_text())["leaves"][0]
    leaf |= {"shape": [2], "stored": ["float64", [2]], "crc": zlib.crc32(bytes(16))}
    edit(path, leaves=[leaf])
    with pytest.raises(DataError, match=r"array 00000 has shape \(1000, 1000\), not \(2,\)"):
        Checkpoints(tmp_path).restore(small)


def test_only_leaves_of_the_template_are_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """A replay buffer may be larger than the memory of the machine that evaluates the policy."""
    Checkpoints(tmp_path).save(1, {"policy": np.ones(2), "replay": np.zeros((50, 50))})
    sizes, crc = [], zlib.crc32
    monkeypatch.setattr("zlib.crc32", lambda data, *value: sizes.append(len(data)) or crc(data, *value))
    part = Checkpoints(tmp_path).restore(np.zeros(2), part="['policy']")
    np.testing.assert_array_equal(part, np.ones(2))
    assert 16 in sizes and 20000 not in sizes


def test_files_are_on_disk_before_the_checkpoint_has_its_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    synced, checked = set(), []
    fsync = os.fsync

    def note_sync(handle: int) -> None:
        synced.add(os.fstat(handle).st_ino)
        fsync(handle)

    def check(rename: Any) -> Any:
        def checked_rename(source: Any, target: Any, **options: Any) -> None:
            if Path(target).name == "step-000000001":
                paths = [*Path(source).rglob("*"), Path(source)]
                checked.append([path for path in paths if path.stat().st_ino not in synced])
            rename(source, target, **options)

        return checked_rename

    monkeypatch.setattr(os, "fsync", note_sync)
    for name in ("rename", "replace"):
        monkeypatch.setattr(os, name, check(getattr(os, name)))
    path = Checkpoints(tmp_path / "checkpoints").save(1, {"w": np.ones(1000)})
    assert checked == [[]] and {tmp_path.stat().st_ino, path.parent.stat().st_ino} <= synced


def test_scores_of_several_numbers_compare_by_the_first_that_differs(tmp_path: Path):
    checkpoints = Checkpoints(tmp_path, keep=4)
    for step, score in ((1, (0.5, 0.9)), (2, (0.75, 0.1)), (3, (0.75, 0.05)), (4, (float("nan"), 1.0))):
        checkpoints.save(step, {"step": step}, score)
    assert checkpoints.best() == 2 and checkpoints.about(4)["score"] is None


def test_folder_of_another_step_is_refused(tmp_path: Path):
    checkpoints = Checkpoints(tmp_path)
    checkpoints.save(1, {"a": 1}).rename(tmp_path / "step-000000009")
    with pytest.raises(DataError, match=r"about\.json: is damaged .*of step 1"):
        checkpoints.restore({"a": 0})


def test_later_checkpoints_are_dropped(tmp_path: Path):
    checkpoints = Checkpoints(tmp_path, keep=3)
    for step in (10, 20, 30):
        checkpoints.save(step, {"step": step})
    checkpoints.drop_after(20)
    assert checkpoints.steps() == [10, 20] and len(list(tmp_path.iterdir())) == 2


def test_packed_tree_round_trips_and_is_plain_numpy(tmp_path: Path):
    tree = {"w": jnp.arange(6.0).reshape(2, 3), "deep": {"b": jnp.int32(3)}, "none": None}
    file = tmp_path / "tree.npz"
    pack(file, tree)
    assert [path.name for path in tmp_path.iterdir()] == ["tree.npz"]
    with np.load(file, allow_pickle=False) as stored:
        assert sorted(stored.files) == ["['deep']['b']", "['w']"]
        np.testing.assert_array_equal(stored["['w']"], [[0, 1, 2], [3, 4, 5]])
    back = unpack(file, jax.eval_shape(lambda: tree))
    assert jax.tree.structure(back) == jax.tree.structure(tree)
    for one, other in zip(jax.tree.leaves(back), jax.tree.leaves(tree), strict=True):
        assert one.dtype == other.dtype and (one == other).all()


@pytest.mark.parametrize(
    ("template", "words"),
    [
        ({"w": jnp.zeros(3)}, r"\['w'\] is float32\[2\] in the checkpoint, not float32\[3\]"),
        ({"w": jnp.zeros(2, jnp.int32)}, r"not int32\[2\]"),
        ({"w": jnp.zeros(2), "v": jnp.zeros(1)}, r"has no \['v'\]"),
        ({}, r"contains \['w'\], which the template lacks"),
    ],
)
def test_a_packed_tree_that_does_not_fit_is_reported_by_leaf(tmp_path: Path, template: Any, words: str):
    pack(tmp_path / "tree.npz", {"w": jnp.zeros(2)})
    with pytest.raises(DataError, match=words):
        unpack(tmp_path / "tree.npz", template)


@pytest.mark.parametrize("arrays", [{"['v']": np.zeros(2, np.float32)}, {"['w']": np.zeros(3, np.float32)}])
def test_unknown_arrays_are_refused_before_any_is_unpacked(tmp_path: Path, monkeypatch: Any, arrays: Any):
    np.savez_compressed(tmp_path / "tree.npz", **({"['w']": np.zeros(2, np.float32)} | arrays))
    monkeypatch.setattr(reading, "_unpack", lambda *_: pytest.fail("unpacked"))
    with pytest.raises(
        DataError, match=r"contains \['v'\], which the template lacks|\['w'\] is float32\[3\]"
    ):
        unpack(tmp_path / "tree.npz", {"w": jnp.zeros(2)})


def test_packed_tree_takes_no_more_than_its_template(tmp_path: Path):
    """Headers and names of an archive have little room next to the arrays."""
    np.savez_compressed(tmp_path / "tree.npz", **{"['w']": np.zeros(1_900_000, np.float32)})
    with pytest.raises(DataError, match=r"unpacks to 7.6 MB, more than the 4.0 MB expected"):
        unpack(tmp_path / "tree.npz", {"w": jnp.zeros(1_000_000)})


def test_a_damaged_packed_tree_is_reported(tmp_path: Path):
    file = tmp_path / "tree.npz"
    pack(file, {"w": jnp.arange(100.0)})
    whole = bytearray(file.read_bytes())
    with pytest.raises(DataError, match=r"or damaged|not found"):
        unpack(tmp_path / "none.npz", {})
    for damage in (slice(300, 304), slice(len(whole) // 2, None)):
        spoilt = whole.copy()
        spoilt[damage] = b"" if damage.stop is None else bytes(255 - byte for byte in whole[damage])
        file.write_bytes(spoilt)
        with pytest.raises(DataError, match=r"or damaged|not found"):
            unpack(file, {"w": jnp.zeros(100)})


def test_links_in_place_of_checkpoints_are_no_checkpoints(tmp_path: Path):
    """A stranger's run leads elsewhere with them: nothing there is read, deleted or written."""
    elsewhere = Checkpoints(tmp_path / "elsewhere")
    path = elsewhere.save(2, {"a": 2})
    checkpoints = Checkpoints(tmp_path / "run")
    checkpoints.save(1, {"a": 1})
    for name in (path.name, "step-000000003"):
        (checkpoints.folder / name).symlink_to(path)
    (checkpoints.folder / ".step-1.old-1").symlink_to(path)
    os.mkfifo(checkpoints.folder / ".step-000000004.partial")
    assert checkpoints.steps() == [1]
    checkpoints.drop_after(1)
    assert [entry.name for entry in checkpoints.folder.iterdir()] == ["step-000000001"]
    checkpoints.save(2, {"a": 5})
    assert elsewhere.restore({"a": 0}) == {"a": 2} and checkpoints.restore({"a": 0}) == {"a": 5}


FAILING_WRITE = """
import logging, resource, sys
from pathlib import Path
import numpy as np
from drivax.tracking import checkpoints

path, arrays = Path(sys.argv[1]), {str(number): np.zeros(1000) for number in range(40)}
checkpoints._save_arrays(path / "whole", arrays)
filters = [logging.getLogger(name).filters for name in ("absl", "asyncio")]
print(filters, sys.unraisablehook is sys.__unraisablehook__)
resource.setrlimit(resource.RLIMIT_FSIZE, (0, 0))
try:
    checkpoints._save_arrays(path / "failed", arrays)
except Exception as error:
    print(type(error).__name__)
late = (
    ("absl", "site-packages/orbax/writer.py", "failed"),
    ("asyncio", "asyncio/base_events.py", "Task exception was never retrieved: <Task at orbax/handlers.py:1>"),
    ("absl", "user.py", "failed"),
    ("asyncio", "asyncio/base_events.py", "Task exception was never retrieved: <Task at user.py:2>"),
)
for name, file, message in late:
    logger = logging.getLogger(name)
    print(bool(logger.filter(logger.makeRecord(name, logging.ERROR, file, 1, message, (), None))))
"""


def test_failing_write_prints_no_tracebacks(tmp_path: Path):
    """No file may grow: all arrays fail, as on a full disk."""
    command = [sys.executable, "-c", FAILING_WRITE, str(tmp_path)]
    result = subprocess.run(command, capture_output=True, text=True)
    lines = ["[[], []] True", "ValueError", "False", "False", "True", "True"]
    assert result.stdout.splitlines() == lines and result.stderr == ""
