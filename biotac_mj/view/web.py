"""A page in the browser: deforming skins, electrodes coloured by their change, traces; live or from a
recorded press. Extra `web`."""

import dataclasses
import pathlib
import time as clock
from collections.abc import Callable

import mujoco
import numpy as np

from ..coupling.show import electrode_colors
from ..geometry.skin_geometry import SkinGeometry
from ..reading import Array, read_hdf5
from ..sensor.channels import CHANNELS, NELECTRODE, check_counts, check_force

__all__ = ["Finger", "Page", "play_file", "play_model"]

_PRESS = {
    "vert_xpos": Array(("n", "nvert", 3)),
    "outer_face": Array((None, 3), "index"),
    "time": Array(("n",)),
    "counts": Array(("n", len(CHANNELS))),
    "force": Array(("n", 3)),
}
_WINDOW = 200  # samples that a trace shows
_MAP = (150, 220)  # of the electrode map, (angle, x) [pixel]
_FROM = np.array([-0.55, -0.75, 0.35])  # where the camera looks from: the tip's side, pad in sight


@dataclasses.dataclass
class Finger:
    """What the page shows of one BioTac; the arrays of `state` are in its frame.

    Attributes:
      node: indices of the outer surface's nodes; face (m, 3): its triangles, indices into `node`.
      core_vert, core_face, electrode_pos (19, 3) [m]: of the geometry.
      rest: (19,) counts that changes are taken from.
    """

    node: np.ndarray
    face: np.ndarray
    core_vert: np.ndarray
    core_face: np.ndarray
    electrode_pos: np.ndarray
    rest: np.ndarray

    @classmethod
    def of(cls, geometry: SkinGeometry, rest: np.ndarray) -> "Finger":
        """Of a SkinGeometry."""
        node, face = np.unique(geometry.outer_face, return_inverse=True)
        face = face.reshape(-1, 3)
        return cls(
            node,
            face,
            geometry.core_vert,
            geometry.core_face,
            geometry.electrode_pos,
            np.asarray(rest, float),
        )


class Page:
    """A viser server that shows fingers.

    Args:
      fingers: {name: Finger}.
      host, port: where it listens.

    Attributes:
      server: the ViserServer; url: of the page.

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
        self.server = viser.ViserServer(host=host, port=port, verbose=False)
        self.url = f"http://{host}:{self.server.get_port()}"
        self._title = self.server.gui.add_markdown("**BioTac**")
        self._scene, self._gui, self._log = {}, {}, {}
        for name, finger in fingers.items():
            self._add(viser, name, finger)
        self._aimed = False

    def _add(self, viser, name, finger):
        scene, gui = self.server.scene, self.server.gui
        frame = scene.add_frame(f"/{name}", show_axes=False)
        vert = np.zeros((len(finger.node), 3), np.float32)
        skin = scene.add_mesh_simple(
            f"/{name}/skin", vert, finger.face.astype(np.uint32), color=(80, 175, 120), opacity=0.55
        )
        scene.add_mesh_simple(
            f"/{name}/core",
            finger.core_vert.astype(np.float32),
            finger.core_face.astype(np.uint32),
            color=(60, 60, 68),
        )
        spheres = [
            scene.add_icosphere(f"/{name}/e{i}", radius=5e-4, color=(217, 217, 217), position=p)
            for i, p in enumerate(finger.electrode_pos, 1)
        ]
        self._scene[name] = frame, skin, spheres
        with gui.add_folder(name):
            picture = gui.add_image(np.zeros((*_MAP, 3), np.uint8), label="electrodes (tip left)")
            empty = np.zeros(2)
            look = {"scales": {"x": viser.uplot.Scale(time=False)}, "aspect": 2.0}
            names = [f"e{i}" for i in range(1, 20)]
            traces = gui.add_uplot(
                (empty, *[empty] * 19), _series(viser, names), title="change [counts]", **look
            )
            force = gui.add_uplot(
                (empty, empty, empty),
                _series(viser, ["force [N]", "PDC/100"]),
                title="force and pressure",
                **look,
            )
        self._gui[name] = picture, traces, force
        self._log[name] = []

    def _aim(self, state):
        """Points the camera at all fingers; once, as it is the user's afterwards."""
        from scipy.spatial.transform import Rotation

        place = np.concatenate(
            [
                Rotation.from_quat(quat, scalar_first=True).apply(vert) + pos
                for vert, _, _, _, pos, quat in state.values()
            ]
        )
        low, high = place.min(0), place.max(0)
        center = (low + high) / 2
        away = center + 1.15 * np.linalg.norm(high - low) * _FROM / np.linalg.norm(_FROM)
        (
            self.server.initial_camera.look_at,
            self.server.initial_camera.position,
            self.server.initial_camera.up,
        ) = (
            center,
            away,
            (0.0, 0.0, 1.0),
        )
        for client in self.server.get_clients().values():
            client.camera.up_direction, client.camera.position, client.camera.look_at = (
                (0.0, 0.0, 1.0),
                away,
                center,
            )
        self._aimed = True

    def update(self, time: float, state: dict) -> None:
        """Shows a moment.

        Args:
          time: [s].
          state: {name: (vert (nnode, 3) [m] of the outer nodes, counts (19,), pdc above rest, force [N], pos
            (3,), quat (4,))}.
        """
        if not self._aimed:
            self._aim(state)
        with self.server.atomic():
            self._title.content = f"**BioTac** t = {time:.3f} s"
            for name, (vert, counts, pdc, force, pos, quat) in state.items():
                frame, skin, spheres = self._scene[name]
                frame.position, frame.wxyz = pos, quat
                skin.vertices = np.asarray(vert, np.float32)
                change = np.asarray(counts, float) - self.fingers[name].rest
                for sphere, color in zip(spheres, electrode_colors(change)):
                    sphere.color = tuple(int(255 * c) for c in color[:3])
                log = self._log[name]
                log.append([time, *change, force, pdc / 100])
                del log[:-_WINDOW]
                rows = np.array(log if len(log) > 1 else log * 2).T
                picture, traces, plot = self._gui[name]
                picture.image = electrode_map(self.fingers[name].electrode_pos, change)
                traces.data = tuple(rows[:20])
                plot.data = (rows[0], rows[20], rows[21])
        self.server.flush()

    def close(self) -> None:
        """Stops the server."""
        self.server.stop()


def electrode_map(position, change):
    """(height, width, 3) uint8: electrodes at their place along (tip left) and around the finger, coloured by
    their change [counts]."""
    height, width = _MAP
    x = 12 + (position[:, 0] + 0.0185) / 0.021 * (width - 24)
    angle = np.arctan2(position[:, 2], -position[:, 1])
    y = height / 2 + angle / 2.0 * (height / 2 - 12)
    row, column = np.mgrid[:height, :width]
    out = np.full((height, width, 3), 245, np.uint8)
    for cx, cy, color in zip(x, y, electrode_colors(change)):
        out[(row - cy) ** 2 + (column - cx) ** 2 < 64] = (255 * color[:3]).astype(np.uint8)
    return out


def _series(viser, names):
    colors = [f"hsl({360 * i // max(len(names), 1)}, 70%, 45%)" for i in range(len(names))]
    return (
        viser.uplot.Series(label="t [s]"),
        *(viser.uplot.Series(label=n, stroke=c, width=1) for n, c in zip(names, colors)),
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

    if page is None:
        fingers = {
            name: Finger.of(
                load_skin(h.config.skin),
                np.array(h.numbers.rest),
            )
            for name, h in handles.items()
        }
        page = Page(fingers, **server)
    mujoco.mj_forward(model, data)
    scene = Scene(page.server, model, [h.body for h in handles.values()])
    rest = {name: float(h.read(data, "pdc")[0]) for name, h in handles.items()}
    shown = -np.inf
    while data.time < seconds:
        begin = clock.perf_counter()
        if control is not None:
            control(data)
        mujoco.mj_step(model, data)
        plugin.check()
        if data.time - shown > 0.04 - 1e-9:
            shown = data.time
            scene.update(data)
            page.update(
                shown,
                {name: _state(model, data, h, page.fingers[name], rest[name]) for name, h in handles.items()},
            )
        clock.sleep(max(0.0, model.opt.timestep - (clock.perf_counter() - begin)))
    return page


def _state(model, data, handle, finger, rest):
    body = data.body(handle.body)
    force = float(np.linalg.norm(handle.read(data, "contact_force")[:3]))
    vert = handle.vert_xpos(model, data)[finger.node]
    return (
        vert,
        handle.read(data, "electrodes"),
        float(handle.read(data, "pdc")[0]) - rest,
        force,
        body.xpos.copy(),
        body.xquat.copy(),
    )


def play_file(
    path: pathlib.Path | str,
    page: Page | None = None,
    speed: float = 1.0,
    rounds: float = np.inf,
    **server: object,
) -> Page:
    """Shows a recorded press (skin.h5 of `biotac press`) again and again; returns the page.

    Raises:
      FileNotFoundError: no such file.
      ValueError: it is no recorded press.
    """
    from ..geometry import load_skin

    remedy = "make one with `biotac press --out DIR` and give DIR/skin.h5"
    found, said = read_hdf5(path, "recording", remedy, _PRESS, ["skin"])
    vert, face, time, counts, force = (found[name] for name in _PRESS)
    if not len(time) or not face.size or face.max() >= vert.shape[1] or not (np.diff(time) > 0).all():
        raise ValueError(f"{path} has no steps, faces of missing nodes or times that run back: {remedy}")
    check_counts(counts[:, :NELECTRODE], str(path))
    check_force(force, str(path))
    try:
        geometry = load_skin(str(said["skin"]))
    except (ValueError, FileNotFoundError):
        geometry = load_skin("default")  # of another skin only core and electrodes are lent: all share them
    node, local = np.unique(face, return_inverse=True)
    if page is None:
        finger = Finger(
            node,
            local.reshape(-1, 3),
            geometry.core_vert,
            geometry.core_face,
            geometry.electrode_pos,
            counts[0, :19],
        )
        page = Page({"biotac": finger}, **server)
    done = 0
    while done < rounds:
        for i in range(len(time)):
            state = (
                vert[i][node],
                counts[i, :19],
                counts[i, 19] - counts[0, 19],
                np.linalg.norm(force[i]),
                np.zeros(3),
                np.array([1.0, 0, 0, 0]),
            )
            page.update(float(time[i]), {"biotac": state})
            if i:
                clock.sleep(float(time[i] - time[i - 1]) / speed)
        done += 1
    return page
