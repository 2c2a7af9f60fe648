"""The steps of a press of many dry, elastic worlds at their balances, linear in what they were given:
`linear.step.LinearStep` for all worlds at once, and what goes back from step to step.

What a step's samples feel is known before cotangents are (`slopes`); it is put into lists on the device. The
rest of a step, from the tangent through the solve to the cotangents of the step before, is one program, on
CUDA one graph: the host copies nodes and says where in the lists a step's samples are."""

import weakref

import numpy as np
import torch
import warp as wp

from ...skin.newton.worlds import BLOCK, total_of
from ...skin.program import Launcher, Program, compile_kernels
from ...skin.types import mat33, real, vec3
from ..skin import sum_corners
from .skin import SkinOfWorlds
from .slopes import touched_by_core, touched_by_geoms
from .solve import Gmres, refuse_unsolved

__all__ = ["Sweep", "pull_back"]

wp.set_module_options({"enable_backward": False})

_ROOM = 1.25  # times the samples of a press, for those of the next ones


@wp.struct
class _Lists:
    """Samples of all steps [sample], those of a step behind each other."""

    span: wp.array(dtype=int)  # the present step's first one, and how many
    node: wp.array2d(dtype=int)  # of a face's corners, whose numbers count worlds
    weight: wp.array(dtype=vec3)
    face: wp.array(dtype=int)
    world: wp.array(dtype=int)
    core: wp.array(dtype=int)  # on that surface
    tangent: wp.array(dtype=mat33)  # of the sample, transposed: -(force by point)'
    anchor_by_point: wp.array(dtype=mat33)
    force_by_before: wp.array(dtype=mat33)  # by where it stuck, or was, when the step began
    anchor_by_before: wp.array(dtype=mat33)
    before: wp.array(dtype=int)  # see `slopes.Touched`
    felt: wp.array2d(dtype=vec3)  # cotangents of the corners by the wrench's
    collected: wp.array(dtype=vec3)  # and of the force
    anchor: wp.array(dtype=vec3)  # cotangents of the sample's anchor
    force: wp.array(dtype=vec3)  # and of its force, with what the balance adds


@wp.kernel
def _mark(
    lists: _Lists,
    outer_touching: wp.array2d(dtype=int),
    outer_block: wp.array2d(dtype=mat33),
    core_touching: wp.array2d(dtype=int),
    core_block: wp.array2d(dtype=mat33),
):
    """Faces that touch, with tangents of zero."""
    i = wp.tid()
    if i >= lists.span[1]:
        return
    i += lists.span[0]
    f = lists.face[i]
    w = lists.world[i]
    if lists.core[i] == 1:
        core_touching[f, w] = 1
        for k in range(6):
            core_block[6 * f + k, w] = mat33()
    else:
        outer_touching[f, w] = 1
        for k in range(6):
            outer_block[6 * f + k, w] = mat33()


@wp.func
def _add_block(b: vec3, K: mat33, f: int, w: int, block: wp.array2d(dtype=mat33)):
    wp.atomic_add(block, 6 * f, w, b[0] * b[0] * K)
    wp.atomic_add(block, 6 * f + 1, w, b[0] * b[1] * K)
    wp.atomic_add(block, 6 * f + 2, w, b[0] * b[2] * K)
    wp.atomic_add(block, 6 * f + 3, w, b[1] * b[1] * K)
    wp.atomic_add(block, 6 * f + 4, w, b[1] * b[2] * K)
    wp.atomic_add(block, 6 * f + 5, w, b[2] * b[2] * K)


@wp.kernel
def _push(
    # In:
    lists: _Lists,
    # In and out:
    outer_block: wp.array2d(dtype=mat33),
    core_block: wp.array2d(dtype=mat33),
    right: wp.array(dtype=vec3),
):
    """Adds the tangents of samples, and to the right-hand side the cotangents of what they feel."""
    i = wp.tid()
    if i >= lists.span[1]:
        return
    i += lists.span[0]
    b = lists.weight[i]
    if lists.core[i] == 1:
        _add_block(b, lists.tangent[i], lists.face[i], lists.world[i], core_block)
        return
    _add_block(b, lists.tangent[i], lists.face[i], lists.world[i], outer_block)
    pushed = wp.transpose(lists.anchor_by_point[i]) * lists.anchor[i]
    for a in range(3):
        wp.atomic_add(right, lists.node[i, a], lists.felt[i, a] + b[a] * pushed)


@wp.kernel
def _pull(
    # In:
    lists: _Lists,
    balance: wp.array(dtype=vec3),
    # In and out:
    last: wp.array(dtype=vec3),
    outer_touching: wp.array2d(dtype=int),
    core_touching: wp.array2d(dtype=int),
):
    """What the balance says of samples: cotangents of forces, of anchors and nodes when the step began. No
    face touches afterwards."""
    i = wp.tid()
    if i >= lists.span[1]:
        return
    i += lists.span[0]
    b = lists.weight[i]
    f = lists.collected[i]
    for a in range(3):
        f += b[a] * balance[lists.node[i, a]]
    lists.force[i] = f
    if lists.core[i] == 1:
        core_touching[lists.face[i], lists.world[i]] = 0
        return
    outer_touching[lists.face[i], lists.world[i]] = 0
    before = lists.before[i]
    if before == -1:
        return
    felt = wp.transpose(lists.force_by_before[i]) * f
    felt += wp.transpose(lists.anchor_by_before[i]) * lists.anchor[i]
    if before >= 0:
        lists.anchor[before] = felt
        return
    for a in range(3):
        wp.atomic_add(last, lists.node[i, a], b[a] * felt)


@wp.kernel
def _take(value: wp.array(dtype=real), out: wp.array(dtype=real)):
    w = wp.tid()
    out[w] = value[w]


@wp.kernel
def _meet(
    # In:
    chunk: int,
    balance: wp.array2d(dtype=vec3),
    there: wp.array2d(dtype=vec3),
    here: wp.array2d(dtype=vec3),
    # Out:
    part_out: wp.array3d(dtype=real),
):
    c, w = wp.tid()
    other = real(0.0)
    own = real(0.0)
    for i in range(c * chunk, wp.min((c + 1) * chunk, balance.shape[0])):
        other += wp.dot(balance[i, w], there[i, w])
        own += wp.dot(balance[i, w], here[i, w])
    part_out[0, c, w] = other
    part_out[1, c, w] = own


@wp.kernel(module=f"{__name__}.sums")
def _add_up(part: wp.array3d(dtype=real), sum: wp.array2d(dtype=real)):
    k, w, t = wp.tid()
    total = total_of(part, k, w, t)
    if t == 0:
        sum[k, w] = sum[k, w] + total


class Sweep:
    """The program of a step, and what it works on.

    Args:
      worlds: whose steps.

    Attributes:
      lists: `_Lists`. last: (nvert, nworld, 3) cotangents of the nodes when the step began, a tensor; they
        join the next right-hand side. by_rubber: (2, nworld) sums over the steps of the balance times the
        rubber's forces at another second constant of the law (`other`), and at its own.
      captures: whether steps are captured on CUDA; off: launched as they come, to look for errors.
      recorded: whether steps run as a captured graph. products: of the last pass, in all its steps.
    """

    captures = True

    def __init__(self, worlds: SkinOfWorlds):
        self._worlds, self._room, self._program, self._graph = worlds, (0, 0), None, None
        data, steps, model = worlds.data, worlds.steps, worlds.model
        k, w = steps.k, worlds.nworld
        self._double = worlds.double
        vectors = k.p, k.q, k.r, k.z, k.part
        self.solver = Gmres(
            data.precision, k.chunk, model.free_mask, *vectors, data.worlds.running, worlds.precision
        )
        with wp.ScopedDevice(worlds.device):
            self._last, self._there, self._here = (wp.zeros_like(data.x) for _ in range(3))
            self._held = wp.zeros((model.nvert, w), dtype=real)
            self._part = wp.zeros((2, k.nchunk, w), dtype=real)
            self._sum = wp.zeros((2, w), dtype=real)
            self._other, self._own = (wp.zeros(w, dtype=real) for _ in range(2))
            self.lists = _Lists()
            self.lists.span = wp.zeros(2, dtype=int)
            self._none = wp.zeros((0, w), dtype=int), wp.zeros((0, w), dtype=mat33)
        self.last, self.by_rubber, self.other, self.own = map(
            wp.to_torch, (self._last, self._sum, self._other, self._own)
        )
        self._right, self._x = wp.to_torch(self.solver.right), wp.to_torch(data.x)
        self._span = wp.to_torch(self.lists.span)
        self.tensors = {}

    @property
    def recorded(self) -> bool:
        return self._graph is not None

    @property
    def products(self) -> int:
        return int(self.solver.taken.numpy()[2])

    def begin(self, count: int, most: int) -> None:
        """Makes room for so many samples in all, and so many in one step, and zeroes sums."""
        worlds, st, k = self._worlds, self._worlds.data.worlds, self._worlds.steps.k
        if count > self._room[0] or most > self._room[1] or self._program is None:
            self._room = int(_ROOM * count) + 1, int(_ROOM * most) + 1
            self._make_room(self._room[0])
            self._graph = self._program = None
            if worlds.device.is_cuda:
                compile_kernels(worlds.device, self._record)
            me = weakref.proxy(self)  # a circle would keep its memory until the garbage collector passes
            self._program = Program(worlds.device, lambda program: me._record(program))
        worlds.on.fill_(1)
        st.active.fill_(1)
        st.viscosity.zero_()
        k.worth.fill_(1.0)  # of no account: an update has no residual here
        k.r.zero_()
        for array in (self._last, self._sum, self.solver.failed, self.solver.taken):
            array.zero_()
        for surface in (worlds.data.outer, worlds.data.core):
            if surface:
                surface.touching.zero_()

    def _make_room(self, count):
        kinds = {
            (wp.int32, ()): ("face", "world", "core", "before"),
            (wp.int32, (3,)): ("node",),
            (vec3, (3,)): ("weight", "collected", "anchor", "force"),
            (vec3, (3, 3)): ("felt",),
            (mat33, (3, 3)): ("tangent", "anchor_by_point", "force_by_before", "anchor_by_before"),
        }
        for (kind, shape), names in kinds.items():
            number = torch.int32 if kind is wp.int32 else torch.float64
            for name in names:
                made = torch.zeros((count, *shape), dtype=number, device=self._worlds.torch_device)
                self.tensors[name] = made
                setattr(self.lists, name, wp.from_torch(made, dtype=kind))

    def run(self, x: torch.Tensor, cotangent: torch.Tensor, span: torch.Tensor) -> None:
        """A step that ended at x (nvert, nworld, 3).

        Args:
          cotangent: of x, as what comes out. span: (2,) int, of the device: of its samples.
        """
        self._x.copy_(x)
        torch.add(self.last, cotangent, out=self._right)
        self.last.zero_()
        self._span.copy_(span)
        if not (self._worlds.device.is_cuda and self.captures):
            self._program.run()
            return
        if self._graph is None:
            # PyTorch's products have a workspace for each thread and stream, which no capture may make
            self._worlds.steps.put_inverse(Launcher(self._worlds.device), self._worlds.steps.k.r)
            with wp.ScopedCapture(self._worlds.device) as capture:
                self._program.run()
            self._graph = capture.graph
        wp.capture_launch(self._graph)

    def _record(self, program):
        worlds, solver, lists, most = self._worlds, self.solver, self.lists, self._room[1]
        data, steps, double = worlds.data, worlds.steps, self._double
        st, k, outer, core = data.worlds, steps.k, data.outer, data.core
        inner = (core.touching, core.block) if core else self._none
        marks = [outer.touching, outer.block, *inner]
        program.launch(_mark, most, [lists], marks)
        right = solver.right.flatten()
        program.launch(_push, most, [lists], [outer.block, inner[1], right])
        e = k.elements
        for lam, force in ((self._other, self._there), (self._own, self._here)):
            program.launch(_take, worlds.nworld, [lam], [data.rubber.lam])
            e.push_corners(program, data.x, worlds.on, st.inverted)
            program.launch(sum_corners, force.shape, [e.start, e.slot, e.corner_force], [force])
        if double is not e:  # whose products take what this keeps
            double.push_corners(program, data.x, worlds.on, st.inverted)
        steps.put_preconditioner(program)

        def exact():
            worlds.put_product_in_double(program, solver.x, solver.product, self._held)

        def product():
            steps.put_product(program)

        solver.put(program, product, exact, lambda r: steps.put_inverse(program, r))
        balance = [solver.x.flatten()]
        program.launch(_pull, most, [lists, *balance], [self._last.flatten(), outer.touching, inner[0]])
        forces = [k.chunk, solver.x, self._there, self._here]
        program.launch(_meet, (k.nchunk, worlds.nworld), forces, [self._part])
        program.launch_blocks(_add_up, [2, worlds.nworld], [self._part], [self._sum], BLOCK)


def pull_back(
    worlds: SkinOfWorlds,
    sweep: Sweep,
    records: list,
    x: torch.Tensor,
    pos: np.ndarray,
    mat: np.ndarray,
    friction: np.ndarray,
    numbers: np.ndarray,
    nodes: torch.Tensor,
    wrench: torch.Tensor,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Cotangents of poses (nworld, nstep, ngeom, 6), frictions (nworld, ngeom) and numbers (nworld, 3) from
    those of nodes (nworld, nstep, nvert, 3) and wrenches (nworld, nstep, ngroup, 6).

    Args:
      sweep: of the worlds. records, x: of the steps, see `SkinOfWorlds.follow`.
      pos, mat, friction, numbers: what that was given.

    Raises:
      ValueError: a step's adjoint was not solved.
    """
    worlds.write(friction, numbers)
    wp.copy(worlds.data.worlds.softness, worlds.softness)
    device, w, ngeom = worlds.torch_device, worlds.nworld, worlds.geoms.count
    wrench, nodes = wrench.to(device), nodes.to(device)
    stiffness = wp.to_torch(worlds.data.worlds.contact_stiffness)
    own = touched_by_geoms(worlds, records, x, stiffness, *map(worlds.tensor, (pos, mat, friction)))
    parts = [own]
    if worlds.data.core:
        parts.append(touched_by_core(worlds, records, x, stiffness))
    group = worlds.tensor(np.asarray(worlds.geoms.groups, np.int64))
    of_sample = wrench[own.world, own.step, group[own.kind]]
    place, spans = _fill(sweep, parts, of_sample)
    lam, mu = (wp.to_torch(getattr(worlds.data.rubber, name)).clone() for name in ("lam", "mu"))
    sweep.own.copy_(lam)
    sweep.other.copy_(_another(lam, mu, worlds.model.elements.cap))
    for t in reversed(range(len(records))):
        sweep.run(x[t + 1], nodes[:, t].transpose(0, 1), spans[t])
    refuse_unsolved(sweep.solver.failed.numpy())

    def by(slope, six):
        return torch.einsum("mij,mi->mj", slope, six)

    s = own.slopes
    force, anchor = (sweep.tensors[name][place[0]] for name in ("force", "anchor"))
    six = torch.cat([force, anchor], 1)
    # numbers of pose (world, step, geom)
    nstep = len(records)
    pose = torch.zeros((w * nstep * ngeom, 6), dtype=six.dtype, device=device)
    first = (own.step - 1).clamp(min=0)
    at, then = ((own.world * nstep + t) * ngeom + own.kind for t in (own.step, first))
    pose.index_add_(0, at, by(s.by_pose, six))
    pose.index_add_(0, then[s.new], by(s.by_pose_last, six[s.new]))
    by_friction = torch.zeros(w * ngeom, dtype=six.dtype, device=device)
    by_friction.index_add_(0, own.world * ngeom + own.kind, by(s.by_friction, six)[:, 0])
    stiff = torch.zeros(w, dtype=six.dtype, device=device)
    stiff.index_add_(0, own.world, own.at.area * by(s.by_springs, six)[:, 0])
    for there, at in zip(parts[1:], place[1:]):
        felt = by(there.slopes.by_springs[:, :3], sweep.tensors["force"][at])
        stiff.index_add_(0, there.world, there.at.area * felt[:, 0])
    there, here = sweep.by_rubber
    by_lam = (there - here) / (sweep.other - lam)
    by_number = torch.stack([(here - lam * by_lam) / mu, by_lam, stiff], 1)
    pose = pose.reshape(w, nstep, ngeom, 6)
    return tuple(a.cpu().numpy() for a in (pose, by_friction.reshape(w, ngeom), by_number))


def _another(lam, mu, cap):
    """Another second constant of the law, on the same side of `Tetrahedra.cap`, see
    `Skin.another_lam`."""
    return torch.where(lam > cap * mu, 2 * lam, 0.5 * torch.where(lam == 0, mu, lam))


def _fill(sweep, parts, wrench):
    """Puts samples of surfaces into lists, step by step; wrench: (m, 6) cotangents at those of the first.
    Returns for each surface where its samples are, and each step's first one and number (nstep, 2)."""
    own = parts[0]
    device, counts = own.face.device, [np.diff(part.start) for part in parts]
    total = sum(counts)
    starts = np.concatenate([[0], np.cumsum(total)[:-1]])
    place, ahead = [], starts.copy()
    for part, count in zip(parts, counts):
        shift = torch.from_numpy(ahead - part.start[:-1]).to(device)
        place.append(torch.arange(len(part.face), device=device) + shift[part.step])
        ahead = ahead + count
    sweep.begin(int(total.sum()), int(total.max()))
    lists = sweep.tensors
    for core, (part, at) in enumerate(zip(parts, place)):
        s = part.slopes
        lists["node"][at] = part.at.node.int()
        lists["weight"][at] = part.at.weight
        for name in ("face", "world"):
            lists[name][at] = getattr(part, name).int()
        lists["core"][at] = core
        lists["tangent"][at] = -s.by_point[:, :3].transpose(1, 2)
    at, s = place[0], own.slopes
    before = torch.where(own.before >= 0, at[own.before.clamp(min=0)], own.before) if len(at) else own.before
    lists["before"][at] = before.int()
    lists["anchor"].zero_()
    lists["collected"].zero_()
    lists["collected"][at] = torch.einsum("mij,mi->mj", s.collect, wrench)
    lists["felt"][at] = torch.einsum("mij,mi->mj", s.wrench_by_node, wrench).view(-1, 3, 3)
    lists["anchor_by_point"][at] = s.by_point[:, 3:]
    by_before = s.by_stick.clone()
    by_before[s.new] = s.by_last
    lists["force_by_before"][at], lists["anchor_by_before"][at] = by_before[:, :3], by_before[:, 3:]
    spans = torch.from_numpy(np.stack([starts, total], 1).astype(np.int32)).to(device)
    return place, spans
