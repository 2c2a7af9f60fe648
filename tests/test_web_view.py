"""The page in the browser: what an HTTP client and a websocket client get from it, and what a headless
browser shows."""

import asyncio
import dataclasses
import logging
import re
import socket
import subprocess
import sys
import threading
import time
import types
import urllib.request

import numpy as np
import pytest

viser = pytest.importorskip("viser", reason="needs viser (extra web)")

# ruff: noqa: E402
import browser
import zstandard

from biotac_mj import cli
from biotac_mj.coupling.show import electrode_colors
from biotac_mj.press.record import write_skin
from biotac_mj.view import web as web_view
from biotac_mj.view import web_play
from biotac_mj.view.web import FIELDS, Moment
from biotac_mj.view.web_play import play_press


def messages(page, seconds=1.0):
    """All messages a new client gets from a page, unpacked."""
    import msgspec
    import websockets

    async def listen():
        frames = []
        address = page.url.replace("http", "ws")
        async with websockets.connect(
            address, subprotocols=[f"viser-v{viser.__version__}"], max_size=None
        ) as socket:
            try:
                while True:
                    frames.append(await asyncio.wait_for(socket.recv(), seconds))
            except TimeoutError:
                return frames

    out = []
    for frame in asyncio.run(listen()):
        # two lengths, a compressed msgpack, then the arrays it refers to, each aligned to 8 bytes
        # (viser/infra/_infra.py)
        size = int.from_bytes(frame[8:16], "little")
        content = msgspec.msgpack.decode(zstandard.ZstdDecompressor().decompress(frame[16 : 16 + size]))
        arrays, at = [], 16 + size
        for length in content["binaryBufferLengths"]:
            at += -at % 8
            arrays.append(frame[at : at + length])
            at += length
        out += [(message, arrays) for message in content["messages"]]
    return out


def vertices(found, name):
    """Last vertices sent for a mesh."""
    last = None
    for message, arrays in found:
        if message.get("name") == name:
            sent = message.get("props", message.get("updates", {})).get("vertices")
            last = arrays[sent["__binary_index"]] if sent is not None else last
    return np.frombuffer(last, np.float32).reshape(-1, 3)


@pytest.fixture
def page(shell):
    made = web_view.Page({"left": web_view.Finger.of(shell, np.full(19, 3000.0))}, port=8931)
    yield made
    made.close()


def test_page_is_served_and_carries_the_finger(page, shell):
    html = urllib.request.urlopen(page.url, timeout=5).read()
    assert html.lstrip().lower().startswith(b"<!doctype html") and b"<script" in html
    finger = page.fingers["left"]
    moved = shell.vert[finger.node] + [0, 1e-3, 0]
    counts = np.full(19, 3000.0)
    counts[4] -= 300
    for now in (0.1, 0.2):
        page.update(now, {"left": Moment(moved, counts, 50.0, 0.4, np.array([0, 0, 1.0]))})
    found = messages(page)
    names = {m.get("name") for m, _ in found}
    assert {"/left", "/left/skin", "/left/core", *(f"/left/e{i}" for i in range(1, 20))} <= names
    np.testing.assert_allclose(vertices(found, "/left/skin"), moved, atol=1e-7)
    text = repr([m for m, _ in found])
    assert "t = 0.200 s" in text and "force [N]" in text and "'e19'" in text
    # the electrode whose counts fell is red, the others are grey
    assert tuple(page._scene["left"][2][4].color) == (204, 38, 25) and tuple(
        page._scene["left"][2][5].color
    ) == (216, 216, 216)
    rows = page._gui["left"][1][0].data
    np.testing.assert_allclose(rows[0], [0.1, 0.2])
    np.testing.assert_allclose(rows[5], [-300, -300])


def test_a_connection_that_a_browser_does_not_use_is_no_error(page):
    said, seen = [], logging.Handler()
    seen.emit = said.append
    logging.getLogger().addHandler(seen)
    host, port = page.url.removeprefix("http://").split(":")
    with socket.create_connection((host, int(port)), timeout=5):
        pass
    urllib.request.urlopen(page.url, timeout=5).read()  # by now the server has seen that one go
    time.sleep(0.2)
    logging.getLogger().removeHandler(seen)
    assert not said


def green(picture):
    """Where the skin is seen, right of which the panel begins."""
    r, g, b = np.moveaxis(picture[:, :660].astype(int), 2, 0)
    return np.argwhere((g - r > 20) & (g > b))


def red_on_the_map(picture):
    panel = picture[:, 660:].astype(int)
    return ((panel[..., 0] > 180) & (panel[..., 2] < 60)).sum()


@pytest.mark.skipif(browser.executable() is None, reason="needs Chromium (Debian: chromium)")
def test_a_browser_shows_the_finger_and_what_it_reads(page, shell, tmp_path):
    vert, counts = shell.vert[page.fingers["left"].node], np.full(19, 3000.0)
    counts[4] -= 300
    pose = np.array([0.3, -0.2, 1.0]), np.array([np.cos(0.4), 0, 0, np.sin(0.4)])
    with browser.Browser(page.url, tmp_path) as window:
        page.update(0.1, {"left": Moment(vert, counts, 50.0, 0.4, *pose)})
        # the skin, and on the map the electrode whose counts fell; the page may draw one before the other
        before = window.until(lambda picture: len(green(picture)) > 3000 and red_on_the_map(picture) > 100)
        assert (
            np.abs(green(before).mean(0) - np.array(before.shape[:2]) / 2).max() < 70
        )  # in the middle of the page
        wide = vert * [1, 1, 1.6]
        page.update(0.2, {"left": Moment(wide, counts, 50.0, 0.4, *pose)})
        window.until(lambda picture: len(green(picture)) > 1.15 * len(green(before)))
        text = window.evaluate("document.body.innerText")
    assert (
        "t = 0.200 s" in text
        and "change [counts]" in text
        and "tip left" in text
        and "PDC above rest [counts]" in text
    )


def test_each_electrode_has_its_number(page):
    assert len(page._numbers) == 19 * len(page.fingers)


def test_the_skins_colour_is_a_quantity_with_a_legend(shell):
    """Triangles go to the mesh of their band; the top of the scale is a round number and only grows."""
    finger = web_view.Finger.of(shell, np.full(19, 3000.0), fields=("contact pressure",))
    page = web_view.Page({"one": finger}, port=8934)
    try:
        vert = shell.vert[finger.node]
        pressed = np.where(vert[:, 1] < -4e-3, 2.4e4, 0.0)

        def show(pressure):
            fields = {"contact pressure": lambda: pressure}
            page.update(0.0, {"one": Moment(vert, finger.rest, 0.0, 0.0, fields=fields)})
            skin = page._scene["one"][1]
            return [m.faces if m.visible else m.faces[:0] for m in skin], [tuple(m.color) for m in skin]

        assert page.field.value == "contact pressure"  # a page opens with a quantity
        page.field.value = "none"
        (whole, *rest), _ = show(pressed)
        assert len(whole) == len(finger.face) and not any(map(len, rest)) and not page._legend.content
        page.field.value = "contact pressure"
        faces, colors = show(pressed)
        raised = pressed[finger.face].mean(1) >= 30e3 / 8  # above the lowest of eight bands
        assert len(faces[0]) == len(finger.face) and sum(map(len, faces[1:])) == raised.sum()
        # 24 of 30 kPa
        full = (pressed[finger.face] > 0).all(1)
        np.testing.assert_array_equal(faces[6], finger.face[full])
        assert colors[6] == web_view._rgb(FIELDS["contact pressure"].bands()[6]) != colors[0]
        said = page._legend.content
        assert "contact pressure [kPa]; green: below 3.75" in said
        assert re.findall("<span>([^<]*)</span>", said) == ["0", "7.5", "15", "22.5", "30"]
        show(pressed / 100)
        assert page._legend.content == said
    finally:
        page.close()


def test_a_press_is_made_anew_where_a_slider_says():
    """Deeper and elsewhere; the page opens on one that plays."""
    sliders, forces = {}, []

    class Slider:
        value = max = 0.0

        def on_update(self, function):
            self.moved = function

    class Gui:
        def add_slider(self, name, *_, **__):
            return sliders.setdefault(name, Slider())

        def add_checkbox(self, name, value, **_):
            return types.SimpleNamespace(value=value)

    class Shown:
        server = types.SimpleNamespace(gui=Gui())
        fingers = {"press": types.SimpleNamespace(rows=None)}

        def update(self, time, state):
            forces.append(state["press"].force)
            if len(forces) == 1:
                target = types.SimpleNamespace(value=0.5)
                sliders["depth [mm]"].moved(types.SimpleNamespace(target=target))

    page = Shown()
    settings = dict(skin="coarse", tier="condensed", timestep=10e-3)
    assert play_press(settings, page, rounds=1, speed=100.0) is page
    assert 0.05 < max(forces) < 1.0  # of 0.5 mm, not of 1.5
    assert max(forces) <= page.fingers["press"].rows[:, -1].max() < 1.0


def test_electrode_map_shows_each_electrode_at_its_place():
    from xml.etree import ElementTree

    position = np.array([[-16e-3, -5e-3, 0], [0.0, -3.5e-3, -3.5e-3]])
    picture = ElementTree.fromstring(web_view.electrode_map(position, np.array([-300.0, 300.0])))
    space = "{http://www.w3.org/2000/svg}"
    red, blue = picture.findall(f"{space}circle")
    assert (red.get("fill"), blue.get("fill")) == ("rgb(204, 38, 25)", "rgb(25, 76, 216)")
    assert float(red.get("cx")) < float(blue.get("cx")) - 100  # the tip is on the left
    assert float(blue.get("cy")) > float(red.get("cy"))  # E1..E6, at -z, are below
    scale = picture.findall(f"{space}rect")  # what the fills mean
    ends = [f"rgb{web_view._rgb(c)}" for c in electrode_colors(np.array([-288, 288]))]
    assert [scale[0].get("fill"), scale[-1].get("fill")] == ends and len(scale) == 25
    assert {"-300", "+300", "change [counts]"} <= {t.text for t in picture.findall(f"{space}text")}
    numbers = picture.findall(f"{space}text")
    assert [t.text for t in numbers[:2]] == ["1", "2"]
    assert float(numbers[0].get("x")) == float(red.get("cx"))


@pytest.fixture
def two_recordings(synthetic_press, tmp_path):
    """Files of a press, and of one that swells to 1.6 times its height and has a pressure."""
    pressure = np.zeros(synthetic_press.vert_xpos.shape[:2], np.float32)
    pressure[-1] = 5e4
    size = np.ones((len(pressure), 1, 3), np.float32)
    size[:, 0, 1] = np.linspace(1, 1.6, len(pressure))
    swelling = dataclasses.replace(
        synthetic_press, contact_pressure=pressure, vert_xpos=size * synthetic_press.vert_xpos
    )
    files = [tmp_path / name / "skin.h5" for name in "ab"]
    for path, record in zip(files, (synthetic_press, swelling)):
        path.parent.mkdir()
        write_skin(record, path)
    return files


def test_recorded_presses_are_played_beside_each_other(synthetic_press, two_recordings):
    """With their indenters, and pressure where the file has it."""
    page = web_play.play_file(*two_recordings, speed=1e3, rounds=1, port=8932)
    try:
        finger = page.fingers["a"]
        assert page.fingers["b"].fields == ("contact pressure",) and not finger.fields
        found = messages(page)
        np.testing.assert_allclose(
            vertices(found, "/a/skin"), synthetic_press.vert_xpos[-1][finger.node], atol=1e-7
        )
        np.testing.assert_allclose(vertices(found, "/b/tool"), synthetic_press.indenter_vert, atol=1e-7)
        apart = page._scene["b"][0].position - page._scene["a"][0].position
        assert np.linalg.norm(apart) > np.ptp(synthetic_press.geometry.vert[:, 0])
        tool = page._scene["a"][3]
        np.testing.assert_allclose(tool.position, synthetic_press.indenter_pos[-1], atol=1e-7)
        rows = page._gui["a"][1][2].data
        np.testing.assert_allclose(rows[1], np.linalg.norm(synthetic_press.force, axis=1), atol=1e-9)
    finally:
        page.close()


def test_the_slider_stays_where_a_hand_puts_it(two_recordings, monkeypatch):
    """What the film sent before the hand came arrives after it: the slider's place is sent once more."""
    pages, sent = [], []
    monkeypatch.setattr(
        web_play, "_served", lambda fingers: pages.append(web_view.Page(fingers, port=8936)) or pages[0]
    )
    player = threading.Thread(
        target=web_play.play_file, args=two_recordings, kwargs={"speed": 0.05, "rounds": 1}
    )
    player.start()

    def wait(holds):
        end = time.monotonic() + 30
        while not holds():
            assert time.monotonic() < end
            time.sleep(0.01)

    def inputs():
        return list(pages[0].server.gui._gui_input_handle_from_uuid.values()) if pages else []

    wait(lambda: any(isinstance(i, viser.GuiSliderHandle) and i.value for i in inputs()))
    slider = next(i for i in inputs() if isinstance(i, viser.GuiSliderHandle))
    playing = next(i for i in inputs() if i.label == "play")
    try:
        socket = slider._impl.gui_api._websock_interface
        queue = socket.queue_message
        monkeypatch.setattr(socket, "queue_message", lambda m: sent.append(m) or queue(m))
        slider._impl.value = 0.008  # as viser does with what a client sends
        for call in slider._impl.update_cb:
            call(viser.GuiEvent(client=object(), client_id=0, target=slider))
        wait(lambda: not playing.value and pages[0]._title.content.endswith("t = 0.008 s"))
        time.sleep(0.1)
        values = [m.updates["value"] for m in sent if getattr(m, "uuid", None) == slider._impl.uuid]
        assert values and values[-1] == 0.008
    finally:
        playing.value = True
        player.join(30)
        pages[0].close()


@pytest.fixture
def window_of_recordings(two_recordings, tmp_path):
    """A browser on the page that `biotac view` serves of two recordings."""
    words = ["play", "--port", "8935", *map(str, two_recordings)]
    server = subprocess.Popen([sys.executable, "-m", "biotac_mj", *words], stdout=subprocess.PIPE, text=True)
    try:
        url = next(word for line in server.stdout for word in line.split() if word.startswith("http://"))
        with browser.Browser(url, tmp_path) as window:
            yield window
    finally:
        server.terminate()
        server.communicate(timeout=20)


def beside(picture):
    """Pixels of the skins left and right of the widest gap between them."""
    columns = np.unique(green(picture)[:, 1])
    gap = np.diff(columns).argmax()
    middle = (columns[gap] + columns[gap + 1]) / 2
    left = (green(picture)[:, 1] < middle).sum()
    return left, len(green(picture)) - left, columns[gap + 1] - columns[gap]


@pytest.mark.slow  # a program, a browser and its drawing: a quarter of a minute
@pytest.mark.skipif(browser.executable() is None, reason="needs Chromium (Debian: chromium)")
def test_a_slider_moves_two_recordings_beside_each_other(window_of_recordings):
    """The film stops where it is put; on both maps the electrodes answer, and the right skin swells."""
    window, slider = window_of_recordings, "document.querySelector('[role=slider]')"
    playing = "document.querySelector('input[type=checkbox]').checked"
    fills = "[...document.querySelectorAll('svg circle')].map(c => c.getAttribute('fill'))"

    def pulled_to(share, time, holds):
        """Pixels of the two skins and colours of the maps' electrodes with the slider there."""
        window.until(
            lambda _: (
                window.click(f"{slider}.parentElement.parentElement", share)
                or (time in window.evaluate("document.body.innerText") and not window.evaluate(playing))
            )
        )
        left, right, gap = beside(window.until(lambda picture: holds(*beside(picture)[:2])))
        assert gap > 15 and left > 1500
        colors = window.evaluate(fills)
        assert len(colors) == 38  # the two maps
        return left, [sum(c == "rgb(204, 38, 25)" for c in part) for part in (colors[:19], colors[19:])]

    window.until(lambda _: window.evaluate(f"!!{slider}"))
    low, none = pulled_to(0.1, "t = 0.004 s", lambda left, right: right < 0.7 * left)
    same, red = pulled_to(0.998, "t = 0.044 s", lambda left, right: right > 0.8 * left)
    _, again = pulled_to(0.1, "t = 0.004 s", lambda left, right: right < 0.7 * left)
    assert none == again == [0, 0] and min(red) > 4
    assert abs(same / low - 1) < 0.1  # the left one does not swell


def test_a_model_is_shown_while_it_steps():
    import mujoco
    import spring_skin

    import biotac_mj

    spec = mujoco.MjSpec.from_string(
        '<mujoco><option timestep="0.01"/><worldbody><body mocap="true" pos="-.01 -.0175 0"><geom '
        'size=".01"/></body></worldbody></mujoco>'
    )
    handle = biotac_mj.attach(
        spec, body="world", skin=spring_skin.pad_geometry(), stepper="springs", readings="sum"
    )
    model = spec.compile()
    data, camera = mujoco.MjData(model), mujoco.MjvCamera()
    mujoco.mj_forward(model, data)
    camera.lookat[:], camera.distance, camera.azimuth, camera.elevation = (0.1, 0, 0.2), 0.5, 90, -30
    page = web_play.play_model(model, data, {"finger": handle}, camera, seconds=0.2, port=8933)
    try:
        first = page.server.initial_camera  # behind the place that it looks at, and above it
        assert np.allclose(first.look_at, camera.lookat)
        assert np.allclose(first.position, [0.1, -0.5 * np.cos(np.pi / 6), 0.45])
        assert first.fov == pytest.approx(np.radians(model.vis.global_.fovy))
        rows = page._gui["finger"][1][2].data
        assert len(rows[0]) == 5 and rows[0][0] == pytest.approx(0.01) and np.ptp(np.diff(rows[0])) < 1e-9
        assert rows[1][-1] > 0  # the ball pushes
    finally:
        page.close()


@pytest.mark.parametrize(
    "arguments, text",
    [
        (["play", "/no/such.h5"], "no recording at /no/such.h5: make one with `biotac press --out DIR`"),
        (["play", "notask"], "give a task: roll_rod, insert_peg, follow_edge"),
        (["play", __file__], "is no recording"),
        (
            ["play", "--hand", "/no/hand.xml"],
            "no hand at /no/hand.xml: give the MJCF of one, MuJoCo Menagerie's shadow_hand",
        ),
    ],
)
def test_bad_input_is_one_line(arguments, text, capsys):
    assert cli.main(arguments) == 2
    assert text in capsys.readouterr().err
