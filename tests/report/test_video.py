"""Videos: contents of frames, names of files, and speed."""

from __future__ import annotations

import time

import numpy as np
import pytest

from drivax.cli import main
from drivax.errors import UsageError
from drivax.report.episodes import logged_motion
from drivax.report.pictures.drawing import Rollout
from drivax.report.pictures.palette import LEGEND, THEMES

from .conftest import make_scenario, offset_path

av = pytest.importorskip("av")
pytest.importorskip("matplotlib")


def close(image, name, theme="light", near=2):
    """Where an image has a colour of the palette."""
    wanted = [int(THEMES[theme][name][at : at + 2], 16) for at in (1, 3, 5)]
    return np.abs(image[..., :3].astype(int) - wanted).max(axis=-1) <= near


def drive(scenario, sideways=3.0, **events):
    return Rollout("policy", offset_path(scenario, sideways).astype(np.float64), 10, events, "collision")


def scene(theme="light"):
    from drivax.report.pictures.video import Canvas, Scenery

    scenario = make_scenario(0)
    return scenario, Scenery(Canvas(720, 720, theme), scenario, [drive(scenario)])


@pytest.mark.parametrize("theme", THEMES)
def test_frame_shows_only_present_things(theme):
    from drivax.report.pictures.video import draw_frame

    scenario, scenery = scene(theme)
    early = draw_frame(scenery, drive(scenario), 19, 0.1)
    late = draw_frame(scenery, drive(scenario), 55, 0.1)
    assert early.shape == (720, 720, 4) and early.dtype == np.uint8
    for name in ("ego", "vehicle", "cyclist", "parked", "edge", "lane", "crosswalk", "ground", "ink"):
        assert close(early, name, theme, near=8).sum() > 30, name
    assert close(early, "red", theme).sum() > 30 and close(early, "green", theme).sum() == 0
    assert close(late, "green", theme).sum() > 30, "the light has changed"
    assert close(late, "pedestrian", theme).sum() > 20 > close(early, "pedestrian", theme).sum()


def test_camera_follows_ego():
    """Metres and pixels: the picture is 690 / 70 pixels per metre, ego is in the middle below the bar."""
    from drivax.report.pictures.video import draw_frame

    scenario, scenery = scene()
    image = draw_frame(scenery, drive(scenario, 20.0), 60, 0.1)
    rows, columns = np.nonzero(close(image, "ego"))
    near = (np.abs(columns - 360) < 30) & (np.abs(rows - 375) < 30)
    box = 4.6 * 1.9 * (690 / 70) ** 2
    assert 0.5 * box < near.sum() < 1.1 * box, "a box of ego's size, less its outline and arrow"
    assert abs(columns[near].mean() - 360) < 4 and abs(rows[near].mean() - 375) < 4


def test_failures_are_marked_from_their_step_on():
    from drivax.report.pictures.video import draw_frame

    scenario, scenery = scene()
    failed = drive(scenario, collision=40, offroad=-1)
    before, after = (draw_frame(scenery, failed, step, 0.1)[40:] for step in (39, 40))
    assert close(after, "mark").sum() > close(before, "mark").sum() + 100
    ended = drive(scenario, collision=40)
    ended.ego[41:] = np.nan
    gone = draw_frame(scenery, ended, 80, 0.1)
    assert close(gone[340:410, 340:380], "mark").sum() > 50, "the camera stays where it was last"
    never = Rollout("policy", np.full((91, 4), np.nan), 10, {}, "unjudged")
    assert draw_frame(scenery, never, 20, 0.1).shape == (720, 720, 4)


def test_legend_has_every_colour():
    from drivax.report.pictures.video import legend_strip

    for theme in THEMES:
        strip = legend_strip(720, theme)
        assert strip.shape[1] == 720 and strip.shape[0] % 2 == 0
        for name in {name for name, _ in LEGEND} - {"mark", "goal", "route"}:
            assert close(strip, name, theme).sum() > 20, name


def decoded(path):
    with av.open(path) as container:
        stream = container.streams.video[0]
        return [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)], stream.average_rate


def test_video_starts_at_the_takeover(runs, tmp_path, capsys):
    out = tmp_path / "videos"
    assert main(["report", *map(str, runs), "--video", "worst:1", "--out", str(out)]) == 0
    assert "1 videos" in capsys.readouterr().out
    assert [path.name for path in out.iterdir()] == ["1-hand-01.mp4"]
    images, rate = decoded(out / "1-hand-01.mp4")
    assert rate == 10 and len(images) == 81 and images[0].shape[1] == 720, "from where the planner took over"
    assert close(images[40], "ego", near=40).sum() > 300


@pytest.mark.slow
def test_side_by_side_video_has_a_pane_per_planner(runs, tmp_path):
    out = tmp_path / "videos"
    assert (
        main(["report", *map(str, runs), "--side-by-side", "hand-03", "--theme", "dark", "--out", str(out)])
        == 0
    )
    images, _ = decoded(out / "hand-03.mp4")
    assert images[0].shape[1] == 3 * 480
    panes = np.split(images[60][:480], 3, axis=1)
    assert all(close(pane, "ground", "dark", near=12).sum() > 20_000 for pane in panes)
    assert not np.array_equal(panes[0][:30], panes[2][:30]), "each has a name of its own"


def test_at_most_three_panes_in_a_row():
    from drivax.report.pictures.video import frames

    scenario = make_scenario(0)
    drives = [Rollout(f"planner {i}", logged_motion(scenario), 10, {}, "success") for i in range(5)]
    pictures = [next(frames(scenario, drives[:count])) for count in (1, 2, 4, 5)]
    sizes = [picture.shape for picture in pictures]
    assert [size[1] for size in sizes] == [720, 960, 960, 1440], "at most three side by side"
    assert 480 < sizes[1][0] < 600 and 960 < sizes[2][0] < 1100 and all(size[0] % 2 == 0 for size in sizes)
    assert close(pictures[-1][480:960, 960:], "ground").all(), "the place of a sixth planner is empty"


def test_file_names_have_rank_and_scenario(tmp_path):
    from drivax.report.episodes import EpisodeGroup
    from drivax.report.pictures.video import _files

    chosen = [EpisodeGroup("d", f"a/b {i}", (i,), "success") for i in range(12)]
    assert [file.name for file in _files(tmp_path, chosen, ranked=True)][::11] == [
        "01-a_b_0.mp4",
        "12-a_b_11.mp4",
    ]
    assert [file.name for file in _files(tmp_path, chosen[:1], ranked=False)] == ["a_b_0.mp4"]


def test_wrong_selections_and_existing_files_are_refused(runs, tmp_path, capsys):
    from drivax.report.pictures.video import encode, write_videos

    out = tmp_path / "videos"
    for which, words in (
        ("worst:0", "worst:N"),
        ("worst:x", "worst:N"),
        ("", "write worst:N, all, or an id"),
        ("hand-1", "did you mean 'hand-01'?"),
    ):
        assert main(["report", *map(str, runs), "--video", which, "--out", str(out)]) == 2
        assert words in capsys.readouterr().err
    with pytest.raises(UsageError, match="no run folder is an evaluation"):
        write_videos(runs[3:], out, "all")
    out.mkdir()
    (out / "hand-03.mp4").write_bytes(b"mine")
    with pytest.raises(UsageError, match="--overwrite"):
        write_videos(runs[:3], out, "hand-03")

    def breaks():
        yield np.zeros((64, 64, 4), np.uint8)
        raise RuntimeError("half way")

    with pytest.raises(RuntimeError, match="half way"):
        encode(out / "hand-03.mp4", breaks(), 0.1)
    assert [path.name for path in out.iterdir()] == ["hand-03.mp4"] and (
        out / "hand-03.mp4"
    ).read_bytes() == b"mine"


@pytest.mark.slow
def test_episode_is_drawn_faster_than_real_time(tmp_path):
    from drivax.report.pictures.video import encode, frames

    scenario = make_scenario(0)
    drives = [Rollout("log", logged_motion(scenario), 10, {}, "success"), drive(scenario)]
    encode(tmp_path / "warm.mp4", frames(scenario, drives[:1]), 0.1)
    for planners in (drives[:1], drives):
        begin = time.perf_counter()
        encode(tmp_path / "film.mp4", frames(scenario, planners), 0.1)
        assert time.perf_counter() - begin < 8.1
