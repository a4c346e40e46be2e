"""Tests of reports in a real browser."""

from __future__ import annotations

import math
import re
import shutil
import subprocess
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

import mcaprl
from mcaprl.api.evaluate import learning_curves
from mcaprl.online.curves import CurvePoint, write_curve
from mcaprl.page import COLORS, Card, Figure, Section, Table, new_figure, to_svg, write_page
from mcaprl.recorder.dataset.lint import lint
from mcaprl.recorder.record.wrapper import RecordMcap
from mcaprl.recorder.viewer.report import dataset_page, tracks_of
from mcaprl.sims import make_sim
from mcaprl.sims.evaluation.evaluate import PolicyScore
from mcaprl.sims.evaluation.report import comparison_figure, comparison_notes, evaluation_page
from mcaprl.sims.evaluation.rollout import EpisodeResult
from tests.conftest import need

BROWSER = shutil.which("chromium") or shutil.which("google-chrome")
# Writes the width and the colors of a page, and of its SVG texts, into the title of the document.
PROBE = """<script>
addEventListener("load", () => {
  const style = getComputedStyle(document.body), text = document.querySelector("svg text");
  document.title = [document.documentElement.scrollWidth, innerWidth, style.color,
    style.backgroundColor, text ? getComputedStyle(text).fill : ""].join("|");
});
</script>"""


def browse(page: Path, *flags: str, query: str = "") -> tuple[str, str]:
    """Return the document after loading in a browser, and the browser's console output."""
    need(BROWSER is not None, "Chromium is not installed (Debian: apt-get install chromium)")
    done = subprocess.run(
        [
            str(BROWSER),
            "--headless",
            "--no-sandbox",
            "--disable-gpu",
            "--enable-logging=stderr",
            f"--user-data-dir={page.parent / 'profile'}",
            "--virtual-time-budget=2000",
            *flags,
            "--dump-dom",
            page.as_uri() + query,
        ],
        capture_output=True,
        text=True,
        timeout=120,
        check=True,
    )
    return done.stdout, "\n".join(re.findall(r".*CONSOLE.*", done.stderr))


def colors_at(page: Path, folder: Path, width: int, *, dark: bool) -> tuple[str, str]:
    """Check that a page fits a width and a color scheme; return its text and SVG colors."""
    probed = page.with_name(f"{page.stem}-{width}-{dark}.html")
    probed.write_text(page.read_text() + PROBE)
    # Chromium's windows are at least 500 pixels wide, but an iframe can be narrower.
    outer = folder / "outer.html"
    outer.write_text(
        f'<iframe id="f" src="{probed.as_uri()}" width="{width}" height="900"></iframe><script>'
        "f.onload = () => setTimeout(() => { document.title = f.contentDocument.title }, 100)"
        "</script>"
    )
    flags = ["--blink-settings=preferredColorScheme=0"] if dark else []
    document, console = browse(outer, "--allow-file-access-from-files", *flags)
    probed.unlink()
    assert console == ""
    found = re.search(r"<title>(.*?)</title>", document)
    assert found is not None, document[:500]
    needed, offered, ink, back, svg_ink = found[1].split("|")
    assert int(needed) <= int(offered) == width
    brightness = [sum(map(int, re.findall(r"\d+", color)[:3])) / 3 for color in (ink, back)]
    assert brightness[0] - brightness[1] > 150 if dark else brightness[1] - brightness[0] > 150
    return ink, svg_ink


@pytest.fixture(scope="module")
def lane_page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write the report of a short lane log."""
    folder = tmp_path_factory.mktemp("page")
    recorder = RecordMcap(make_sim("lane"), folder / "lane.mcap")
    for seed in range(4):
        recorder.reset(seed=seed)
        for step in range(20):
            if recorder.step(1 + step % 2)[2]:
                break
    recorder.close()
    data = mcaprl.open(folder / "lane.mcap")
    page = folder / "index.html"
    dataset_page(page, data, "lane.mcap", [("steps", str(len(data)))], lint(data))
    return page


def test_a_browser_reports_no_error(lane_page: Path) -> None:
    document, console = browse(lane_page)
    assert console == ""
    assert "Positions in meters" in document
    assert document.count("mcaprl replay") == 4
    assert not re.search(r"(src|href)=.(https?:)?//|@import", document), "it needs no network"


@pytest.mark.parametrize(("width", "dark"), [(1200, False), (390, False), (390, True)])
def test_the_page_fits_phones_and_color_schemes(
    lane_page: Path, tmp_path: Path, width: int, dark: bool
) -> None:
    ink, svg_ink = colors_at(lane_page, tmp_path, width, dark=dark)
    assert svg_ink == ink, "what is drawn has the color of what is written"


def test_the_replay_command_names_the_episodes_file(tmp_path: Path) -> None:
    for name, count in (("a", 2), ("b", 2)):
        recorder = RecordMcap(gym.make("CartPole-v1"), tmp_path / f"{name}.mcap")
        for seed in range(count):
            recorder.reset(seed=seed)
            while not recorder.step(0)[2]:
                pass
        recorder.close()
    data = mcaprl.open(str(tmp_path))
    dataset_page(tmp_path / "all.html", data, "", [], [])
    page = (tmp_path / "all.html").read_text()
    found = re.findall(r"mcaprl replay \S+/(\w)\.mcap --episode (\d)", page)
    assert sorted(found) == [("a", "0"), ("a", "1"), ("b", "0"), ("b", "1")]
    assert [page.count(f"<strong>{kind}: ") for kind in ("best", "worst")] == [2, 2]
    # Of three episodes, the one in the middle is neither.
    three_of = data.filter(lambda episode: episode.index < 3)
    dataset_page(tmp_path / "three.html", three_of, "", [], [])
    three = (tmp_path / "three.html").read_text()
    assert [three.count(f"<strong>{kind}: ") for kind in ("best", "worst")] == [1, 1]
    # The episode numbers of a filtered dataset are unknown.
    some = data.filter(lambda episode: episode.index > 0)
    dataset_page(tmp_path / "some.html", some, "", [], [])
    assert "mcaprl replay" not in (tmp_path / "some.html").read_text()


def test_an_evaluation_shows_the_learning_curves(tmp_path: Path) -> None:
    for seed in range(2):
        (tmp_path / f"online/seed-{seed}").mkdir(parents=True)
        points = [
            CurvePoint(step, 2.0 * step + seed, math.nan, 0.0, 9.0, 5.0, 7.0, best=True)
            for step in (10, 20, 30)
        ]
        write_curve(tmp_path / f"online/seed-{seed}/curve.csv", points)
        (tmp_path / f"offline/seed-{seed}").mkdir(parents=True)
        rows = "update,learning_rate,loss,held_out_loss\n1,.1,3,4\n2,.1,2,3\n"
        (tmp_path / f"offline/seed-{seed}/metrics.csv").write_text(rows)
    curves = learning_curves(
        [str(tmp_path / name) for name in ("online", "online/seed-0", "offline", "nowhere.zip")]
    )
    assert [figure.caption for figure in curves] == [
        "Evaluations during training",
        "offline: loss",
        "offline: held out loss",
    ]
    assert "online: median and range of 2 seeds" in curves[0].svg
    assert "mean of 2 seeds" in curves[1].svg
    places = np.array([(0.0, 0.0), (3.0, 1.0)])
    episode = EpisodeResult(7, 3.5, 1, "success", places)
    score = PolicyScore("cql", ((episode,), (episode,)), 3.5, (3.5, 3.5), successes=("success",))
    evaluation_page(tmp_path / "page", "lane", [score], [], [], None, None, curves)
    document, console = browse(tmp_path / "page" / "index.html")
    assert console == ""
    assert document.index("Best and worst") < document.index("Learning curves")
    assert document.count("<svg") == 1 + 1 + 2 + 3, "comparison, ways, thumbnails, curves"


def test_the_colors_of_an_evaluation_figure_fit_both_color_schemes() -> None:
    scores = []
    for name, total in (("cql", 3.5), ("pilot", 9.0)):
        episodes = tuple(
            (EpisodeResult(seed, total + seed, 1, "crash", np.empty((0, 2))),) for seed in range(3)
        )
        scores.append(PolicyScore(name, episodes, total, (total, total + 2)))
    drawn = to_svg(comparison_figure(scores, "", (5.0, 4.0, 6.0)))
    of_page = {"currentColor", "var(--pale)", "var(--card)"}
    assert set(re.findall(r'(?:fill|stroke): ([^;"]+)', drawn)) == {"none", *COLORS[:2], *of_page}


def test_an_interval_is_drawn_within_the_returns() -> None:
    """Intervals of few returns can be far beyond all of them."""
    episodes = tuple((EpisodeResult(k, 3.0 + k, 1, "", np.empty((0, 2))),) for k in range(3))
    for interval, line, has_arrows in (((3.2, 3.9), [3.2, 3.9], False), ((-9, 20), [3, 5], True)):
        score = PolicyScore("cql", episodes, 3.5, interval)
        axes = comparison_figure([score], "", None, notes=comparison_notes([score])).axes[0]
        drawn = [each.get_xdata().tolist() for each in axes.lines if len(each.get_xdata()) == 2]
        assert line in drawn
        assert ("arrow" in axes.get_xlabel()) is has_arrows


def test_text_is_escaped(tmp_path: Path) -> None:
    evil = "<script>alert(1)</script>"
    figure, axes = new_figure((2, 1))
    axes.set_title(evil)
    section = Section(
        evil,
        evil,
        [Figure(evil, to_svg(figure))],
        Table([evil], [[evil]]),
        [Card(evil, evil, command=evil)],
    )
    write_page(tmp_path / "evil.html", evil, evil, [section])
    assert "<script" not in (tmp_path / "evil.html").read_text()


def test_numbers_are_right_aligned_and_short_texts_are_not_wrapped() -> None:
    rows = [["lane", "1.5", "3", "", "x" * 31], ["12", "-2 to 3.25", "x", "4.5 s", "1"]]
    assert Table("abcde", rows).kinds == ["short", "number", "short", "number", "text"]
    assert Table("a", [["7.5%"], ["100%"]]).kinds == ["number"]


def test_equal_figures_are_equal_bytes() -> None:
    drawn = []
    for _ in range(2):
        figure, axes = new_figure((2, 1))
        axes.plot([1, 2, 3])
        drawn.append(to_svg(figure))
    assert drawn[0] == drawn[1]


def test_tracks_are_the_positions_in_telemetry(tmp_path: Path) -> None:
    recorder = RecordMcap(make_sim("lane"), tmp_path / "lane.mcap")
    reported = []
    for seed in range(2):
        recorder.reset(seed=seed)
        reported.append([recorder.unwrapped.telemetry()])  # type: ignore[attr-defined]
        for _ in range(3):
            recorder.step(1)
            reported[-1].append(recorder.unwrapped.telemetry())  # type: ignore[attr-defined]
    recorder.close()
    tracks = tracks_of(mcaprl.open(tmp_path / "lane.mcap"))
    for track, places in zip(tracks, reported, strict=True):
        expected = [(place["x_m"], place["y_m"]) for place in places]
        # Telemetry is rounded to 16 significant bits.
        np.testing.assert_allclose(track, np.array(expected), rtol=2**-16)


def test_without_telemetry_there_are_no_tracks(tmp_path: Path) -> None:
    recorder = RecordMcap(gym.make("CartPole-v1"), tmp_path / "c.mcap")
    recorder.reset(seed=0)
    while not recorder.step(0)[2]:
        pass
    recorder.close()
    assert [track.shape for track in tracks_of(mcaprl.open(tmp_path / "c.mcap"))] == [(0, 2)]
