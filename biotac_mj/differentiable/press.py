"""A press as a differentiable PyTorch function."""

import dataclasses
import math
import numbers
import types

import numpy as np
import torch
import warp as wp

from ..fields import refuse_unknown
from ..geometry.edge_nodes import EDGES
from ..geometry.rigid import matrix_entries
from ..short_repr import short_repr
from ..skin.model import stiffness_of_contact
from ..skin.rubber.law import LAWS
from ..skin.rubber.material import Material
from .linear.rest import areas_at, cavity_at
from .record import Changes, follow
from .skin import NUMBERS, Skin
from .sweep import Inputs, Outputs, pull_back, push_forward
from .tensors import real_tensor, skew

# parameters of `press`; default: the skin's own
PARAMETERS = ("youngs_modulus", "poissons_ratio", "fill_volume", "bulk_modulus", "contact_stiffness")


@dataclasses.dataclass
class Pressed:
    """Result of a press, as differentiable tensors of double precision.

    Attributes:
      nodes: (..., nstep, nvert, 3) in the BioTac frame [m].
      wrench: (..., nstep, ngroup, 6) of the skin on the geoms, torque about the frame's origin [N, N m].
      pressure: (..., nstep) of the liquid above rest [Pa].
      changes: per world a list of `Changes`, one per step: where a gradient is one-sided.
    """

    nodes: torch.Tensor
    wrench: torch.Tensor
    pressure: torch.Tensor
    changes: list

    @property
    def counts(self) -> Changes:
        """Changes summed over all steps of all worlds."""
        steps = [dataclasses.astuple(change) for world in self.changes for change in world]
        return Changes(*np.sum(steps, 0).tolist())


def press(
    skin: Skin,
    pos: torch.Tensor,
    quat: torch.Tensor,
    core_pos: torch.Tensor | None = None,
    core_quat: torch.Tensor | None = None,
    friction: torch.Tensor | None = None,
    rest_nodes: torch.Tensor | None = None,
    dt: float | np.ndarray | None = None,
    smoothing: float = 0.0,
    together: str | None = None,
    **parameters: torch.Tensor,
) -> Pressed:
    """Moves geoms along a path against a skin at rest; differentiable by every argument except the first, dt,
    smoothing and `together`, in reverse mode and, by `torch.autograd.forward_ad`, in forward mode.

    Worlds are solved one after another on the CPU, or, without liquid and memory, in parallel on the device
    `together`. Results are on that device; tensors of other devices are copied to it, and their gradients
    back. Each step saves some hundred kilobytes for the backward pass; no step is solved twice.

    Args:
      skin: the skin and its geoms.
      pos: (nstep, ngeom, 3) or (nworld, nstep, ngeom, 3), of the geoms [m].
      quat: likewise with 4, w x y z; of any norm except zero.
      core_pos, core_quat: (..., nstep, 3) [m] and (..., nstep, 4) pose of the BioTac, in the frame of the
        geoms' poses; None: these are in the BioTac frame.
      friction: (ngeom,) or (nworld, ngeom) Coulomb coefficients; None: the skin's.
      rest_nodes: (nnode, 3) or (nworld, nnode, 3) rest positions [m], of the geometry's nodes (nodes added on
        edges are in the middle) or of all solved ones, `skin.rest`; None: the skin's. Rubber, fixed nodes,
        contact areas, including those on the core, and the liquid's volume follow; the core does not, nor
        does the set of inner faces that can touch it. `impedance` takes them as well. A fill_volume is in
        addition to the volume of this shape.
      dt: time of a step, or (nstep,) of the steps [s]; required for a Prony series. A skin with memory starts
        relaxed and virgin, after its filling.
      smoothing: half width [m] over which first contact and the transition from stick to slip are smooth:
        another law without these kinks in its gradient. It pushes from this gap on, at zero gap as Coulomb's
        law at a quarter of it, and slip begins earlier by as much. Contact with the core keeps its kinks. 0:
        Coulomb's law.
      together: "cpu" or a CUDA device, such as "cuda:0", on which all worlds are solved in parallel. None:
        one after another. Not available for liquid, rubber with memory, rest_nodes, smoothing.
      parameters: numbers, or (nworld,), of PARAMETERS: youngs_modulus [Pa], poissons_ratio, fill_volume
        (liquid in addition to the unstressed skin's) [m^3], bulk_modulus (of the liquid) [Pa],
        contact_stiffness [Pa/m], default 180 E per millimetre unless the skin's options set it. And of the
        memory, as in `skin.Material` and as many as the skin's, each also with a leading nworld: prony
        (nterm, 2) of fraction and time [s], mullins (3,), hysteresis (nbranch, 2).

    Raises:
      ValueError: incompatible shapes, values that are not finite, an invalid smoothing, an unknown or unused
        parameter, no time step for a Prony series, rest positions with an inverted tetrahedron, or features
        that parallel worlds lack.
    """
    if together is not None:
        _refuse_parallel(skin, together, rest_nodes, smoothing)
    pos, quat = real_tensor("pos", pos).cpu(), real_tensor("quat", quat).cpu()
    if (core_pos is None) != (core_quat is None):
        raise ValueError("the BioTac moves by core_pos and core_quat: give both or neither")
    if core_pos is not None:
        core_pos, core_quat = (
            real_tensor(name, value).cpu()
            for name, value in (("core_pos", core_pos), ("core_quat", core_quat))
        )
        pos, quat = relative_pose(core_pos, core_quat, pos, quat)
    count, single = skin.geoms.count, pos.ndim == 3
    if pos.shape[-2:] != (count, 3) or quat.shape != (*pos.shape[:-1], 4) or pos.ndim not in (3, 4):
        raise ValueError(
            f"pos has shape {tuple(pos.shape)} and quat {tuple(quat.shape)}: pass (nstep, {count}, 3) and "
            f"(nstep, {count}, 4), or both with a leading nworld"
        )
    if not pos.numel() or not torch.isfinite(pos).all():
        raise ValueError("pos is empty or not finite: give at least one step and numbers [m]")
    if not (quat.norm(dim=-1) > 1e-100).all() or not torch.isfinite(quat).all():
        raise ValueError("a quat is zero or not finite: give w x y z of any other length")
    if single:
        pos, quat = pos[None], quat[None]
    nworld = len(pos)
    if friction is None:
        friction = torch.as_tensor(skin.friction)
    friction = _of_worlds("friction", friction, nworld, (count,))
    if not ((friction >= 0) & torch.isfinite(friction)).all():
        raise ValueError(f"friction is {friction.tolist()}: give 0 or more")
    _refuse_smoothing(skin, smoothing)
    memory = {name: parameters.pop(name, None) for name in ("prony", "mullins", "hysteresis")}
    given = {name: _of_worlds(name, value, nworld, ()) for name, value in parameters.items()}
    rest = _rest_positions(skin, rest_nodes, nworld)
    times = _times_of(skin, dt, pos.shape[1])
    constants = _constants_of(skin, memory, nworld)
    made = [numbers_of(skin, {name: v[w] for name, v in given.items()}, rest[w]) for w in range(nworld)]
    made = torch.stack([torch.stack([own[name] for name in NUMBERS]) for own in made])
    changes, mat, parts = [], _matrix(quat), []
    if together is not None:
        worlds, own = skin.in_worlds(nworld, together), (pos, mat, friction, made, constants[0])
        found = _Press.apply(worlds, changes, times, 0.0, *own, None, None, None)
    else:
        for w, shape in enumerate(rest):
            one = slice(w, w + 1)
            own = pos[one], mat[one], friction[one], made[one], constants[w], *_shape_of(skin, shape)
            parts.append(_Press.apply(skin, changes, times, smoothing, *own))
        found = [torch.cat(of) for of in zip(*parts)]
    if single:
        found = [one[0] for one in found]
    return Pressed(*found, changes)


def numbers_of(skin: Skin, parameters: dict, rest: torch.Tensor | None = None) -> dict:
    """`skin.NUMBERS` as tensors, for the skin's material with other PARAMETERS, and rest positions (nvert, 3)
    [m] if given.

    Raises:
      ValueError: an unknown parameter, one of the liquid for a dry skin, or an invalid value.
    """
    model, options = skin.model, skin.model.options
    refuse_unknown(parameters, PARAMETERS, "press")
    wet = {"fill_volume", "bulk_modulus"} & set(parameters)
    if wet and not model.has_liquid:
        raise ValueError(f"the skin has no liquid: leave {' and '.join(sorted(wet))} out")
    if "bulk_modulus" in parameters and math.isinf(options.bulk_modulus):
        raise ValueError("the skin's liquid is incompressible: make the skin with a finite bulk_modulus")
    values = {name: float(torch.as_tensor(value).detach()) for name, value in parameters.items()}
    rubber = {name: values[name] for name in ("youngs_modulus", "poissons_ratio") if name in values}
    dataclasses.replace(model.material, **rubber)  # raises for invalid values
    for name in {"contact_stiffness", "bulk_modulus"} & set(values):
        if not 0 < values[name] < math.inf:
            raise ValueError(f"{name} is {values[name]}: give a positive number")
    if not all(map(math.isfinite, values.values())):
        raise ValueError(f"{values} cannot be: give finite numbers")
    if "fill_volume" in values and not abs(values["fill_volume"]) < model.liquid_volume:
        raise ValueError(
            f"fill_volume is {values['fill_volume']}: the liquid has {model.liquid_volume:.3g} m^3"
        )
    own = {name: getattr(model.material, name, None) for name in PARAMETERS}
    own |= {name: getattr(options, name) for name in PARAMETERS if own[name] is None}
    own = types.SimpleNamespace(**own | parameters)
    as_is = {name: torch.as_tensor(value, dtype=torch.float64) for name, value in skin.own.items()}
    if {"youngs_modulus", "poissons_ratio"} & set(parameters):
        # the material's own formulas, on tensors
        as_is["mu"] = Material.mu.fget(own)
        as_is["lam"] = (Material.bulk if model.law == LAWS["neo_hookean"] else Material.lame).fget(own)
    if own.contact_stiffness is None:
        own.contact_stiffness = stiffness_of_contact(own)
    as_is["contact_stiffness"] = torch.as_tensor(own.contact_stiffness, dtype=torch.float64)
    if wet or (rest is not None and model.has_liquid):
        bulk = as_is["kappa"] * as_is["natural"]
        if "fill_volume" in parameters:
            as_is["natural"] = model.liquid_volume + own.fill_volume
        if rest is not None:
            as_is["natural"] = as_is["natural"] + cavity_at(rest, model.inner.face_np) - model.rest_volume
        if "bulk_modulus" in parameters:
            bulk = own.bulk_modulus
        if not as_is["natural"] > 0:
            raise ValueError("rest_nodes and fill_volume leave the liquid no room: move the inner nodes out")
        as_is["kappa"] = bulk / as_is["natural"]
    return as_is


def relative_pose(
    core_pos: torch.Tensor, core_quat: torch.Tensor, pos: torch.Tensor, quat: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Poses of geoms (..., ngeom, 3), (..., ngeom, 4) relative to the BioTac at (..., 3), (..., 4)."""
    core_quat = core_quat / core_quat.norm(dim=-1, keepdim=True)
    turn = _matrix(core_quat).transpose(-1, -2)[..., None, :, :]
    w, v = core_quat[..., None, :1], -core_quat[..., None, 1:]
    a, b = quat[..., :1], quat[..., 1:]
    turned = torch.cat(
        [w * a - (v * b).sum(-1, keepdim=True), w * b + a * v + torch.linalg.cross(v.expand_as(b), b)], -1
    )
    return (turn @ (pos - core_pos[..., None, :])[..., None])[..., 0], turned


def _matrix(quat):
    """(..., 3, 3) of (..., 4)."""
    unit = quat / quat.norm(dim=-1, keepdim=True)
    return torch.stack(matrix_entries(*unit.unbind(-1)), -1).reshape(*quat.shape[:-1], 3, 3)


def _rest_positions(skin, nodes, nworld):
    """Rest positions (nvert, 3) of each world, None if they are the skin's."""
    if nodes is None:
        return [None] * nworld
    nodes, n, given = real_tensor("rest_nodes", nodes).cpu(), len(skin.rest), skin.given
    known = sorted({given, n})
    if nodes.ndim not in (2, 3) or nodes.shape[-2] not in known or nodes.shape[-1] != 3:
        counts = " or ".join(f"({count}, 3)" for count in known)
        raise ValueError(f"rest_nodes has shape {tuple(nodes.shape)}: pass {counts}, or with nworld before")
    if not torch.isfinite(nodes).all():
        raise ValueError("rest_nodes is not finite: give numbers [m]")
    nodes = _of_worlds("rest_nodes", nodes, nworld, nodes.shape[-2:])
    if nodes.shape[1] < n:
        elem = skin.model.geometry.elem
        ends = np.zeros((n - given, 2), np.int64)
        ends[elem[:, 4:].ravel() - given] = elem[:, EDGES].reshape(-1, 2)
        nodes = torch.cat([nodes, nodes[:, torch.from_numpy(ends)].mean(2)], 1)
    return list(nodes)


def _refuse_parallel(skin, device, rest_nodes, smoothing):
    """Raises ValueError for features that parallel worlds lack, or a missing device."""
    missing = "is not there for worlds that go together: leave `together` out"
    if skin.model.has_liquid:
        raise ValueError(f"liquid {missing}, or take liquid=False")
    if skin.model.material.remembers:
        raise ValueError(f"rubber with prony, mullins or hysteresis {missing}")
    if rest_nodes is not None:
        raise ValueError(f"rest_nodes {missing}")
    if smoothing:
        raise ValueError(f"smoothing {missing}")
    try:
        wp.get_device(device)
    except (ValueError, RuntimeError) as error:
        raise ValueError(f"together is {device!r}: give 'cpu', or a CUDA device that is there") from error


def _refuse_smoothing(skin, width):
    """Checks the width; for a mesh the distance is exact only near its surface."""
    spacing = skin.geoms.struct.grids.spacing.numpy()
    most = 0.4 * spacing.min() if len(spacing) else 1e-3
    if isinstance(width, torch.Tensor) and width.requires_grad:
        raise ValueError("smoothing requires a gradient, which a press does not give by it: detach() it")
    if not (isinstance(width, numbers.Real) and 0 <= width <= most):
        raise ValueError(f"smoothing is {width!r}: give a half width from 0 to {most:.2g} m, as 1e-5")


def _times_of(skin, dt, nstep):
    """(nstep,) [s], or None if unused."""
    if dt is None:
        if skin.model.material.prony:
            raise ValueError("skin with a Prony series relaxes in time: give press a dt [s]")
        return None
    wanted = f"give a positive time [s], or ({nstep},) of them"
    if isinstance(dt, torch.Tensor) and dt.requires_grad:
        raise ValueError("dt requires a gradient, which a press does not give by it: pass dt.detach()")
    times = real_tensor("dt", dt, wanted).numpy()
    if times.shape not in ((), (nstep,)):
        raise ValueError(f"dt has shape {times.shape}: {wanted}")
    if not (np.isfinite(times) & (times > 0)).all():
        raise ValueError(f"dt is {short_repr(times.tolist())}: {wanted}")
    return np.broadcast_to(times, nstep)


def _constants_of(skin, given, nworld):
    """(nworld, c) constants of the rubber's memory, see `memory_constants.constants_of`."""
    parts, material = [], skin.model.material
    for name, value in given.items():
        own = torch.tensor(getattr(material, name) or (), dtype=torch.float64)
        if value is None:
            value = own
        elif not len(own):
            raise ValueError(f"the skin's material has no {name}: leave it out, or give the material some")
        parts.append(_of_worlds(name, value, nworld, tuple(own.shape)).reshape(nworld, -1))
        for w in range(nworld):  # raises for invalid values
            value = parts[-1][w].detach().reshape(own.shape).tolist()
            dataclasses.replace(material, **{name: value or getattr(material, name)})
    return torch.cat(parts, 1)


def _shape_of(skin, rest):
    """Rest positions and the resulting areas, of outer faces and of those that can touch the core."""
    if rest is None:
        return None, None, None
    core = skin.data.core
    area = areas_at(rest, core.surface.face_np) if core else torch.zeros(0, dtype=torch.float64)
    return rest, areas_at(rest, skin.model.outer.face_np), area


def _of_worlds(name, value, nworld, shape):
    value = real_tensor(name, value).cpu()  # device of the solves; autograd copies the gradient back
    if value.shape not in (shape, (nworld, *shape)):
        raise ValueError(f"{name} has shape {tuple(value.shape)}: pass {shape} or {(nworld, *shape)}")
    return value.expand(nworld, *shape)


class _Press(torch.autograd.Function):
    """All worlds of a skin. Rotations are matrices here: their cotangents are along rotations."""

    @staticmethod
    def forward(context, skin, changes, dt, smoothing, pos, mat, friction, numbers, constants, *shape):
        context.skin, rest = skin, shape[0]
        path = (a.detach().numpy() for a in (pos, mat, friction))
        numbers = dict(zip(NUMBERS, numbers.detach().T))
        # a copy, so that in-place changes of the nodes do not change checkpoints
        vert = None if rest is None else rest.detach().numpy().copy()
        with skin.lock, skin.stream():
            context.trajectory = trajectory = follow(
                skin, *path, numbers, vert, dt, constants.detach().numpy().copy(), smoothing
            )
            out = Outputs.of(trajectory)
        changes += [list(of) for of in zip(*(record.changes for record in trajectory.steps))]
        context.mat = mat.detach()
        return out.nodes, out.wrench, out.pressure

    @staticmethod
    def jvp(context, _skin, _changes, _dt, _smoothing, pos, mat, friction, numbers, constants, *shape):
        rest, area, core_area = shape
        skin, zero = context.skin, torch.zeros((), dtype=torch.float64)
        pos, mat, friction, numbers = (zero if t is None else t for t in (pos, mat, friction, numbers))
        turn = (mat + torch.zeros_like(context.mat)) @ context.mat.transpose(-1, -2)
        turn = torch.stack([turn[..., 2, 1], turn[..., 0, 2], turn[..., 1, 0]], -1)
        pose = torch.cat([pos + torch.zeros_like(turn), turn], -1)
        friction = friction.expand(skin.nworld, skin.geoms.count)
        numbers = numbers.expand(skin.nworld, len(NUMBERS)).numpy()
        shape = (None, None, None)
        if rest is not None:
            core_area = torch.zeros(skin.surfaces[1]) if core_area is None else core_area
            shape = (t.numpy()[None] for t in (rest, area, core_area))
        tangents = Inputs(
            pose.numpy()[None], friction.numpy()[None], dict(zip(NUMBERS, numbers.T[:, None])), *shape,
            None if constants is None else constants.numpy()[None],
        )  # fmt: skip
        with skin.lock, skin.stream():
            out = push_forward(skin, context.trajectory, tangents)
        return tuple(skin.tensor(a[0]) for a in (out.nodes, out.wrench, out.pressure))

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(context, nodes, wrench, pressure):
        skin, mat = context.skin, context.mat
        with skin.lock, skin.stream():
            found = pull_back(
                skin, context.trajectory, Outputs(nodes, wrench, pressure), context.needs_input_grad[9]
            )
        move, turn = torch.from_numpy(found.pose).split(3, -1)
        numbers = torch.from_numpy(np.stack([found.numbers[name] for name in NUMBERS], 1))
        shape = found.vert, found.area, found.core_area
        shape = (None if a is None else torch.from_numpy(a) for a in shape)
        own = numbers, torch.from_numpy(found.constants), *shape
        return None, None, None, None, move, 0.5 * skew(turn) @ mat, torch.from_numpy(found.friction), *own
