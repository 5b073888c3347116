"""The page in headless Chromium, driven as people drive it."""

from __future__ import annotations

import threading
from contextlib import closing, contextmanager

import pytest
from browser import Browser, needs_chromium, until
from robots import circles, direct_model, field, lidar

from nics_drl_bridge.watch.server import PageServer
from nics_drl_bridge.watch.show import show
from watch.rig import source

pytestmark = [needs_chromium, pytest.mark.process, pytest.mark.slow]
SIZES = [(1280, 800), (390, 844)]


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    with closing(Browser(tmp_path_factory.mktemp("chromium"))) as running:
        yield running


@contextmanager
def served(made):
    """A source on a page: its address, and the source."""
    with closing(made), closing(PageServer(port=0)) as server:
        thread = threading.Thread(target=show, args=(made, server), daemon=True)
        thread.start()
        yield server.url, made
    thread.join()


@pytest.fixture
def page():
    """The address of a page with 720 beams, and what it shows."""
    with served(source(model=direct_model(sensor=lidar(beams=720)))) as shown:
        yield shown


def at(browser, x, y):
    """Where a point of the world is in the window."""
    return browser.ask(
        "(() => { const t = nics.tiles[0], box = canvas.getBoundingClientRect();"
        f"const [px, py] = toPixel(t, {x}, {y}); return [box.left + px, box.top + py]; }})()"
    )


@pytest.mark.parametrize("size", SIZES)
def test_all_of_it_fits_into_the_window_and_nothing_complains(browser, page, size):
    browser.open(page[0], *size)
    assert browser.ask("document.documentElement.scrollWidth") <= size[0]
    assert browser.ask("document.documentElement.scrollHeight") <= size[1]
    outside = browser.ask(
        "[...document.querySelectorAll('button, select')].filter((one) => {"
        "const box = one.getBoundingClientRect();"
        "return box.width && (box.right > innerWidth || box.bottom > innerHeight); })"
        ".map((one) => one.textContent)"
    )
    assert outside == []
    assert min(browser.ask("[canvas.clientWidth, canvas.clientHeight]")) > 250
    for _ in range(2):
        browser.ask("$('theme').click()")
    assert browser.complaints == []


def test_the_robot_is_drawn_where_it_stands(browser, page):
    browser.open(page[0], *SIZES[0])
    browser.ask("$('pause').click()")
    until(lambda: browser.ask("nics.frame.paused"), "the pause")
    until(
        lambda: browser.ask("performance.now() > arrived + 2 * interval"), "stillness"
    )
    x, y = page[1].lanes[0].env.snapshot().poses[0, :2] + (-0.1, -0.1)
    px, py = at(browser, x, y)
    colour = browser.ask(
        "(() => { const box = canvas.getBoundingClientRect();"
        f"const dot = pen.getImageData({px} - box.left, {py} - box.top, 1, 1);"
        "return [...dot.data].slice(0, 3); })()"
    )
    assert colour == [0x00, 0x72, 0xB2]


def test_the_goal_is_dragged_a_click_adds_an_obstacle_and_keys_drive(browser, page):
    browser.open(page[0], *SIZES[0])
    browser.ask("$('pause').click()")
    until(lambda: browser.ask("nics.frame.paused"), "the pause")
    env = page[1].lanes[0].env
    goal = env.snapshot().goals[0]
    browser.mouse("Pressed", *at(browser, *goal))
    for part in (0.5, 1.0):
        browser.mouse("Moved", *at(browser, *(goal + part * (0.5 - goal))))
    browser.mouse("Released", *at(browser, 0.5, 0.5))
    until(lambda: abs(env.snapshot().goals[0] - 0.5).max() < 0.02, "the goal")
    browser.ask("$('clear').click()")
    until(
        lambda: browser.ask("nics.frame.worlds[0].bodies.length === 0"),
        "an empty field",
    )
    browser.ask("document.querySelector('[data-tool=box]').click()")
    x, y = page[1].lanes[0].env.snapshot().poses[0, :2]
    place = at(browser, -2.5 if x > 0 else 2.5, -2.5 if y > 0 else 2.5)
    browser.mouse("Pressed", *place)
    browser.mouse("Released", *place)
    until(lambda: browser.ask("nics.frame.worlds[0].bodies.length === 1"), "the box")
    key = {"code": "ArrowDown", "key": "ArrowDown"}
    browser.call("Input.dispatchKeyEvent", type="keyDown", **key)
    until(lambda: browser.ask("byHand"), "driving by hand")
    browser.ask("$('pause').click()")
    until(
        lambda: browser.ask("nics.frame.worlds[0].commands[0][0]") == -2.0, "reversing"
    )
    browser.call("Input.dispatchKeyEvent", type="keyUp", **key)
    until(lambda: browser.ask("nics.frame.worlds[0].commands[0][0]") == 0.0, "standing")


def wheel(browser, amount):
    """Turns the wheel in the middle of the picture."""
    browser.ask(
        "(() => { const box = canvas.getBoundingClientRect();"
        "canvas.dispatchEvent(new WheelEvent('wheel', {"
        "clientX: box.left + box.width / 2, clientY: box.top + box.height / 2,"
        f"deltaY: {amount}, cancelable: true }})); }})()"
    )


def test_the_scale_follows_the_zoom_and_is_as_long_as_it_says(browser, page):
    browser.open(page[0], *SIZES[0])
    lengths = browser.ask(
        "[100, 80, 33, 32, 3000, 0.1].map((p) => scaleLength(p, 160))"
    )
    assert lengths == pytest.approx([1.0, 2.0, 2.0, 5.0, 0.05, 1000.0])
    texts = browser.ask("[0.002, 0.05, 1, 20, 2000].map(scaleText)")
    assert texts == ["2 mm", "5 cm", "1 m", "20 m", "2 km"]
    seen = []
    for amount in (0, -1200, 2400):
        before = browser.ask("nics.counters.draws")
        wheel(browser, amount)
        until(
            lambda before=before: browser.ask("nics.counters.draws") > before + 1,
            "a drawing",
        )
        bar, scale = browser.ask("[nics.tiles[0].bar, nics.tiles[0].scale]")
        assert bar["pixels"] == pytest.approx(bar["metres"] * scale)
        assert 60 <= bar["pixels"] <= 160
        seen.append(bar["metres"])
    whole, near, far = seen
    assert near < whole < far


def test_arrows_point_where_robot_and_obstacle_move_and_nowhere_else(browser):
    patrol = {"kind": "patrol", "waypoints": [[-2.0, -2.0], [2.0, -2.0]], "speed": 0.5}
    crowd = field(count=2, obstacles=[circles(1), circles(1) | {"motion": patrol}])
    with served(source(world=crowd)) as (url, _):
        browser.open(url, *SIZES[0])
        arrows = "arrowsOf(nics.frame.worlds[0], nics.frame.worlds[0].poses)"
        speeds = f"{arrows}.map((one) => Math.hypot(one.vx, one.vy))"
        until(
            lambda: browser.ask(f"{arrows}.length") == 2,
            "two arrows: of robot and obstacle",
        )
        assert min(browser.ask(speeds)) == pytest.approx(0.5, abs=0.01)
        browser.ask("document.querySelector('[data-layer=motion]').click()")
        assert browser.ask("layers.motion") is False
        assert browser.complaints == []


def test_the_panel_says_which_world_and_which_model_it_describes(browser):
    with served(source(worlds=3, model_name="runs/my_robot")) as (url, made):
        browser.open(url, *SIZES[0])
        panel = "$('facts').innerText.toLowerCase()"
        until(lambda: "world 1 of 3" in browser.ask(panel), "the first world")
        text = browser.ask(panel)
        assert f"{made.lanes[0].world.name}, episode 3" in text
        assert "runs/my_robot" in text
        assert "direct" in text  # its robot
        assert "72 beams, 3 m" in text
        x, y = browser.ask(
            "(() => { const t = nics.tiles[2], box = canvas.getBoundingClientRect();"
            "return [box.left + t.left + t.width / 2, box.top + t.top + t.height / 2]; })()"
        )
        browser.mouse("Pressed", x, y)
        browser.mouse("Released", x, y)
        until(lambda: "world 3 of 3" in browser.ask(panel), "the third world")
