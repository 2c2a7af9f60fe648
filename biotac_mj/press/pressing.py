"""Simulates one press of an indenter into a BioTac with `mj_step`, and renders its peak."""

import dataclasses
import time
import typing
import warnings
from collections.abc import Callable

import mujoco
import numpy as np
import tqdm

from .. import plugin
from .indenter import make_indenter
from .path import LEAD, PressOptions, plan_path
from .record import NEAR_PEAK, PressRecord
from .scene import build_scene


class PressResult(typing.NamedTuple):
    """Result of `press`: record, picture = press(...).

    Attributes:
      record: PressRecord.
      picture: result of the given `render`, (height, width, 3) uint8 for this module's; None without one.
    """

    record: PressRecord
    picture: np.ndarray | None


def _read(handle, data):
    """Results of one step: force (3,) of the skin on the indenter [N], counts in the order of
    `Design.channels`, all samples of PAC, number of steps that did not converge."""
    design = handle.design
    single = (handle.read(data, name)[-1:] for name in design.channels[design.nelectrode :])
    counts = np.concatenate([handle.read(data, "electrodes") if design.nelectrode else [], *single])
    force, lost = -handle.read(data, "contact_force")[:3], handle.read(data, "status")[1]
    return force, counts, handle.read(data, "pac"), lost


def press(
    options: PressOptions = PressOptions(),  # noqa: B008 - frozen
    render: Callable | None = None,
    progress: bool = True,
) -> PressResult:
    """Presses an indenter into a BioTac, and records the readings.

        record = press(PressOptions(depth=1e-3)).record

    Args:
      options: options of the press.
      render: called with (model, data) of the step `record.peak`, such as `press.render`; its result is
        returned beside the record.
      progress: whether to show a progress bar.

    Warns if nothing was touched.

    Raises:
      ValueError, FileNotFoundError: an impossible option, or a path into core, nail or clamp; the message
        names cause and remedy.
    """
    from ..coupling.steppers.fem import rest_geometry
    from ..geometry import SkinGeometry, load_skin
    from ..geometry.skins import skin_of_design
    from ..skin.settings import plain

    options = dataclasses.replace(options, settings=options.settings.amended())
    mesh = options.settings.skin.mesh
    mesh = skin_of_design(options.settings.skin.design, mesh)
    geometry = mesh if isinstance(mesh, SkinGeometry) else load_skin(mesh)
    indenter = make_indenter(options.indenter)
    # the filled skin, which the indenter touches first
    rest = rest_geometry(options.settings.config(geometry=geometry), geometry)
    path = plan_path(rest, indenter, options)
    if options.depth > path.room and not options.two_way:
        raise ValueError(
            f"depth is {1e3 * options.depth:.6g} mm, and the indenter meets core, nail or clamp "
            f"{abs(1e3 * path.room):.2f} mm {'after' if path.room > 0 else 'before'} the skin: press less "
            "deep, or elsewhere"
        )
    spec, handle = build_scene(indenter, path, options)
    with plugin.explained():
        model = spec.compile()
        data = mujoco.MjData(model)
    rows, picture, seconds, largest = [], None, 0.0, 0.0
    kind = mujoco.mjtState.mjSTATE_INTEGRATION
    kept = np.empty(mujoco.mj_stateSize(model, kind))  # at the peak
    ways = np.column_stack([path.depth, path.slid])
    for travel in tqdm.tqdm(ways, "press", unit="step", disable=not progress or None, leave=False):
        begin = time.perf_counter()
        if options.two_way:
            data.ctrl[:] = (travel + [LEAD, 0])[: model.nu]
            mujoco.mj_step(model, data)
            travel[: model.nq] = data.qpos - [LEAD, 0][: model.nq]
        else:
            data.mocap_pos[0] = path.position(*travel)
            mujoco.mj_step(model, data)
        seconds += time.perf_counter() - begin
        rows.append(
            (
                data.time,
                travel[0],
                path.position(*travel),
                handle.vert_xpos(model, data),
                handle.contact_pressure(model, data),
                *_read(handle, data),
            )
        )
        largest = max(largest, force := np.linalg.norm(rows[-1][5]))
        if force >= NEAR_PEAK * largest:
            mujoco.mj_getState(model, data, kept, kind)
    if render is not None:
        mujoco.mj_setState(model, data, kept, kind)
        mujoco.mj_forward(model, data)
        picture = render(model, data)
    times, depth, position, xpos, pressure, force, counts, pac, nonconverged = (
        np.array(column) for column in zip(*rows)
    )
    if not force.any():
        warnings.warn(
            "the indenter has met no skin that gives way, and nothing was felt: press deeper, or elsewhere",
            stacklevel=2,
        )
    record = PressRecord(
        geometry=geometry,
        parameters={
            **plain(options.keywords, geometry),
            "skin": handle.config.skin,
            "direction": path.direction.tolist(),
            "start": path.start.tolist(),
        },
        time=times,
        depth=depth,
        force=force,
        counts=counts,
        pac=pac,
        nonconverged=nonconverged,
        vert_xpos=xpos.astype(np.float32),
        contact_pressure=None if pressure[0] is None else pressure.astype(np.float32),
        indenter_pos=position,
        indenter_quat=np.tile(path.quat, (len(times), 1)),
        indenter_vert=indenter.vert,
        indenter_face=indenter.face,
        seconds=seconds,
    )
    return PressResult(record, picture)


def render(
    model: mujoco.MjModel, data: mujoco.MjData, width: int = 900, height: int = 640
) -> np.ndarray | None:
    """Picture (height, width, 3) uint8 of the scene from the camera "press"; None if no GL library works."""
    from ..view.offscreen import Offscreen, find_gl

    gl = find_gl()
    if gl is None:
        return None
    camera = mujoco.MjvCamera()
    camera.type, camera.fixedcamid = mujoco.mjtCamera.mjCAMERA_FIXED, model.camera("press").id
    with Offscreen(model, width, height, gl) as screen:
        return screen.render(data, camera)
