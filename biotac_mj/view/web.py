"""A page in the browser: deforming skins, electrodes coloured by their change, traces. Extra `web`."""

import dataclasses
import logging
from collections.abc import Callable

import mujoco
import numpy as np

from ..coupling.show import CORE, OBJECT, SKIN
from ..fields import as_whole
from ..geometry.skin_geometry import SkinGeometry
from ..sensor.colors import FULL_CHANGE, electrode_colors
from .offscreen import directions

_WINDOW = 200  # samples in a trace of a simulation
_MAP = 280, 190  # size of the electrode map, along x and around the finger
_SCALE = 200  # width of the colour scale below
_FROM = np.array([-0.45, -0.65, 0.7])  # direction of the camera: from the tip's side, with the pad in sight
_SEEN_THROUGH, _COLOURED = 0.55, 0.85  # opacity of the skin
_BANDS = 8  # colours of a quantity on the skin
_LETTERS, _ABOVE = 1e-3, 3e-3  # height of the electrodes' numbers, and above the core, on the skin [m]


@dataclasses.dataclass(frozen=True)
class Field:
    """A quantity at the nodes that can be shown as the colour of the skin.

    Attributes:
      unit, scale: the value times scale is shown in this unit.
      colors: name of a matplotlib colour map. bare: whether its lowest band has the colour of the skin.
    """

    unit: str
    scale: float
    colors: str
    bare: bool

    def bands(self) -> np.ndarray:
        """RGB colours (_BANDS, 3), for the lowest values first."""
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
    """Constants of one BioTac on the page, in the BioTac frame.

    Attributes:
      node: indices of the outer surface's nodes; face (m, 3): its triangles, indices into `node`.
      core_vert, core_face, electrode_pos (nelectrode, 3), electrode_normal (nelectrode, 3) [m]: of the
      geometry.
      rest: (nelectrode,) reference counts of changes.
      fields: names of FIELDS that its moments have.
      tool: (vert (n, 3) [m], face) of an indenter in its own frame, or None.
      rows: (n, nelectrode + 3) time [s], changes and PDC above rest [counts], force [N] of a whole
        recording; None: the page collects them.
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
        """Makes a Finger of a SkinGeometry. face: of another skin around the same core. more: the other
        attributes."""
        node, face = np.unique(geometry.outer_face if face is None else face, return_inverse=True)
        solid = geometry.core_vert, geometry.core_face, geometry.electrode_pos, geometry.electrode_normal
        return cls(node, face.reshape(-1, 3), *solid, np.asarray(rest, float), **more)


@dataclasses.dataclass
class Moment:
    """State of one BioTac at one time.

    Attributes:
      vert: (nnode, 3) outer nodes in the BioTac frame [m].
      counts: (nelectrode,). pdc: above rest [counts]. force: [N].
      pos, quat: of the BioTac frame in the world [m].
      fields: {name of FIELDS: function without arguments that returns (nnode,) in SI units}.
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
      host, port: of the server.

    Attributes:
      server: the ViserServer; url: of the page.
      field: the dropdown that chooses the skin's colour.

    Raises:
      ValueError: viser is not installed, or an invalid port; the message gives the remedy.
    """

    def __init__(self, fingers: dict[str, Finger], host: str = "127.0.0.1", port: int = 8080):
        try:
            import viser
        except ImportError as error:
            raise ValueError("the page in the browser needs viser: pip install 'biotac-mj[web]'") from error
        as_whole("port", port, 1, 65535)
        self.fingers = fingers
        # browsers open connections in advance and close them unused, which is not an error
        logging.getLogger("websockets.server").setLevel(logging.CRITICAL)
        self.server = viser.ViserServer(host=host, port=port, verbose=False)
        self.url = f"http://{host}:{self.server.get_port()}"
        gui = self.server.gui
        gui.configure_theme(show_logo=False, show_share_button=False)
        self._title = gui.add_markdown("**BioTac**")
        offered = [name for name in FIELDS if any(name in finger.fields for finger in fingers.values())]
        self.field = gui.add_dropdown(
            "colour", ("none", *offered), initial_value=(*offered, "none")[0], visible=bool(offered)
        )
        self._legend = gui.add_html("")
        numbers = gui.add_checkbox("numbers", True)
        self._numbers = []
        self._most = dict.fromkeys(FIELDS, 0.0)
        self._scene, self._gui, self._log = {}, {}, {}
        for i, (name, finger) in enumerate(fingers.items()):
            self._add_body(name, finger)
            self._add_panel(viser, name, finger, len(fingers) < 3 or not i)
        self._aimed = False

        @numbers.on_update
        def _(_):
            for label in self._numbers:
                label.visible = numbers.value

    def _add_body(self, name, finger):
        scene = self.server.scene
        frame = scene.add_frame(f"/{name}", show_axes=False)
        vert, face = np.zeros((len(finger.node), 3), np.float32), finger.face.astype(np.uint32)
        # a viser mesh has one colour: the first mesh is complete, and one for each colour covers parts of it
        skin = [
            scene.add_mesh_simple(f"/{name}/skin{i or ''}", vert, face, color=_rgb(SKIN), visible=not i)
            for i in range(_BANDS)
        ]
        core = finger.core_vert.astype(np.float32), finger.core_face.astype(np.uint32)
        scene.add_mesh_simple(f"/{name}/core", *core, color=_rgb(CORE))
        spheres = [
            scene.add_icosphere(f"/{name}/e{i}", radius=5e-4, color=(217, 217, 217), position=p)
            for i, p in enumerate(finger.electrode_pos, 1)
        ]
        look = dict(font_size_mode="scene", font_scene_height=_LETTERS, anchor="center-center")
        self._numbers += [  # the skin covers those behind it
            scene.add_label(f"/{name}/n{i}", str(i), position=p, depth_test=True, **look)
            for i, p in enumerate(finger.electrode_pos + _ABOVE * finger.electrode_normal, 1)
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

    def _add_panel(self, viser, name, finger, opened):
        gui, empty, n = self.server.gui, np.zeros(2), len(finger.electrode_pos)
        colors = _ring_colors(n)
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
                    ([f"e{i + 1}" for i in range(n)], "electrodes: change [counts] over time [s]", 190),
                    (["PDC"], "PDC above rest [counts]", 110),
                    (["force"], "force [N]", 110),
                )
            ]
        self._gui[name] = picture, plots
        self._log[name] = []

    def _point_at_fingers(self, state):
        """Points the camera at all fingers, once."""
        from scipy.spatial.transform import Rotation

        place = np.concatenate(
            [Rotation.from_quat(m.quat, scalar_first=True).apply(m.vert) + m.pos for m in state.values()]
        )
        low, high = place.min(0), place.max(0)
        center = (low + high) / 2
        away = 1.15 * np.linalg.norm(high - low) * _FROM / np.linalg.norm(_FROM)
        self._look(center, center + away, self.server.initial_camera.fov)

    def point_camera(self, camera: mujoco.MjvCamera, fovy: float) -> None:
        """Shows what a free camera of MuJoCo shows, with `fovy` [deg]; afterwards the user moves it."""
        place = camera.lookat - camera.distance * directions(camera)[0]
        self._look(camera.lookat.copy(), place, np.radians(fovy))

    def _look(self, center, place, fov):
        up, first = (0.0, 0.0, 1.0), self.server.initial_camera
        first.look_at, first.position, first.up, first.fov = center, place, up, fov
        for client in self.server.get_clients().values():
            client.camera.fov, client.camera.up_direction = fov, up
            client.camera.position, client.camera.look_at = place, center
        self._aimed = True

    def update(self, time: float, state: dict[str, Moment]) -> None:
        """Shows a moment of all fingers; time: [s]."""
        if not self._aimed:
            self._point_at_fingers(state)
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
                self._paint(name, skin, moment.vert, values[name] / top, chosen)
                change = np.asarray(moment.counts, float) - self.fingers[name].rest
                for sphere, color in zip(spheres, electrode_colors(change)):
                    sphere.color = _rgb(color)
                if tool is not None:
                    tool.position, tool.wxyz = moment.tool
                picture, plots = self._gui[name]
                picture.content = electrode_map(self.fingers[name].electrode_pos, change)
                rows = self._rows(name, [time, *change, moment.pdc, moment.force]).T
                for plot, part in zip(plots, (slice(1, -2), slice(-2, -1), slice(-1, None))):
                    plot.data = (rows[0], *rows[part])
        self.server.flush()

    def _show_legend(self, chosen, most):
        """Writes the legend of the skin's colours. Their largest value only grows, so that colours keep their
        meaning."""
        if chosen not in FIELDS:
            self._legend.content = ""
            return 1.0
        field = FIELDS[chosen]
        self._most[chosen] = top = max(self._most[chosen], _round_up(most * field.scale))
        boxes = "".join(f'<span style="flex:1;background:rgb{_rgb(c)}">&nbsp;</span>' for c in field.bands())
        ticks = "".join(f"<span>{value * top:g}</span>" for value in (0, 0.25, 0.5, 0.75, 1))
        bare = f"; green: below {top / _BANDS:g}" if field.bare else ""  # the colour of the skin
        row = '<div style="display:flex;justify-content:space-between">'
        self._legend.content = (
            f'<div style="font-size:12px;margin:0 1em">{chosen} [{field.unit}]{bare}'
            f"{row}{boxes}</div>{row}{ticks}</div></div>"
        )
        return top / field.scale

    def _paint(self, name, skin, vert, value, chosen):
        """Adds each triangle that is not in the lowest band to the mesh of its colour.

        value: (nface,) of the scale."""
        face, vert = self.fingers[name].face, np.asarray(vert, np.float32)
        colors = FIELDS[chosen].bands() if chosen in FIELDS else [SKIN] * _BANDS
        band = np.clip((value * _BANDS).astype(int), 0, _BANDS - 1)
        for i, (mesh, color) in enumerate(zip(skin, colors)):
            own = face[band == i] if i else face
            mesh.visible = bool(len(own))
            if len(own):
                mesh.vertices, mesh.color = vert, _rgb(color)
                mesh.opacity = _SEEN_THROUGH if chosen == "none" else _COLOURED
            if i and len(own):
                mesh.faces = own.astype(np.uint32)

    def _rows(self, name, row):
        """Rows (n, 22) of the traces at the time of a row: the recording, or collected rows, up to it."""
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
    """Rounds up to 1, 1.5, 2, 3, 5 or 7.5 times a power of ten."""
    if not value > 0:
        return 1.0
    unit = 10.0 ** np.floor(np.log10(value))
    return float(next(m for m in (1, 1.5, 2, 3, 5, 7.5, 10) if m * unit >= value * (1 - 1e-9)) * unit)


def _ring_colors(n):
    """Colours of the traces of n electrodes, and of the rings around them on the map."""
    return [f"hsl({360 * i // n}, 70%, 45%)" for i in range(n)]


def electrode_map(position: np.ndarray, change: np.ndarray) -> str:
    """SVG map of electrodes (n, 3) [m] along (tip left) and around the finger (E1..E6 below), with numbers,
    filled by their change (n,) [counts], in rings of the colours of their traces, and a colour scale
    below."""
    width, height = _MAP
    x = 16 + (position[:, 0] + 0.0185) / 0.021 * (width - 32)
    y = (height - 16) / 2 - np.arctan2(position[:, 2], -position[:, 1]) / 2.0 * (height / 2 - 20)
    dots = []
    for i, (cx, cy, fill, ring) in enumerate(zip(x, y, electrode_colors(change), _ring_colors(len(x))), 1):
        ink = "#fff" if fill[:3] @ [0.3, 0.6, 0.1] < 0.5 else "#000"
        dots.append(
            f'<circle cx="{cx:.1f}" cy="{cy:.1f}" r="9" fill="rgb{_rgb(fill)}" stroke="{ring}" '
            f'stroke-width="2"/><text x="{cx:.1f}" y="{cy + 3.5:.1f}" fill="{ink}">{i}</text>'
        )
    value = (np.arange(_SCALE // 8) + 0.5) * 16 / _SCALE - 1
    scale = "".join(
        f'<rect x="{(width + s * _SCALE) / 2 - 4:g}" y="{height + 2}" width="8" height="9" '
        f'fill="rgb{_rgb(color)}"/>'
        for s, color in zip(value, electrode_colors(FULL_CHANGE * value))
    )
    ticks = "".join(
        f'<text x="{width / 2 + s * _SCALE / 2:g}" y="{height + 22}">{s * FULL_CHANGE:+g}</text>'
        for s in (-1, 1)
    )
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height + 26}" width="100%" '
        f'font-size="10" text-anchor="middle">{"".join(dots)}<text x="{width / 2}" y="{height - 4}">'
        "tip left; rings have the colours of the traces</text>"
        f'{scale}{ticks}<text x="{width / 2}" y="{height + 22}">change [counts]</text></svg>'
    )
