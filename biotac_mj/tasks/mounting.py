"""`biotac hand mount`: finds the pose of a BioTac on a link of an unknown hand, as a file and a picture."""

import argparse
import pathlib
import sys
from collections.abc import Sequence

import mujoco
import numpy as np

from ..coupling.show import SKIN
from ..files import picture_kind, replacing
from ..geometry.rigid import matrix
from ..reading import reading
from ..view.offscreen import SHOWN, Offscreen, find_gl, show_bodies, stage
from .hands import attach_to_hand, find_link, fixed_geoms
from .mounts import CLAMP, TIP, Mount, write_mounts

_SIZES = 2e-3, 1.0  # [m] range of a fingertip link's length: others are in different units
_OBLIQUE = np.cos(np.radians(20))  # to all axes of its frame, above which a link's own axis is used
_SLENDER = 1.4  # least ratio of moments for an own axis: fingertips of known hands have 1.7 to 3
_FACING = 0.5  # least cosine for opposite fingers: less for fingers in a row
_END = 10e-3  # [m] length of the link's end, whose middle is on the BioTac's axis
_OFF = 5e-3  # [m] gap to the hand: known mounts have at most 2 mm, links replaced as a whole 11 and 25
_FADED = 0.2  # opacity of everything but the link's finger
_REPLACED = 0.9, 0.15, 0.1  # colour of replaced geoms
_VIEWS = ((-0.3, -0.3, -0.9), (-0.2, -0.95, 0.25))  # eyes in the BioTac frame: from the side, onto the pad


def guess_mount(spec: mujoco.MjSpec, body: str, others: Sequence[str] = (), **given: object) -> Mount:
    """Guesses a Mount from the link's shape. The fingertip points along the axis of the link's frame in which
    its geoms extend farthest, or along the link's own axis if that is oblique. The pad faces the direction in
    which the joint bends it, or the other fingers if these are opposite or there is no hinge. The BioTac ends
    where the link ends, and replaces the geoms that extend beyond its own back end; geoms behind it are the
    link that carries it.

    Args:
      spec: of the hand. body: the link's name, or the end of it. others: links of the other fingers.
      given: known fields of Mount.

    Raises:
      ValueError: no such link, or one without geoms or of an implausible size; directions that are not
        orthogonal.
    """
    link = find_link(spec, body)
    model = spec.copy().compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    here = data.body(model.body(link.name).id)
    frame = here.xmat.reshape(3, 3)
    geoms = np.flatnonzero(_fixed(model, here.id)[model.geom_bodyid])
    points = (_points(model, data, geoms) - here.xpos) @ frame
    if not len(points):
        raise ValueError(
            f"link {link.name!r} has no geom to tell its end by: choose the link with the fingertip"
        )
    size = np.ptp(points, axis=0).max()
    if not _SIZES[0] < size < _SIZES[1]:
        raise ValueError(
            f"link {link.name!r} is {size:.3g} m long, and a BioTac 0.029 m: MuJoCo counts in metres, so "
            "scale the model (of millimetres by 0.001: pos, size, and scale of its meshes)"
        )
    if "tip" not in given:
        given["tip"] = _plain(_longest_axis(points))
    for name in ("tip", "pad"):
        if name in given and not np.linalg.norm(given[name]) > 0:
            raise ValueError(f"{name} is {list(given[name])}: give a direction of the link's frame")
    tip = np.asarray(given["tip"], float) / np.linalg.norm(given["tip"])
    if "pad" not in given:
        towards = frame.T @ _towards(model, data, here, [find_link(spec, o).name for o in others])
        across = towards - towards @ tip * tip
        if _hinge(model, here.id) is None and np.linalg.norm(across) > 1e-6:
            pad = across
        else:
            pad = np.cross(frame.T @ _axis(model, data, here.id), tip)
            if np.linalg.norm(pad) < 0.5:
                raise ValueError(
                    f"link {link.name!r} turns about its own length: say where its pad looks, --pad X Y Z"
                )
            if _points_away(pad, towards):  # for a jaw the joint's range shows how it opens
                pad = -pad
        given["pad"] = _plain((pad / np.linalg.norm(pad)).round(9))
    if "pos" not in given:
        along = points @ tip
        end = points[along > along.max() - _END]
        middle = (end.max(0) + end.min(0)) / 2
        given["pos"] = _plain((middle + (along.max() - TIP - middle @ tip) * tip).round(5))
    if "replaces" not in given:
        reach = [((_points(model, data, [g]) - here.xpos) @ frame @ tip).max() for g in geoms]
        replaced = np.array(reach) > np.dot(given["pos"], tip) - CLAMP
        given["replaces"], given["shown"] = _fingertip(model, geoms, replaced)
    mount = Mount(link.name, **given)
    _ = mount.quat  # raises for invalid directions
    return mount


def _fingertip(model, geoms, replaced):
    """`Mount.replaces` and `.shown`: names of the replaced geoms, and of hidden ones that remain instead of a
    replaced visual one. (None, ()), which is all of the link, if none remains or a replaced one has no
    name."""
    names = np.array([model.geom(g).name for g in geoms])
    if replaced.all() or not names[replaced].all():
        return None, ()
    hidden = model.geom_group[geoms] >= SHOWN
    shown = ~replaced & hidden & (names != "") & (replaced & ~hidden).any()
    return tuple(names[replaced].tolist()), tuple(names[shown].tolist())


def _longest_axis(points):
    """(3,) direction in which a link's points (n, 3) [m] extend farthest from its frame: an axis of the
    frame, or the link's own if it is slender and oblique."""
    from ..triangles import trimesh

    axes = np.eye(3)
    moments, own = np.linalg.eigh(trimesh.PointCloud(points).convex_hull.moment_inertia)  # smallest: length
    if moments[1] > _SLENDER * moments[0] and np.abs(own[:, 0]).max() < _OBLIQUE:
        axes = own[:, :1].T.round(9)
    directions = np.concatenate([axes, -axes])
    return directions[(points @ directions.T).max(0).argmax()]


def _plain(vector):
    return tuple((vector + 0.0).tolist())  # avoids -0.0


def _fixed(model, link):
    """(nbody,) whether a body is the link or fixed to it."""
    found = np.zeros(model.nbody, bool)
    found[link] = True
    for i in range(link + 1, model.nbody):  # parents come first
        found[i] = found[model.body_parentid[i]] and not model.body_jntnum[i] and model.body_mocapid[i] < 0
    return found


def _points(model, data, geoms):
    """(n, 3) of some geoms: vertices of meshes, corners of the boxes around others [m]."""
    corners = np.stack(np.meshgrid(*[[-1, 1]] * 3), -1).reshape(-1, 3)
    out = [np.zeros((0, 3))]
    for g in geoms:
        if model.geom_type[g] == mujoco.mjtGeom.mjGEOM_MESH:
            m = model.geom_dataid[g]
            start, n = model.mesh_vertadr[m], model.mesh_vertnum[m]
            local = model.mesh_vert[start : start + n]
        else:
            local = model.geom_aabb[g, :3] + corners * model.geom_aabb[g, 3:]
        out.append(data.geom_xpos[g] + local @ data.geom_xmat[g].reshape(3, 3).T)
    return np.concatenate(out)


def _hinge(model, body):
    """Number of the nearest hinge that moves a body, or None."""
    while body:
        for j in range(model.body_jntadr[body], model.body_jntadr[body] + model.body_jntnum[body]):
            if model.jnt_type[j] == mujoco.mjtJoint.mjJNT_HINGE:
                return j
        body = model.body_parentid[body]
    return None


def _axis(model, data, body):
    """(3,) axis of the nearest hinge that moves a body, with the sign that bends the finger further."""
    j = _hinge(model, body)
    if j is None:
        raise ValueError("no hinge moves this link: say where its pad looks, --pad X Y Z")
    low, high = model.jnt_range[j] if model.jnt_limited[j] else (0.0, 1.0)
    return data.xaxis[j] * (1 if high >= -low - 1e-9 else -1)


def _towards(model, data, here, others):
    """(3,) from a link to the mean position of others, which may include itself [m]; 0 without others."""
    places = [data.body(model.body(name).id).xipos for name in others if name != here.name]
    return np.mean(places, axis=0) - here.xipos if places else np.zeros(3)


def _points_away(pad, towards):
    return np.dot(pad, towards) < -_FACING * np.linalg.norm(pad) * np.linalg.norm(towards)


def looks_away(spec: mujoco.MjSpec, mount: Mount, others: Sequence[str]) -> bool:
    """Whether a pad faces away from links of opposite fingers."""
    model = spec.copy().compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    here = data.body(model.body(mount.body).id)
    names = [find_link(spec, o).name for o in others]
    towards = here.xmat.reshape(3, 3).T @ _towards(model, data, here, names)
    return bool(_points_away(mount.pad, towards))


def stands_off(spec: mujoco.MjSpec, mount: Mount) -> float:
    """Distance of a mounted BioTac from the remaining hand [m]; at most 0.05.

    Args:
      spec: of the hand; the BioTac is added to it.
    """
    (handle,) = attach_to_hand(spec, {"f": mount}, skin="coarse", tier="condensed").values()
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    core = model.body(handle.body).id
    own = np.flatnonzero(model.geom_bodyid == core)
    visible = (model.geom_rgba[:, 3] > 0) | (model.geom_matid >= 0)  # replaced geoms are neither
    hand = (model.body_rootid == model.body_rootid[core])[model.geom_bodyid] & visible
    hand[own] = False
    pairs = ((a, b) for a in own for b in np.flatnonzero(hand))
    return min((mujoco.mj_geomDistance(model, data, a, b, 0.05, None) for a, b in pairs), default=0.05)


def side_view(
    pos: np.ndarray, mat: np.ndarray, eye: tuple = _VIEWS[0], distance: float = 0.11
) -> mujoco.MjvCamera:
    """A camera on a BioTac.

    Args:
      pos, mat: (3,) [m], (3, 3) of the BioTac frame. eye: viewing direction in it. distance: [m] of the
        camera.
    """
    camera, view = mujoco.MjvCamera(), -mat @ np.asarray(eye) / np.linalg.norm(eye)
    camera.lookat[:], camera.distance = pos - 5e-3 * mat[:, 0], distance
    camera.azimuth = np.degrees(np.arctan2(view[1], view[0]))
    camera.elevation = np.degrees(np.arcsin(view[2]))
    return camera


def draw_mount(
    path: pathlib.Path | str, mount: Mount, width: int = 420, height: int = 420
) -> list[np.ndarray] | None:
    """Three pictures (height, width, 3) uint8: the original link with the replaced geoms in red; the
    link with the BioTac and its axes (x red, y green, z blue) from the side; the same with a view of its pad.
    Other fingers are translucent. None if no GL library works.

    Args:
      path: MJCF of the hand.
    """
    gl, views = find_gl(), []
    if gl is None:
        return None
    for attached, eyes in ((False, _VIEWS[:1]), (True, _VIEWS)):
        spec = mujoco.MjSpec.from_file(str(path))
        link = find_link(spec, mount.body)
        _fade_others(spec, link)
        show_bodies(spec)
        if attached:
            (handle,) = attach_to_hand(spec, {"f": mount}, skin="coarse", tier="condensed").values()
            _add_axes(spec.body(handle.body))
        else:
            for geom in fixed_geoms(link, mount.replaces):
                geom.material, geom.rgba = "", [*_REPLACED, 1]
        stage(spec)
        model = spec.compile()
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        here = data.body(link.name)
        frame = here.xmat.reshape(3, 3)
        pos, mat = here.xpos + frame @ mount.pos, frame @ matrix(mount.quat)
        with Offscreen(model, width, height, gl) as screen:
            views += [screen.render(data, side_view(pos, mat, eye)) for eye in eyes]
    return views


def _fade_others(spec, link):
    """Makes all but a link's finger translucent, because other fingers may block the view."""
    own, body = fixed_geoms(link), link.parent
    while body is not None:
        own += body.geoms
        body = body.parent
    colours = [geom.rgba.copy() for geom in own]
    for geom in spec.geoms:
        geom.rgba[3] *= _FADED
    for geom, colour in zip(own, colours):
        geom.rgba[:] = colour


def _add_axes(body):
    tip_capsule = [-TIP - 0.015, 0, 0, -TIP - 2e-3, 0, 0]  # before the tip, as the link would hide it
    for k, (axis, colour) in enumerate(zip(np.eye(3), np.eye(3))):
        body.add_geom(
            type=mujoco.mjtGeom.mjGEOM_CAPSULE,
            fromto=[0, 0, 0, *(0.02 * axis)] if k else tip_capsule,
            size=[6e-4, 0, 0],
            rgba=[*colour, 1],
            contype=0,
            conaffinity=0,
            mass=0,
        )


def mount_verb(args: argparse.Namespace) -> None:
    """`biotac hand mount`: guesses, writes, draws and reports the mount."""
    with reading(args.hand, "MJCF of a hand", "give its .xml, beside its meshes"):
        mujoco.MjSpec.from_file(args.hand).compile()
    given = {name: getattr(args, name) for name in ("tip", "pad", "pos", "replaces")}
    given = {name: tuple(value) for name, value in given.items() if value is not None}
    mounts = {}
    for body in args.body:
        spec = mujoco.MjSpec.from_file(args.hand)
        others = [other for other in args.body if other != body]
        mount = guess_mount(spec, body, others, **given)
        if mount.body in mounts:
            raise ValueError(f"--body names {mount.body} twice: name each link once")
        mounts[mount.body] = mount
        for line in _account(spec, mount):
            print(line)
        if "pad" in given and others and looks_away(spec, mount, others):
            print(
                f"warning: the pad of {mount.body} looks away from {', '.join(others)}, --pad is in each "
                "link's own frame: leave it out, or mend the file",
                file=sys.stderr,
            )
        off = stands_off(spec, mount)
        if off > _OFF:
            print(
                f"warning: the BioTac of {mount.body} hangs in the air, {1e3 * off:.0f} mm from what is left "
                "of the hand: name with --replaces those geoms alone that are the fingertip (a geom without "
                "a name needs one in the model), or move it with --pos",
                file=sys.stderr,
            )
    write_mounts(args.out, mounts)
    print(f'written: {args.out}; biotac_mj.attach_to_hand(spec, mount="{args.out}")')
    if args.picture:
        rows = [draw_mount(args.hand, mount) for mount in mounts.values()]
        if rows[0] is None:
            raise ValueError(
                "no GL library works here: leave --picture out, or install libosmesa6 or libegl1"
            )
        _write_picture(args.picture, dict(zip(mounts, rows)))
        print(f"drawn: {args.picture}")


def _account(spec, mount):
    """Lines on the pose of a BioTac, the replaced geoms and the remaining ones."""
    link = find_link(spec, mount.body)
    replaced = fixed_geoms(link, mount.replaces)
    names = [g.name or f"a {g.type.name[7:].lower()} without a name" for g in replaced]
    yield f"{mount.body}: at {mount.pos} m, tip {mount.tip}, pad {mount.pad}"
    yield f"  stands for {', '.join(names) or 'nothing'}: not drawn, touches nothing"
    if mount.replaces is not None:
        stays = [g.name for g in fixed_geoms(link) if g.name and g.name not in names]
        yield f"  leaves {', '.join(stays) or 'nothing that has a name'} of the link as it is"


def _write_picture(path, rows):
    """rows: {body: result of `draw_mount`}."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    figure = Figure(figsize=(10, 0.9 + 3.5 * len(rows)), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(len(rows), 3, squeeze=False)
    for line, (body, views) in zip(axes, rows.items()):
        for axis, view, title in zip(line, views, ("before", "the BioTac from beside", "onto its pad")):
            axis.imshow(view)
            axis.set(title=title, xticks=[], yticks=[])
        line[0].set_ylabel(body)
    directions = (
        ("r", "x: drawn before the tip, points into the link"),
        ("g", "y: to the nail, away from the pad"),
        ("b", "z: across"),
    )
    shown = [Patch(color=_REPLACED, label="what it stands for"), Patch(color=SKIN, label="skin")]
    shown += [Line2D([], [], color=color, lw=3, label=label) for color, label in directions]
    figure.legend(handles=shown, loc="outside lower center", ncols=3, frameon=False)
    with replacing(path) as temporary:
        figure.savefig(temporary, dpi=110, format=picture_kind(path))
