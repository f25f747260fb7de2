"""Statistics against SciPy, films that play, a page that stands alone."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET

import imageio_ffmpeg
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from report_synthetic import make_result, picture
from scipy.stats import binomtest

from wbm.report.config import EvaluationConfig
from wbm.report.films import choose_strips
from wbm.report.page import write_page
from wbm.report.plots import curves_figure, failure_figure, figure4, to_png, to_svg
from wbm.report.stats import overlap, percent, summarise, wilson
from wbm.report.video import film_frame, follow_camera, key_steps, look_at, write_mp4
from wbm.robot.proprio import quat_to_mat


@given(st.integers(0, 400), st.integers(1, 400))
def test_wilson_agrees_with_scipy(successes, trials):
    successes = min(successes, trials)
    reference = binomtest(successes, trials).proportion_ci(method="wilson")
    low, high = wilson(successes, trials)
    assert low == pytest.approx(reference.low, abs=1e-12) and high == pytest.approx(reference.high, abs=1e-12)
    assert low <= successes / trials <= high


def test_wilson_at_the_ends():
    assert wilson(0, 0) == (0.0, 1.0)
    assert wilson(0, 10)[0] == 0.0 and wilson(10, 10)[1] == 1.0
    with pytest.raises(ValueError):
        wilson(3, 2)


def test_summary_counts_by_hand():
    base = {"object": "mug", "scene": "table", "reason": "", "time_to_grasp_s": None}
    records = [
        base | {"success": True, "time_to_grasp_s": 4.0, "target_visible": 1.0},
        base | {"success": True, "time_to_grasp_s": 6.0, "target_visible": 0.5, "scene": "bin"},
        base | {"success": False, "reason": "dropped", "collision": True, "time_to_grasp_s": 1.0},
        base | {"success": False, "reason": "timeout", "object": "box"},
        base | {"success": False, "reason": "dropped", "wrong_object": True},
    ]
    s = summarise(records)
    assert s["episodes"] == 5 and s["success_rate"] == 0.4
    assert s["collision_rate"] == 0.2 and s["wrong_object_rate"] == 0.2
    assert s["target_visible"] == 0.75 and s["time_to_grasp_s"] == 5.0
    assert s["failures"] == {"dropped": 2, "timeout": 1} and next(iter(s["failures"])) == "dropped"
    assert s["by_object"]["box"]["success_rate"] == 0.0 and s["by_object"]["mug"]["episodes"] == 4
    assert s["by_scene"]["bin"] == {
        "episodes": 1,
        "successes": 1,
        "success_rate": 1.0,
        "success_ci95": list(wilson(1, 1)),
    }
    assert summarise([])["time_to_grasp_s"] is None


def test_overlap():
    assert overlap((0.1, 0.3), (0.3, 0.5)) and not overlap((0.1, 0.29), (0.3, 0.5))


@pytest.mark.parametrize(
    "change", [{"split": "dev"}, {"episodes": 0}, {"video_width": 321}, {"videos": -1}, {"condition": "speech"}]
)
def test_bad_configuration_is_refused(change):
    with pytest.raises(ValueError, match=next(iter(change))):
        EvaluationConfig(**change)


def test_percent():
    shown = [percent(v).replace("\u00a0", " ") for v in (None, 0, 0.004, 0.65, 0.995, 1)]
    assert shown == ["–", "0 %", "0.4 %", "65 %", "99.5 %", "100 %"]


def test_svg_is_valid_deterministic_and_follows_the_theme(tmp_path):
    result = make_result(tmp_path, films=0)
    arms = result["figure4"][0]["arms"]
    svg = to_svg(figure4(arms), "Figure 4")
    assert svg == to_svg(figure4(arms), "Figure 4")
    ET.fromstring(svg)
    assert "var(--ink" in svg and "#010101" not in svg and "http" not in re.sub(r'xmlns(:\w+)?="[^"]*"', "", svg)
    for text in ("97", "79", "18", "Joint", "paper", "environment steps"):
        assert text in svg, text
    other = to_svg(failure_figure({"dropped": 3}, 10), "Failures")
    assert not set(re.findall(r'id="([^"]+)"', svg)) & set(re.findall(r'id="([^"]+)"', other))
    ET.fromstring(to_svg(curves_figure({"a": {"steps": [0, 1], "values": [[1, 2]]}}, "loss & more"), "loss & more"))
    to_png(figure4(arms), tmp_path / "figure4.png")
    assert (tmp_path / "figure4.png").read_bytes()[:4] == b"\x89PNG"


def test_film_round_trip(tmp_path):
    frames = [picture(160, 120, t / 20) for t in range(20)]
    assert write_mp4(tmp_path / "a.mp4", frames, 10) == 20
    reader = imageio_ffmpeg.read_frames(str(tmp_path / "a.mp4"))
    meta = next(reader)
    decoded = [np.frombuffer(f, np.uint8).reshape(120, 160, 3) for f in reader]
    assert meta["codec"] == "h264" and meta["size"] == (160, 120) and len(decoded) == 20
    assert np.abs(decoded[10].astype(int) - frames[10]).mean() < 6  # lossy, but the same picture
    data = (tmp_path / "a.mp4").read_bytes()
    assert data.index(b"moov") < data.index(b"mdat")  # plays before it is loaded whole
    write_mp4(tmp_path / "b.mp4", frames, 10)
    assert (tmp_path / "b.mp4").read_bytes() == data
    with pytest.raises(ValueError, match="no frames"):
        write_mp4(tmp_path / "c.mp4", [], 10)
    with pytest.raises(ValueError, match="even"):
        write_mp4(tmp_path / "c.mp4", [frames[0][:-1]], 10)


@given(st.tuples(*[st.floats(-3, 3)] * 6))
def test_cameras_look_at_their_target(values):
    eye, target = np.array(values[:3]), np.array(values[3:])
    if np.linalg.norm(target - eye) < 1e-3:
        return
    rot = quat_to_mat(np, look_at(eye, target))
    np.testing.assert_allclose(rot[:, 2], (target - eye) / np.linalg.norm(target - eye), atol=1e-9)
    assert rot[2, 1] <= 1e-9  # the image's y points down
    np.testing.assert_allclose(rot.T @ rot, np.eye(3), atol=1e-9)


def test_follow_camera_shows_robot_and_target():
    eye, quat = follow_camera(np.array([-1.0, 0.2, 0]), np.array([0.6, 0.1, 0.8]))
    rot = quat_to_mat(np, quat)
    for point in ([-1.0, 0.2, 0.5], [0.6, 0.1, 0.8]):
        x, y, z = rot.T @ (np.array(point) - eye)
        assert z > 0.5 and abs(np.degrees(np.arctan2(y, z))) < 21 and abs(np.degrees(np.arctan2(x, z))) < 27


def test_film_frame_asks_the_renderer_for_both_views():
    asked = []

    def render_rgb(scene, env, pos, quat, width, height, fov_deg):
        asked.append((scene, env, width, height, fov_deg))
        return np.full((height, width, 3), 10 * len(asked), dtype=np.uint8)

    outer, own = film_frame(
        render_rgb,
        "scene",
        3,
        np.zeros(3),
        np.array([1.0, 0, 0.8]),
        (np.zeros(3), np.array([1.0, 0, 0, 0])),
        (240, 180),
    )
    assert asked == [("scene", 3, 240, 180, 42.0), ("scene", 3, 80, 60, 58.0)]
    assert outer.shape == (180, 240, 3) and own.shape == (60, 80, 3)
    assert outer[140, 190, 0] == 20 and outer[40, 190, 0] == 10  # the inset lies in the lower right corner


def test_key_steps_are_in_order():
    free = np.arange(100) < 60
    contact, lifted = np.arange(100) >= 75, np.arange(100) >= 85
    steps = key_steps(free, contact, lifted)
    assert list(steps) == ["approach", "tracking", "preshape", "contact", "lift"]
    assert list(steps.values()) == [20, 50, 67, 78, 99]
    never = key_steps(np.ones(10, bool), np.zeros(10, bool), np.zeros(10, bool))
    assert list(never.values()) == sorted(never.values())


def test_strips_show_successes_first_and_near_misses_next():
    kinds = [(False, None), (False, 3.0), (True, 4.0), (False, 2.0), (True, 5.0)]
    records = [{"success": s, "time_to_grasp_s": t} for s, t in kinds]
    assert choose_strips(records, 1) == [2] and choose_strips(records, 3) == [1, 2, 4]
    assert choose_strips(records, 9) == [0, 1, 2, 3, 4] and choose_strips([], 2) == []


def test_page_stands_alone(tmp_path):
    result = make_result(tmp_path, films=3)
    path = write_page(tmp_path / "page.html", result)
    html = path.read_text()
    assert write_page(tmp_path / "again.html", result).read_text() == html
    links = re.findall(r'(?:src|href|poster)="([^"]*)"', html)
    assert all(link.startswith(("data:", "#")) for link in links)
    assert not re.search(r"@import|url\(\s*['\"]?(?!#)", html)
    assert html.count("data:video/mp4") == 6 and html.count("data:image/jpeg") == 10
    assert f"{result['episodes']} episodes" in html and percent(result["success_rate"]) in html
    for reason in result["failures"]:
        assert reason.replace("_", " ") in html
    assert "The order is the paper" in html


def test_page_without_extras_and_with_hostile_names(tmp_path):
    records = [
        {
            "success": True,
            "reason": "",
            "object": "<script>alert(1)</script>",
            "scene": "a & b",
            "time_to_grasp_s": None,
        }
    ]
    html = write_page(tmp_path / "page.html", summarise(records)).read_text()
    assert "<script" not in html and "&lt;script&gt;" in html and "No episode failed." in html


def test_page_embeds_each_reason_first_when_space_is_short(tmp_path):
    result = make_result(tmp_path, films=4)
    size = max(p.stat().st_size for p in tmp_path.glob("*.mp4"))
    html = write_page(tmp_path / "page.html", result, embed_mb=2 * size / 1e6).read_text()
    assert html.count("data:video/mp4") == 2 and "6 more videos" in html
    with pytest.raises(FileNotFoundError):
        result["records"][0]["video"] = "missing.mp4"
        write_page(tmp_path / "page.html", result)


def test_verdict_speaks_plainly(tmp_path):
    result = make_result(tmp_path, films=0)
    arms = result["figure4"][0]["arms"]
    arms[0]["success_rate"], arms[2]["success_rate"] = 0.2, 0.9
    assert "not the order that the paper reports" in write_page(tmp_path / "p.html", result).read_text()
