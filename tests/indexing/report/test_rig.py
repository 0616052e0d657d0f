"""The scene in space: what is packed is what was found, and the script turns it, plays it, and sees what a camera saw."""

from __future__ import annotations

import base64
import json
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
import torch

from indexing.report.calibration import CalibrationReport, write_calibration
from indexing.report.rig import MAX_VALUES, heat_picture, plan_picture, scene
from tests.indexing.calibrate.scene import FPS, SIZE, rig, truth
from tests.indexing.report.people import BROWSER, in_browser

NODE = shutil.which("node")
SCRIPT = Path("indexing/report/rig.js")


def unpacked(data):
    codes = np.frombuffer(base64.b64decode(data["points"]), "<i2").astype(float).reshape(len(data["times"]), -1, 3)
    codes[codes == -32768] = np.nan
    return codes * data["unit"] + data["middle"]


def test_what_is_packed_is_what_was_found_and_fits_into_the_page():
    found = rig(people=2)
    found.calibration.points[5, 3] = torch.nan
    data = json.loads(scene(found)[0])
    points = unpacked(data)
    assert data["people"] == 2 and data["joints"] == 17 and len(data["cameras"]) == 3 and points.shape == (110, 34, 3)
    assert np.isnan(points[5, 3]).all() and np.isfinite(points[4]).all()
    assert np.nanmax(np.abs(points - found.calibration.points.numpy())) < 2e-3
    assert data["times"][:3] == [0, 33, 67] and data["ground"]["step"] == 1
    assert [0, 1, "l"] in data["bones"] and np.allclose(data["cameras"][0]["center"], [4, -1, 1.4])
    found = rig()
    many = 9000
    points = torch.from_numpy(truth().points).repeat(many // 110 + 1, 1, 1)[:many]
    long = rig(times=torch.arange(many, dtype=torch.float64) / 60, points=points)
    data, said = scene(long)
    assert len(data) < 900_000 and len(json.loads(data)["times"]) <= MAX_VALUES // 51 and "of 60 frames a second" in said
    nothing = rig(points=torch.full_like(found.calibration.points, torch.nan))
    assert scene(nothing) == ("", "") and plan_picture(nothing)[:4] == b"\x89PNG"
    assert heat_picture(rig(residuals=torch.full((3, 17), torch.nan, dtype=torch.float64))) is None


# frames come when the driver says, in node as in a browser
DRIVER = """
let waiting = null, now = 0;
window.requestAnimationFrame = (draw) => { waiting = draw; };
const frame = (after) => { const draw = waiting; waiting = null; now += after; if (draw) draw(now); };
const root = document.querySelector(".rig"), canvas = root.querySelector("canvas");
const [play, again] = root.querySelectorAll("button"), [speed, through] = root.querySelectorAll("select");
const happens = (more) => new KeyboardEvent("keydown", { bubbles: true, cancelable: true, ...more });
const press = (key, more = {}) => root.dispatchEvent(happens({ key, ...more }));
const point = (type, x, y) => {
  const event = new PointerEvent(type, { pointerId: 1, bubbles: true, buttons: 1, clientX: x, clientY: y });
  for (const [name, value] of [["offsetX", x], ["offsetY", y]]) Object.defineProperty(event, name, { value });
  canvas.dispatchEvent(event);
};
const said = {};
const note = (name) => { said[name] = [Number(root.dataset.time), play.textContent, Number(through.value)]; };
note("begin"); press("ArrowRight"); note("step"); press("ArrowRight", { shiftKey: true }); note("second");
press(" "); frame(16); note("started");
frame(100); frame(200); note("played"); speed.value = "0.5"; frame(200); note("slow"); frame(5000); note("late");
press(" "); note("stopped"); press("ArrowDown"); note("through"); press("ArrowUp"); press("End"); note("end");
press(" "); frame(10); frame(100); note("anew"); press(" "); press("Home"); note("home");
said.people = root.dataset.people;
if (canvas.pen) {
  const bones = () => canvas.getContext().lines.filter((line) => ["--left", "--right", "--muted"].includes(line[0]));
  said.outside = bones().length;
  point("pointerdown", 100, 100); point("pointermove", 160, 120);
  const turned = bones(); point("pointermove", 160, 120); said.still = JSON.stringify(turned) === JSON.stringify(bones());
  point("pointermove", 100, 100); said.back = Math.max(...bones().map((line, i) => Math.abs(line[1] - turned[i][1])));
  point("pointerup", 100, 100); point("pointermove", 300, 300);
  press("ArrowDown"); press("ArrowDown"); said.seen = bones();
} else {
  said.ink = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height).data.some((value) => value > 0);
}
"""


def check_play(said):
    """What the keys do, to the millisecond."""
    assert said["begin"] == [0.0, "Play", -1] and said["step"] == [pytest.approx(1 / 15, abs=2e-3), "Play", -1]
    assert said["second"][0] == pytest.approx(1 + 1 / 15, abs=2e-3) and said["started"] == [said["second"][0], "Pause", -1]
    assert said["played"][0] == pytest.approx(said["second"][0] + 0.3, abs=2e-3)
    assert said["slow"][0] == pytest.approx(said["played"][0] + 0.1, abs=2e-3)
    # a frame that comes late skips no more than a quarter
    assert said["late"][0] == pytest.approx(said["slow"][0] + 0.125, abs=2e-3)
    assert said["stopped"] == [said["late"][0], "Play", -1] and said["through"][2] == 0
    assert said["end"] == [pytest.approx(109 / FPS, abs=2e-3), "Play", -1] and said["anew"][0] == pytest.approx(0.05, abs=2e-3)
    assert said["home"] == [0.0, "Play", -1] and said["people"] == "1"


@pytest.mark.skipif(NODE is None, reason="needs node")
def test_it_turns_and_plays_and_sees_what_a_camera_saw(tmp_path):
    data, _ = scene(rig())
    dom, script = Path(__file__).with_name("dom.js").read_text(), SCRIPT.read_text().replace('"use strict";', "")
    parts = [dom, f"page({json.dumps(data)});", script, DRIVER, "console.log(JSON.stringify(said));"]
    (tmp_path / "run.js").write_text("\n".join(parts))
    done = subprocess.run([NODE, str(tmp_path / "run.js")], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    said = json.loads(done.stdout)
    check_play(said)
    bones = json.loads(data)["bones"]
    assert said["outside"] == len(bones) and said["still"] and said["back"] > 5
    # 600 x 400 pixels of canvas hold the picture of the camera, as high as its width allows
    x = truth().points[0] @ truth().R[1].numpy().T + truth().t[1].numpy()
    image = (x @ truth().K[1].numpy().T)[:, :2] / x[:, 2:]
    scale = 600 / SIZE[0]
    image = image * scale + [0.0, (400 - scale * SIZE[1]) / 2]
    for (colour, *ends), (a, b, side) in zip(said["seen"], bones, strict=True):
        assert colour == {"l": "--left", "r": "--right", "m": "--muted"}[side]
        assert ends == pytest.approx([*image[a], *image[b]], abs=0.3)


@pytest.mark.skipif(BROWSER is None, reason="needs a browser: chromium or chrome")
def test_it_plays_in_a_browser(tmp_path):
    text = write_calibration(tmp_path / "out", CalibrationReport(rig()))[0].read_text(encoding="utf-8")
    said = in_browser(text, f"{DRIVER}; document.title = JSON.stringify(said);", tmp_path)
    check_play(said)
    assert said["ink"]
