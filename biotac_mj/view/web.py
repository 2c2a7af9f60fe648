"""A page in the browser: deforming skins, electrodes coloured by their change, traces; live or from
recorded presses. Extra `web`."""

import dataclasses
import logging
import pathlib
import time as clock
from collections.abc import Callable

import mujoco
import numpy as np

from ..coupling.show import CORE, FULL_SCALE, OBJECT, PAD_UP, SKIN, electrode_colors
from ..geometry.skin_geometry import SkinGeometry
from ..reading import Array, read_hdf5
from ..sensor.channels import CHANNELS, ELECTRODES, NELECTRODE, check_counts, check_force
from .web_numbers import Numbers

__all__ = ["Field", "Finger", "FIELDS", "Moment", "Page", "play_file", "play_model"]

_PRESS = {
    "vert_xpos": Array(("n", "nvert", 3)),
    "outer_face": Array((None, 3), "index"),
    "time": Array(("n",)),
    "counts": Array(("n", len(CHANNELS))),
    "force": Array(("n", 3)),
    "indenter_pose": Array(("n", 7)),
    "indenter_vert": Array((None, 3)),
    "indenter_face": Array((None, 3), "index"),
}
_WINDOW = 200  # samples that a trace of a simulation shows
_FRAME = 0.04  # [s] between pictures
_APART = 0.033  # [m] between two recorded sensors
_MAP = 280, 190  # of the electrode map, along x and around the finger
_SCALE = 200  # width of its colours' scale, below
_FROM = np.array([-0.45, -0.65, 0.7])  # where the camera looks from: the tip's side, pad in sight
_SEEN_THROUGH, _COLOURED = 0.55, 0.85  # opacity of the skin
_BANDS = 8  # colours of a quantity on the skin


@dataclasses.dataclass(frozen=True)
class Field:
    """A quantity at the nodes that can be shown as the skin's colour.

    Attributes:
      unit, scale: shown is the value times scale in this unit.
      colors: name of a colour map of matplotlib. bare: whether its lowest band has the colour of the skin.
    """

    unit: str
    scale: float
    colors: str
    bare: bool

    def bands(self) -> np.ndarray:
        """(_BANDS, 3) RGB, of the least values first."""
        from matplotlib import colormaps

        colors = colormaps[self.colors](np.linspace(0, 1, _BANDS))[:, :3]
        if self.bare:
            colors[0] = SKIN
        return colors


FIELDS = {
    "contact pressure": Field("kPa", 1e-3, "YlOrRd", True),
    "film thickness": Field("mm", 1e3, "RdYlBu", False),  # red where it is thin, as the electrodes
}


@dataclasses.dataclass
class Finger:
    """What the page shows of one BioTac; its arrays are in the BioTac frame.

    Attributes:
      node: indices of the outer surface's nodes; face (m, 3): its triangles, indices into `node`.
      core_vert, core_face, electrode_pos (19, 3), electrode_normal (19, 3) [m]: of the geometry.
      rest: (19,) counts that changes are taken from.
      fields: names of FIELDS that its moments have.
      tool: (vert (n, 3) [m], face) of an indenter in its own frame, None without one.
      rows: (n, 22) time [s], 19 changes and PDC above rest [counts], force [N] of a whole recording; None
        where the page keeps what it has shown.
    """

    node: np.ndarray
    face: np.ndarray
    core_vert: np.ndarray
    core_face: np.ndarray
    electrode_pos: np.ndarray
    electrode_normal: np.ndarray
    rest: np.ndarray
    fields: tuple = ()
    tool: tuple | None = None
    rows: np.ndarray | None = None

    @classmethod
    def of(
        cls, geometry: SkinGeometry, rest: np.ndarray, face: np.ndarray | None = None, **more: object
    ) -> "Finger":
        """Of a SkinGeometry; face: of another skin around the same core. more: the other attributes."""
        node, face = np.unique(geometry.outer_face if face is None else face, return_inverse=True)
        solid = geometry.core_vert, geometry.core_face, geometry.electrode_pos, geometry.electrode_normal
        return cls(node, face.reshape(-1, 3), *solid, np.asarray(rest, float), **more)


@dataclasses.dataclass
class Moment:
    """One BioTac at one time.

    Attributes:
      vert: (nnode, 3) [m] of the outer nodes, in the BioTac frame.
      counts: (19,). pdc: above rest [counts]. force: [N].
      pos, quat: of the BioTac frame in the world [m].
      fields: {name of FIELDS: function without arguments that answers (nnode,) in SI units}.
      tool: (pos, quat) of the indenter in the BioTac frame.
    """

    vert: np.ndarray
    counts: np.ndarray
    pdc: float
    force: float
    pos: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(3))
    quat: np.ndarray = dataclasses.field(default_factory=lambda: np.array([1.0, 0, 0, 0]))
    fields: dict[str, Callable[[], np.ndarray]] = dataclasses.field(default_factory=dict)
    tool: tuple | None = None


class Page:
    """A viser server that shows fingers.

    Args:
      fingers: {name: Finger}.
      host, port: where it listens.

    Attributes:
      server: the ViserServer; url: of the page.
      field: the dropdown that chooses the skin's colour.

    Raises:
      ValueError: viser is not installed, or a port that is none; the text says what to do.
    """

    def __init__(self, fingers: dict[str, Finger], host: str = "127.0.0.1", port: int = 8080):
        try:
            import viser
        except ImportError as error:
            raise ValueError("the page in the browser needs viser: pip install 'biotac-mj[web]'") from error
        if not 0 < port < 65536:
            raise ValueError(f"port {port} is none: choose one from 1 to 65535")
        self.fingers = fingers
        # browsers open connections in advance and close them unused, which is no error of a user's
        logging.getLogger("websockets.server").setLevel(logging.CRITICAL)
        self.server = viser.ViserServer(host=host, port=port, verbose=False)
        self.url = f"http://{host}:{self.server.get_port()}"
        gui = self.server.gui
        gui.configure_theme(show_logo=False, show_share_button=False)
        self._title = gui.add_markdown("**BioTac**")
        offered = [name for name in FIELDS if any(name in finger.fields for finger in fingers.values())]
        self.field = gui.add_dropdown("colour", ("none", *offered), visible=bool(offered))
        self._legend = gui.add_html("")
        numbers = gui.add_checkbox("numbers", True)
        self._numbers = Numbers(
            self.server, {name: (f.electrode_pos, f.electrode_normal) for name, f in fingers.items()}
        )
        self._most = dict.fromkeys(FIELDS, 0.0)
        self._scene, self._gui, self._log = {}, {}, {}
        for i, (name, finger) in enumerate(fingers.items()):
            self._add_body(name, finger)
            self._add_panel(viser, name, len(fingers) < 3 or not i)
        self._aimed = False

        @numbers.on_update
        def _(_):
            self._numbers.wanted = numbers.value
            self._numbers.choose()

    def _add_body(self, name, finger):
        scene = self.server.scene
        frame = scene.add_frame(f"/{name}", show_axes=False)
        vert, face = np.zeros((len(finger.node), 3), np.float32), finger.face.astype(np.uint32)
        skin = [  # one mesh for each colour, as viser's have one; on the first, whole one lie the others
            scene.add_mesh_simple(f"/{name}/skin{i or ''}", vert, face, color=_rgb(SKIN), visible=not i)
            for i in range(_BANDS)
        ]
        core = finger.core_vert.astype(np.float32), finger.core_face.astype(np.uint32)
        scene.add_mesh_simple(f"/{name}/core", *core, color=_rgb(CORE))
        spheres = [
            scene.add_icosphere(f"/{name}/e{i}", radius=5e-4, color=(217, 217, 217), position=p)
            for i, p in enumerate(finger.electrode_pos, 1)
        ]
        tool = None
        if finger.tool is not None:
            vert, face = finger.tool
            tool = scene.add_mesh_simple(
                f"/{name}/tool",
                vert.astype(np.float32),
                face.astype(np.uint32),
                color=_rgb(OBJECT),
                opacity=0.6,
            )
        self._scene[name] = frame, skin, spheres, tool

    def _add_panel(self, viser, name, opened):
        gui, empty, colors = self.server.gui, np.zeros(2), _ring_colors()
        with gui.add_folder(name, expand_by_default=opened):
            picture = gui.add_html("")
            plots = [
                gui.add_uplot(
                    (empty,) * (1 + len(labels)),
                    (
                        viser.uplot.Series(label="t [s]"),
                        *(viser.uplot.Series(label=n, stroke=c, width=1) for n, c in zip(labels, colors)),
                    ),
                    title=title,
                    scales={"x": viser.uplot.Scale(time=False)},
                    # the widest number and its sign fit
                    axes=(viser.uplot.Axis(size=30), viser.uplot.Axis(size=60)),
                    legend=viser.uplot.Legend(show=False),
                    height=height,
                    padding=(10, 10, 0, 0),
                )
                for labels, title, height in (
                    (ELECTRODES, "electrodes: change [counts] over time [s]", 190),
                    (["PDC"], "PDC above rest [counts]", 110),
                    (["force"], "force [N]", 110),
                )
            ]
        self._gui[name] = picture, plots
        self._log[name] = []

    def _aim(self, state):
        """Points the camera at all fingers; once, as it is the user's afterwards."""
        from scipy.spatial.transform import Rotation

        place = np.concatenate(
            [Rotation.from_quat(m.quat, scalar_first=True).apply(m.vert) + m.pos for m in state.values()]
        )
        low, high = place.min(0), place.max(0)
        center = (low + high) / 2
        away = center + 1.15 * np.linalg.norm(high - low) * _FROM / np.linalg.norm(_FROM)
        up, first = (0.0, 0.0, 1.0), self.server.initial_camera
        first.look_at, first.position, first.up = center, away, up
        for client in self.server.get_clients().values():
            client.camera.up_direction, client.camera.position, client.camera.look_at = up, away, center
        self._aimed = True

    def update(self, time: float, state: dict[str, Moment]) -> None:
        """Shows a moment of all fingers; time: [s]."""
        if not self._aimed:
            self._aim(state)
        chosen = self.field.value
        values = {
            name: (m.fields[chosen]() if chosen in m.fields else np.zeros(len(m.vert)))[
                self.fingers[name].face
            ].mean(1)
            for name, m in state.items()
        }
        with self.server.atomic():
            self._title.content = f"**BioTac** t = {time:.3f} s"
            top = self._show_legend(chosen, max(v.max() for v in values.values()))
            for name, moment in state.items():
                frame, skin, spheres, tool = self._scene[name]
                frame.position, frame.wxyz = moment.pos, moment.quat
                self._numbers.move(name, moment.pos, moment.quat)
                self._paint(name, skin, moment.vert, values[name] / top, chosen)
                change = np.asarray(moment.counts, float) - self.fingers[name].rest
                for sphere, color in zip(spheres, electrode_colors(change)):
                    sphere.color = _rgb(color)
                if tool is not None:
                    tool.position, tool.wxyz = moment.tool
                picture, plots = self._gui[name]
                picture.content = electrode_map(self.fingers[name].electrode_pos, change)
                rows = self._rows(name, [time, *change, moment.pdc, moment.force]).T
                for plot, part in zip(plots, (slice(1, 20), slice(20, 21), slice(21, 22))):
                    plot.data = (rows[0], *rows[part])
        self._numbers.choose()
        self.server.flush()

    def _show_legend(self, chosen, most):
        """Writes what the skin's colours mean; the value at their top, which only grows, so that colours keep
        their meaning."""
        if chosen not in FIELDS:
            self._legend.content = ""
            return 1.0
        field = FIELDS[chosen]
        self._most[chosen] = top = max(self._most[chosen], _round_up(most * field.scale))
        boxes = "".join(f'<span style="flex:1;background:rgb{_rgb(c)}">&nbsp;</span>' for c in field.bands())
        ticks = "".join(f"<span>{share * top:g}</span>" for share in (0, 0.25, 0.5, 0.75, 1))
        bare = f"; green: below {top / _BANDS:g}" if field.bare else ""  # as the skin is
        row = '<div style="display:flex;justify-content:space-between">'
        self._legend.content = (
            f'<div style="font-size:12px;margin:0 1em">{chosen} [{field.unit}]{bare}'
            f"{row}{boxes}</div>{row}{ticks}</div></div>"
        )
        return top / field.scale

    def _paint(self, name, skin, vert, share, chosen):
        """Each triangle that is not in the lowest band is also in the mesh that has its colour.

        share: (nface,) of the scale."""
        face, vert = self.fingers[name].face, np.asarray(vert, np.float32)
        colors = FIELDS[chosen].bands() if chosen in FIELDS else [SKIN] * _BANDS
        band = np.clip((share * _BANDS).astype(int), 0, _BANDS - 1)
        for i, (mesh, color) in enumerate(zip(skin, colors)):
            own = face[band == i] if i else face
            mesh.visible = bool(len(own))
            if len(own):
                mesh.vertices, mesh.color = vert, _rgb(color)
                mesh.opacity = _SEEN_THROUGH if chosen == "none" else _COLOURED
            if i and len(own):
                mesh.faces = own.astype(np.uint32)

    def _rows(self, name, row):
        """(n, 22) what the traces show at the time of a row: a recording up to there, or what came before."""
        recorded = self.fingers[name].rows
        if recorded is not None:
            rows = recorded[: max(2, np.searchsorted(recorded[:, 0], row[0], "right"))]
            return rows if len(rows) > 1 else np.repeat(rows, 2, 0)
        log = self._log[name]
        log.append(row)
        del log[:-_WINDOW]
        return np.array(log if len(log) > 1 else log * 2)

    def close(self) -> None:
        """Stops the server."""
        self.server.stop()


def _rgb(color):
    return tuple(int(255 * c) for c in color[:3])


def _round_up(value):
    """The next of 1, 1.5, 2, 3, 5, 7.5 times a power of ten."""
    if not value > 0:
        return 1.0
    unit = 10.0 ** np.floor(np.log10(value))
    return float(next(m for m in (1, 1.5, 2, 3, 5, 7.5, 10) if m * unit >= value * (1 - 1e-9)) * unit)


def _ring_colors():
    """Of the traces of e1..e19, and of the rings around them on the map."""
    return [f"hsl({360 * i // NELECTRODE}, 70%, 45%)" for i in range(NELECTRODE)]


def electrode_map(position: np.ndarray, change: np.ndarray) -> str:
    """SVG of electrodes (n, 3) [m] at their place along (tip left) and around the finger, numbered, filled
    with their change (n,) [counts], in rings of the colours that their traces have; below, what the fill
    means."""
    width, height = _MAP
    x = 16 + (position[:, 0] + 0.0185) / 0.021 * (width - 32)
    y = (height - 16) / 2 + np.arctan2(position[:, 2], -position[:, 1]) / 2.0 * (height / 2 - 20)
    dots = []
    for i, (cx, cy, fill, ring) in enumerate(zip(x, y, electrode_colors(change), _ring_colors()), 1):
        ink = "#fff" if fill[:3] @ [0.3, 0.6, 0.1] < 0.5 else "#000"
        dots.append(
            f'<circle cx="{cx:.1f}" cy="{cy:.1f}" r="9" fill="rgb{_rgb(fill)}" stroke="{ring}" '
            f'stroke-width="2"/><text x="{cx:.1f}" y="{cy + 3.5:.1f}" fill="{ink}">{i}</text>'
        )
    share = (np.arange(_SCALE // 8) + 0.5) * 16 / _SCALE - 1
    scale = "".join(
        f'<rect x="{(width + s * _SCALE) / 2 - 4:g}" y="{height + 2}" width="8" height="9" '
        f'fill="rgb{_rgb(color)}"/>'
        for s, color in zip(share, electrode_colors(FULL_SCALE * share))
    )
    ticks = "".join(
        f'<text x="{width / 2 + s * _SCALE / 2:g}" y="{height + 22}">{s * FULL_SCALE:+g}</text>'
        for s in (-1, 1)
    )
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height + 26}" width="100%" '
        f'font-size="10" text-anchor="middle">{"".join(dots)}<text x="{width / 2}" y="{height - 4}">'
        "tip left; rings have the colours of the traces</text>"
        f'{scale}{ticks}<text x="{width / 2}" y="{height + 22}">change [counts]</text></svg>'
    )


def play_model(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    handles: dict,
    page: Page | None = None,
    seconds: float = np.inf,
    control: Callable | None = None,
    **server: object,
) -> Page:
    """Steps a model and shows its BioTacs 25 times a second of its time; returns the page.

    Args:
      handles: {name: Handle}.
      page: one to go on with.
      seconds: how long [s of the model].
      control: f(data), called before each step.
    """
    from .. import plugin
    from ..geometry import load_skin
    from .web_scene import Scene

    skins = {name: load_skin(h.config.skin) for name, h in handles.items()}
    films = {name: _under(skin) for name, skin in skins.items()}
    mujoco.mj_forward(model, data)
    if page is None:
        fingers = {}
        for name, h in handles.items():
            known = h.contact_pressure(model, data) is not None  # so is a film, under a skin of ours
            fingers[name] = Finger.of(skins[name], h.numbers.rest, fields=tuple(FIELDS) if known else ())
        page = _served(fingers, **server)
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

    shown = -np.inf
    while data.time < seconds:
        begin = clock.perf_counter()
        if control is not None:
            control(data)
        mujoco.mj_step(model, data)
        plugin.check()
        if data.time - shown > _FRAME - 1e-9:
            shown = data.time
            scene.update(data)
            page.update(shown, {name: moment(name, h) for name, h in handles.items()})
        clock.sleep(max(0.0, model.opt.timestep - (clock.perf_counter() - begin)))
    return page


def _served(fingers, **server):
    """A Page, whose address is said: its port is another where the wanted one is taken."""
    page = Page(fingers, **server)
    print(f"  the page is at {page.url} until Ctrl-C", flush=True)
    return page


def _under(geometry):
    """f(vert (nvert, 3), node) -> thickness (nnode,) [m] of the film under nodes of the outer surface: at the
    node of the inner one that is nearest at rest."""
    film, near = [], []

    def thickness(vert, node):
        if not film:  # made when first asked for
            from scipy.spatial import cKDTree

            from ..sensor.film import FilmConduction

            film.append(FilmConduction(geometry))
            near.append(cKDTree(geometry.vert[film[0].node]).query(geometry.vert[node])[1])
        return film[0].film(vert)[1][near[0]]

    return thickness


def play_file(
    *paths: pathlib.Path | str,
    page: Page | None = None,
    speed: float = 1.0,
    rounds: float = np.inf,
    **server: object,
) -> Page:
    """Shows recorded presses (skin.h5 of `biotac press`) beside each other again and again; returns the page,
    whose slider goes to any time.

    Raises:
      FileNotFoundError: no such file.
      ValueError: it is no recorded press.
    """
    presses = {}
    for path in paths:
        name = pathlib.Path(path).resolve().parent.name or "biotac"
        presses[name if name not in presses else f"{name} {len(presses) + 1}"] = _Press(path)
    for i, one in enumerate(presses.values()):
        one.pos[0] = _APART * i
    if page is None:
        page = _served({name: one.finger for name, one in presses.items()}, **server)
    times = np.unique(np.concatenate([one.time for one in presses.values()]))
    gui = page.server.gui
    playing = gui.add_checkbox("play", True, order=0.5)
    slider = gui.add_slider("time [s]", 0.0, float(times[-1]), 1e-3, 0.0, order=0.6)

    @slider.on_update
    def _(event):
        if event.client is not None:  # a hand on it, not the film
            playing.value = False

    at, done, was_playing = 0, 0, True
    while done < rounds:
        if playing.value:
            slider.value = round(float(times[at]), 3)
        else:
            at = int(np.abs(times - slider.value).argmin())
            if was_playing:
                # a browser may get the film's last place after the hand's: told once more where it is; what
                # is already so would not be sent
                now, slider.value = slider.value, float(times[-1])
                slider.value = 0.0
                slider.value = now
        was_playing = playing.value
        page.update(float(times[at]), {name: one.moment(times[at]) for name, one in presses.items()})
        if not playing.value:
            clock.sleep(_FRAME)
        elif at + 1 < len(times):
            # no more pictures than are seen: each is sent to every browser
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
        check_counts(counts[:, :NELECTRODE], str(path))
        check_force(force, str(path))
        self.vert, self.counts, self.pos = vert, counts, np.zeros(3)
        self.pressure = found.get("contact_pressure")
        fields = [] if self.pressure is None else ["contact pressure"]
        try:
            geometry = load_skin(str(said["skin"]))
        except (ValueError, FileNotFoundError):
            geometry = load_skin(
                "default"
            )  # of another skin only core and electrodes are lent: all share them
        if geometry.nvert == vert.shape[1]:
            self._film = _under(geometry)
            fields.append("film thickness")
        change = counts[:, : NELECTRODE + 1] - counts[0, : NELECTRODE + 1]
        self.rows = np.column_stack([self.time, change, np.linalg.norm(force, axis=1)])
        more = dict(fields=tuple(fields), tool=tool, rows=self.rows)
        self.finger = Finger.of(geometry, counts[0, :NELECTRODE], face, **more)

    def moment(self, time):
        """What is shown at a time [s]: the step before it."""
        i = max(0, int(np.searchsorted(self.time, time, "right")) - 1)
        node, pose = self.finger.node, self.pose[i]
        fields = {"film thickness": lambda: self._film(self.vert[i], node)}
        if self.pressure is not None:
            fields["contact pressure"] = lambda: self.pressure[i][node]
        return Moment(
            self.vert[i][node],
            self.counts[i, :NELECTRODE],
            *self.rows[i, -2:],
            self.pos,
            PAD_UP,
            fields={name: fields[name] for name in self.finger.fields},
            tool=(pose[:3], pose[3:]),
        )
