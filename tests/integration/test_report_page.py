"""The report in a browser, driven over its debugging pipe: real keys and pointers, and whatever it complains about."""

from __future__ import annotations

import base64
import json
import os
import re
import shutil
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from sgam_sfm.comparison.report import Bounds, write_report
from tests.unit.test_report import write_comparison

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="chromium is not installed")

_KEYS = {"Enter": (13, "\r"), "Escape": (27, ""), "ArrowRight": (39, ""), "ArrowDown": (40, "")}


class Browser:
    """One tab. problems: errors on its console; requests: what it asked the network or disk for."""

    def __init__(self, reading: int, writing: int) -> None:
        self._reading, self._writing = reading, writing
        self._buffer, self._number, self._session = b"", 0, ""
        self.problems: list[str] = []
        self.requests: list[str] = []
        target = self.send("Target.createTarget", url="about:blank")["targetId"]
        self._session = self.send("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.send(f"{domain}.enable")

    def send(self, method: str, **params: Any) -> dict[str, Any]:
        self._number += 1
        message = {"id": self._number, "method": method, "params": params}
        message |= {"sessionId": self._session} if self._session else {}
        os.write(self._writing, json.dumps(message).encode() + b"\0")
        while (answer := self._receive()).get("id") != self._number:
            self._keep(answer)
        assert "error" not in answer, answer
        return answer["result"]

    def open(self, path: Path, width: int, *, dark: bool = False, height: int = 900) -> None:
        scheme = [{"name": "prefers-color-scheme", "value": "dark" if dark else "light"}]
        self.send("Emulation.setEmulatedMedia", features=scheme)
        self.send("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=False)
        self.send("Page.navigate", url=path.as_uri())
        self.wait("document.readyState === 'complete' && location.protocol === 'file:'")

    def value(self, expression: str) -> Any:
        answer = self.send("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in answer, answer
        return answer["result"].get("value")

    def wait(self, expression: str, seconds: float = 30) -> None:
        end = time.monotonic() + seconds
        while not self.value(expression):
            assert time.monotonic() < end, f"never true: {expression}"
            time.sleep(0.05)

    def centre(self, selector: str) -> tuple[float, float]:
        self.value(f"document.querySelector({selector!r}).scrollIntoView({{block: 'center', behavior: 'instant'}})")
        box = self.value(f"document.querySelector({selector!r}).getBoundingClientRect().toJSON()")
        return box["x"] + box["width"] / 2, box["y"] + box["height"] / 2

    def point(self, x: float, y: float) -> None:
        self.send("Input.dispatchMouseEvent", type="mouseMoved", x=x, y=y)

    def click(self, selector: str) -> None:
        x, y = self.centre(selector)
        for kind in ("mousePressed", "mouseReleased"):
            self.send("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", clickCount=1)

    def press(self, key: str) -> None:
        code, text = _KEYS[key]
        for kind in ("keyDown", "keyUp"):
            self.send("Input.dispatchKeyEvent", type=kind, key=key, code=key, windowsVirtualKeyCode=code, text=text)

    def screenshot(self, path: Path) -> None:
        shot = self.send("Page.captureScreenshot", captureBeyondViewport=False)
        path.write_bytes(base64.b64decode(shot["data"]))

    def _receive(self) -> dict[str, Any]:
        while b"\0" not in self._buffer:
            received = os.read(self._reading, 1 << 20)
            assert received, "the browser ended"
            self._buffer += received
        message, _, self._buffer = self._buffer.partition(b"\0")
        return json.loads(message)

    def _keep(self, event: dict[str, Any]) -> None:
        method, params = event.get("method"), event.get("params", {})
        if method == "Runtime.exceptionThrown":
            self.problems.append(json.dumps(params["exceptionDetails"])[:500])
        if method == "Runtime.consoleAPICalled" and params["type"] in ("error", "assert"):
            self.problems.append(json.dumps(params["args"])[:500])
        if method == "Log.entryAdded" and params["entry"]["level"] == "error":
            self.problems.append(params["entry"]["text"])
        if method == "Network.requestWillBeSent":
            self.requests.append(params["request"]["url"][:100])


@contextmanager
def browsing(profile: Path) -> Iterator[Browser]:
    to_browser, from_browser = os.pipe(), os.pipe()
    arguments = [
        "--headless",
        "--no-sandbox",
        "--disable-dev-shm-usage",
        "--enable-unsafe-swiftshader",
        "--no-first-run",
    ]
    # The pipe is file descriptors 3 and 4 of the browser.
    redirect = f'exec "$@" 3<&{to_browser[0]} 4>&{from_browser[1]}'
    process = subprocess.Popen(
        [
            "bash",
            "-c",
            redirect,
            "bash",
            CHROMIUM or "",
            *arguments,
            f"--user-data-dir={profile}",
            "--remote-debugging-pipe",
        ],
        pass_fds=(to_browser[0], from_browser[1]),
        stderr=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
    )
    os.close(to_browser[0])
    os.close(from_browser[1])
    try:
        yield Browser(from_browser[0], to_browser[1])
    finally:
        process.terminate()
        process.wait(20)
        os.close(to_browser[1])
        os.close(from_browser[0])


@pytest.fixture(scope="module")
def report(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("report")
    output = folder / "out \"&' <b>"
    content = write_comparison(output, folder / "<images>", folder / "truth")
    return write_report(output, content, Bounds(gallery=2))


@pytest.fixture(scope="module")
def browser(tmp_path_factory) -> Iterator[Browser]:
    with browsing(tmp_path_factory.mktemp("profile")) as browser:
        yield browser


def draw_everything(browser: Browser) -> None:
    """Plots are drawn when they come near the window."""
    height = browser.value("document.documentElement.scrollHeight")
    for top in range(0, height, 700):
        browser.value(f"scrollTo({{top: {top}, behavior: 'instant'}})")
        time.sleep(0.1)
    browser.wait("[...document.querySelectorAll('.plot')].every(plot => plot.querySelector('.main-svg'))")


@pytest.mark.parametrize(("width", "dark"), [(1280, False), (400, True), (400, False), (1280, True)])
def test_the_page_fits_and_nothing_is_complained_about(browser, report, width, dark):
    browser.open(report, width, dark=dark)
    draw_everything(browser)
    assert browser.value("document.documentElement.scrollWidth") <= width
    assert browser.value("document.querySelector('.scroll').getBoundingClientRect().right") <= width
    assert browser.value("document.querySelectorAll('.plot').length") == 7
    wide = "[...document.querySelectorAll('.plot .main-svg')].filter(e => e.getBoundingClientRect().right > innerWidth)"
    assert browser.value(f"{wide}.length") == 0
    ground = browser.value("getComputedStyle(document.body).backgroundColor")
    assert (sum(map(int, re.findall(r"\d+", ground))) < 200) == dark
    assert browser.problems == []
    assert {url for url in browser.requests if not url.startswith(("data:", "blob:"))} == {report.as_uri()[:100]}


def test_file_names_are_shown_as_they_are(browser, report):
    browser.open(report, 1280)
    assert browser.value("document.querySelector('h1').textContent") == report.parent.name
    assert "<script>.jpg" in browser.value("document.querySelector('#gallery').textContent")
    assert browser.value("document.querySelectorAll('script').length") == 3


def test_a_matrix_tells_its_cells_to_pointers_and_keys(browser, report):
    browser.open(report, 1280)
    canvas = ".matrices canvas"
    middle = browser.centre(canvas)
    size = browser.value(f"document.querySelector('{canvas}').getBoundingClientRect().width")
    tip = "document.querySelector('#tip').hidden ? '' : document.querySelector('#tip').textContent"
    browser.point(middle[0] - 0.125 * size, middle[1] - 0.375 * size)  # row 0, column 1
    assert browser.value(tip) == "\"&'.jpg - <script>.jpg60 inliers of 80 raw matches, gained +30"
    assert browser.value("[...document.querySelectorAll('#tip img')].map(image => image.alt)") == [
        "\"&'.jpg",
        "<script>.jpg",
    ]
    browser.point(middle[0] - 0.375 * size, middle[1] - 0.375 * size)  # the diagonal is no pair
    assert browser.value(tip) == ""
    browser.value(f"document.querySelector('{canvas}').focus()")
    browser.press("ArrowRight")
    browser.press("ArrowRight")
    assert browser.value(tip).startswith("\"&'.jpg - c.jpg59 inliers")
    browser.press("Escape")
    assert browser.value(tip) == ""
    assert browser.problems == []


def test_matrices_change_what_they_show(browser, report):
    browser.open(report, 1280)
    content = "document.querySelector('.matrices canvas').toDataURL()"
    before = browser.value(content)
    assert browser.value("document.querySelector('#scale').innerText").split() == ["0", "60", "inliers"]
    browser.click("input[value=change]")
    assert browser.value(content) != before
    assert browser.value("document.querySelector('#scale').innerText").split("\n") == [
        "-30 inliers lost",
        "+30 inliers gained",
    ]


def test_gallery_opens_by_click_and_enter_and_closes_by_escape(browser, report):
    browser.open(report, 1280)
    shown = "document.querySelector('#large').open && document.querySelector('#large img').alt"
    browser.click(".gallery .open")
    assert browser.value(shown).startswith("sgam:xfeat-star, and beneath none:xfeat-star of \"&'.jpg and <script>.jpg")
    browser.wait("document.querySelector('#large img').naturalWidth === 1200")
    browser.press("Escape")
    browser.wait("!document.querySelector('#large').open")
    browser.value("document.querySelectorAll('.gallery .open')[1].focus()")
    browser.press("Enter")
    assert browser.value(shown).endswith("c.jpg: areas and point matches drawn over both images")
    browser.click("#large .close")
    assert browser.value("document.querySelector('#large').open") is False
    assert browser.problems == []


def test_axes_are_named_and_counts_are_whole(browser, report):
    browser.open(report, 1280)
    draw_everything(browser)
    flat = "[...document.querySelectorAll('.plot')].filter(plot => plot.id !== 'scene')"
    titles = browser.value(f"{flat}.map(plot => ['x', 'y'].map(a => plot.querySelector(`.${{a}}title`).textContent))")
    assert titles[0] == ["pose error, degrees", "share of pairs"]
    assert all(title for pair in titles for title in pair)
    ticks = "(plot, axis) => [...document.querySelectorAll(`#${plot} .${axis}tick text`)].map(tick => tick.textContent)"
    assert browser.value(f"({ticks})('coverage', 'x')") == list("123456")
    assert all(tick.isdigit() for axis in "xy" for tick in browser.value(f"({ticks})('tracks', '{axis}')"))
    assert {"5", "10", "20", "50"} <= set(browser.value(f"({ticks})('tracks', 'y')"))


def test_pictures_of_the_gallery_are_whole(browser, report):
    browser.open(report, 1280)
    browser.centre(".gallery img")
    browser.wait("document.querySelector('.gallery img').complete")
    image = "document.querySelector('.gallery img')"
    shown = browser.value(f"{image}.clientWidth / {image}.clientHeight")
    assert shown == pytest.approx(browser.value(f"{image}.naturalWidth / {image}.naturalHeight"), rel=0.02)


def test_models_are_toggled_in_the_legend(browser, report):
    browser.open(report, 1280)
    draw_everything(browser)
    visible = "document.querySelector('#scene').data.map(trace => trace.visible ?? true)"
    assert browser.value(visible) == [True] * 7
    browser.click("#scene .groups:nth-of-type(2) .legendtoggle")  # cameras and points of the first method
    browser.wait(f"{visible}.join() === 'true,legendonly,legendonly,true,true,true,true'")
    assert browser.problems == []


def test_points_of_plots_tell_their_pair(browser, report):
    browser.open(report, 1280)
    browser.centre("#by_angle")
    browser.wait("document.querySelector('#by_angle .main-svg')")
    browser.value("Plotly.Fx.hover('by_angle', [{curveNumber: 0, pointNumber: 0}])")
    assert "<script>.jpg" in browser.value("document.querySelector('#by_angle .hoverlayer').textContent")
