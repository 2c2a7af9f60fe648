"""Shows a running simulation or recorded presses on the page in the browser."""

import pathlib
import tempfile
import time as clock
import warnings

import mujoco
import numpy as np

from ..coupling.show import PAD_UP
from ..geometry.design import SINGLES
from ..geometry.skins import place_of, skin_reference
from ..press import PressOptions, press
from ..press.record import write_skin
from ..reading import Array, read_hdf5
from ..sensor.channels import check_counts, check_force
from .web import FIELDS, Finger, Moment, Page

_PRESS = {
    "vert_xpos": Array(("n", "nvert", 3)),
    "outer_face": Array((None, 3), "index"),
    "time": Array(("n",)),
    "counts": Array(("n", "nchannel")),
    "force": Array(("n", 3)),
    "indenter_pose": Array(("n", 7)),
    "indenter_vert": Array((None, 3)),
    "indenter_face": Array((None, 3), "index"),
}
_FRAME = 0.04  # [s] between pictures
_SPACING = 0.033  # [m] between two recorded sensors


def play_model(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    handles: dict,
    camera: mujoco.MjvCamera,
    seconds: float = np.inf,
    **server: object,
) -> Page:
    """Steps a model and shows its BioTacs at 25 Hz of model time; returns the page.

    Args:
      data: after mj_forward. handles: {name: Handle}. camera: from where the page looks at first.
      seconds: duration [s of the model].
    """
    from .. import plugin
    from ..geometry import load_skin
    from .web_scene import Scene

    skins = {name: load_skin(h.config.skin) for name, h in handles.items()}
    films = {name: _under(skin) for name, skin in skins.items()}
    fingers = {}
    for name, h in handles.items():
        known = h.contact_pressure(model, data) is not None  # so is a film, under a skin of ours
        fingers[name] = Finger.of(skins[name], h.numbers.rest, fields=tuple(FIELDS) if known else ())
    page = _served(fingers, **server)
    page.point_camera(camera, model.vis.global_.fovy)
    scene = Scene(page.server, model, [h.body for h in handles.values()])
    rest = {name: float(h.read(data, "pdc")[0]) for name, h in handles.items()}

    def moment(name, handle):
        body, vert, node = data.body(handle.body), handle.vert_xpos(model, data), page.fingers[name].node
        return Moment(
            vert[node],
            handle.read(data, "electrodes"),
            float(handle.read(data, "pdc")[0]) - rest[name],
            float(np.linalg.norm(handle.read(data, "contact_force")[:3])),
            body.xpos.copy(),
            body.xquat.copy(),
            {
                "contact pressure": lambda: handle.contact_pressure(model, data)[node],
                "film thickness": lambda: films[name](vert, node),
            },
        )

    drawn_at = -np.inf
    while data.time < seconds:
        begin = clock.perf_counter()
        mujoco.mj_step(model, data)
        plugin.check()
        if data.time - drawn_at > _FRAME - 1e-9:
            drawn_at = data.time
            scene.update(data)
            page.update(drawn_at, {name: moment(name, h) for name, h in handles.items()})
        clock.sleep(max(0.0, model.opt.timestep - (clock.perf_counter() - begin)))
    return page


def _served(fingers, **server):
    """Makes a Page and prints its address, whose port differs if the wanted one is in use."""
    page = Page(fingers, **server)
    print(f"  the page is at {page.url} until Ctrl-C", flush=True)
    return page


def _under(geometry):
    """Function (vert (nvert, 3), node) -> thickness (nnode,) [m] of the film under nodes of the outer
    surface, at the nearest inner node of the undeformed skin."""
    film, nearest = [], []

    def thickness(vert, node):
        if not film:  # made at the first call
            from scipy.spatial import cKDTree

            from ..sensor.film import FilmConduction

            film.append(FilmConduction(geometry))
            nearest.append(cKDTree(geometry.vert[film[0].node]).query(geometry.vert[node])[1])
        return film[0].film(vert)[1][nearest[0]]

    return thickness


def play_file(
    *paths: pathlib.Path | str,
    page: Page | None = None,
    speed: float = 1.0,
    rounds: float = np.inf,
    **server: object,
) -> Page:
    """Shows recorded presses (skin.h5 of `biotac press`) side by side in a loop; returns the page, whose
    slider goes to any time.

    Raises:
      FileNotFoundError: no such file.
      ValueError: it is no recorded press.
    """
    presses = {}
    for path in paths:
        name = pathlib.Path(path).resolve().parent.name or "biotac"
        presses[name if name not in presses else f"{name} {len(presses) + 1}"] = _Press(path)
    for i, one in enumerate(presses.values()):
        one.pos[0] = _SPACING * i
    if page is None:
        page = _served({name: one.finger for name, one in presses.items()}, **server)
    return _play(presses, page, speed, rounds)


def play_press(
    settings: dict, page: Page | None = None, rounds: float = np.inf, speed: float = 0.1, **server: object
) -> Page:
    """Shows a press in slow motion, in a loop. Sliders set depth and location; moving one starts a new
    press. Returns the page.

    Args:
      settings: of the press except depth and location, as for `PressOptions`.
    """
    with tempfile.TemporaryDirectory() as folder:
        geometry = skin_reference(settings.get("skin", "default"))[1]
        along, ends = 1e3 * place_of(geometry)[0], 1e3 * geometry.vert[geometry.outer_face][..., 0]
        low, high = np.ceil(max(ends.min() + 1, along - 10)), np.floor(min(ends.max() - 1, along + 10))
        wanted = {"depth [mm]": 1.5, "along [mm]": along, "around [deg]": 0.0}

        def pressed():
            place = 1e-3 * wanted["along [mm]"], np.radians(wanted["around [deg]"])
            options = PressOptions(location=place, depth=1e-3 * wanted["depth [mm]"], **settings)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # the page shows a press on the core
                record = press(options, progress=False).record
            file = pathlib.Path(folder) / "skin.h5"
            write_skin(record, file)
            return _Press(file)

        presses = {"press": pressed()}
        page = page or _served({"press": presses["press"].finger}, **server)
        made = dict(wanted)
        for name, least, most, step in (
            ("depth [mm]", 0.1, 2.4, 0.1),
            ("along [mm]", low, high, 0.5),
            ("around [deg]", -60.0, 60.0, 5.0),
        ):
            slider = page.server.gui.add_slider(name, least, most, step, wanted[name], order=0.4)
            slider.on_update(lambda event, name=name: wanted.update({name: event.target.value}))

        def again():
            if made == wanted:
                return False
            made.update(wanted)
            one = pressed()
            page.fingers["press"].rows = one.rows
            presses["press"] = one
            return True

        return _play(presses, page, speed, rounds, again)


def _play(presses, page, speed, rounds, again=lambda: False):
    """Shows the presses on a page; again(): whether they have changed."""
    times = np.unique(np.concatenate([one.time for one in presses.values()]))
    gui = page.server.gui
    playing = gui.add_checkbox("play", True, order=0.5)
    slider = gui.add_slider("time [s]", 0.0, float(times[-1]), 1e-3, 0.0, order=0.6)

    @slider.on_update
    def _(event):
        if event.client is not None:  # moved by the user, not by the film
            playing.value = False

    at, done, was_playing = 0, 0, True
    while done < rounds:
        if again():
            times = np.unique(np.concatenate([one.time for one in presses.values()]))
            slider.max, at = float(times[-1]), 0
        if playing.value:
            slider.value = round(float(times[at]), 3)
        else:
            at = int(np.abs(times - slider.value).argmin())
            if was_playing:
                # a browser may get the film's last position after the user's, so the position is sent again;
                # an unchanged value would not be sent
                now, slider.value = slider.value, float(times[-1])
                slider.value = 0.0
                slider.value = now
        was_playing = playing.value
        page.update(float(times[at]), {name: one.moment(times[at]) for name, one in presses.items()})
        if not playing.value:
            clock.sleep(_FRAME)
        elif at + 1 < len(times):
            # a limited picture rate, since each picture is sent to every browser
            coming = max(at + 1, int(np.searchsorted(times, times[at] + speed * _FRAME)))
            coming = min(coming, len(times) - 1)
            clock.sleep(float(times[coming] - times[at]) / speed)
            at = coming
        else:
            at, done = 0, done + 1
    return page


class _Press:
    """A file of a press, checked, and its finger."""

    def __init__(self, path):
        from ..geometry import load_skin

        remedy = "make one with `biotac press --out DIR` and give DIR/skin.h5"
        also = {"contact_pressure": Array(("n", "nvert"))}
        found, said = read_hdf5(path, "recording", remedy, _PRESS, ["skin"], also)
        vert, face, self.time, counts, force, self.pose, *tool = (found[name] for name in _PRESS)
        if not len(self.time) or not face.size or not (np.diff(self.time) > 0).all():
            raise ValueError(f"{path} has no steps, no faces, or times that run back: {remedy}")
        for triangles, points in ((face, vert[0]), (tool[1], tool[0])):
            if triangles.size and triangles.max() >= len(points):
                raise ValueError(f"{path} has faces of missing nodes: {remedy}")
        n = self._n = counts.shape[1] - len(SINGLES)
        check_counts(counts[:, :n], str(path))
        check_force(force, str(path))
        self.vert, self.counts, self.pos = vert, counts, np.zeros(3)
        self.pressure = found.get("contact_pressure")
        fields = [] if self.pressure is None else ["contact pressure"]
        try:
            geometry = load_skin(str(said["skin"]))
        except (ValueError, FileNotFoundError):
            geometry = load_skin(
                "default"
            )  # core and electrodes are those of the shipped skin, which all skins share
        if geometry.nvert == vert.shape[1]:
            self._film = _under(geometry)
            fields.append("film thickness")
        change = counts[:, : n + 1] - counts[0, : n + 1]
        self.rows = np.column_stack([self.time, change, np.linalg.norm(force, axis=1)])
        more = dict(fields=tuple(fields), tool=tool, rows=self.rows)
        self.finger = Finger.of(geometry, counts[0, :n], face, **more)

    def moment(self, time):
        """The moment at a time [s]: the last step before it."""
        i = max(0, int(np.searchsorted(self.time, time, "right")) - 1)
        node, pose = self.finger.node, self.pose[i]
        fields = {"film thickness": lambda: self._film(self.vert[i], node)}
        if self.pressure is not None:
            fields["contact pressure"] = lambda: self.pressure[i][node]
        return Moment(
            self.vert[i][node],
            self.counts[i, : self._n],
            *self.rows[i, -2:],
            self.pos,
            PAD_UP,
            fields={name: fields[name] for name in self.finger.fields},
            tool=(pose[:3], pose[3:]),
        )
