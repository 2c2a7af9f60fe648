"""How the touching bodies of a batch give way to wrenches on them: beta h^2 J H^-1 J', for all worlds at
once, and how fast they bounce on the skin.

H is M - h D, with D what the integrator treats implicitly, and the springs that MuJoCo's other constraints
are where its solver left them."""

import typing

import mujoco
import warp as wp

from ...coupling.implicit.rounds import Model
from ...skin.condensed.lanes import sync
from ...skin.program import Launcher
from ...skin.types import real, vec6

if typing.TYPE_CHECKING:
    import mujoco_warp as mjw

__all__ = ["Factor", "Response", "add_powers", "add_stiffness", "drive", "find_frequencies", "substitute"]

wp.set_module_options({"enable_backward": False})


_BLOCK = 64  # threads that factor a world's matrix
_QUADRATIC = wp.constant(int(mujoco.mjtConstraintState.mjCNSTRSTATE_QUADRATIC))
_LEAST = wp.constant(wp.float64(1e-12))  # of a pivot, of the entry that it came from


@wp.kernel
def factor(
    # In:
    going: wp.array(dtype=int),
    inertia: wp.array2d(dtype=float),
    rownnz: wp.array(dtype=int),
    rowadr: wp.array(dtype=int),
    colind: wp.array(dtype=int),
    own: wp.array2d(dtype=int),
    rows: wp.array(dtype=int),
    state: wp.array2d(dtype=int),
    J: wp.array3d(dtype=float),
    D: wp.array2d(dtype=float),
    sparse: int,
    J_rownnz: wp.array2d(dtype=int),
    J_rowadr: wp.array2d(dtype=int),
    J_colind: wp.array3d(dtype=int),
    # Out:
    L_out: wp.array3d(dtype=real),
):
    """Cholesky's factor of the inertia with what constraints now hold, but for a skin's own rows, of which
    the first of six are `own`; by the threads of a block. Of worlds that are going."""
    w, t = wp.tid()
    if going[w] == 0:
        return
    threads = wp.block_dim()
    n = L_out.shape[1]
    for i in range(t, n, threads):
        for j in range(n):
            L_out[w, i, j] = real(0.0)
        for k in range(rownnz[i]):
            L_out[w, i, colind[rowadr[i] + k]] = real(inertia[w, rowadr[i] + k])
    sync()
    for r in range(wp.min(rows[w], state.shape[1])):
        springs = wp.where(state[w, r] == _QUADRATIC, 1, 0)
        for k in range(own.shape[0]):
            if own[k, w] >= 0 and r >= own[k, w] and r < own[k, w] + 6:
                springs = 0
        if springs == 1:
            size = n
            if sparse == 1:
                size = J_rownnz[w, r]
            stiff = real(D[w, r])
            for m in range(t, size * size, threads):
                a = m / size
                b = m % size
                i = a
                j = b
                product = real(0.0)
                if sparse == 1:
                    at = J_rowadr[w, r]
                    i = J_colind[w, 0, at + a]
                    j = J_colind[w, 0, at + b]
                    product = real(J[w, 0, at + a]) * real(J[w, 0, at + b])
                else:
                    product = real(J[w, r, a]) * real(J[w, r, b])
                if i >= j:
                    L_out[w, i, j] = L_out[w, i, j] + stiff * product
            sync()
    sync()
    for j in range(n):
        whole = L_out[w, j, j]
        sync()
        for i in range(j + t, n, threads):
            total = L_out[w, i, j]
            for k in range(j):
                total -= L_out[w, i, k] * L_out[w, j, k]
            L_out[w, i, j] = total
        sync()
        pivot = wp.sqrt(wp.max(L_out[w, j, j], _LEAST * whole))
        sync()
        for i in range(j + t, n, threads):
            L_out[w, i, j] = wp.where(i == j, pivot, L_out[w, i, j] / pivot)
        sync()


@wp.func
def substitute(L: wp.array3d(dtype=real), w: int, c: int, x: wp.array3d(dtype=real)):
    """Solves L L' y = x[w, c] in place, by one thread."""
    n = L.shape[1]
    for i in range(n):
        total = x[w, c, i]
        for k in range(i):
            total -= L[w, i, k] * x[w, c, k]
        x[w, c, i] = total / L[w, i, i]
    for back in range(n):
        i = n - 1 - back
        total = x[w, c, i]
        for k in range(i + 1, n):
            total -= L[w, k, i] * x[w, c, k]
        x[w, c, i] = total / L[w, i, i]


@wp.kernel
def give(
    # In:
    going: wp.array(dtype=int),
    L: wp.array3d(dtype=real),
    jacobian: wp.array3d(dtype=vec6),
    # Out:
    response_out: wp.array3d(dtype=real),
):
    """Accelerations of the degrees of freedom by a unit of the wrench on one body."""
    w, c = wp.tid()
    if going[w] == 0:
        return
    for i in range(L.shape[1]):
        response_out[w, c, i] = jacobian[c / 6, w, i][c % 6]
    substitute(L, w, c, response_out)


@wp.kernel
def move(
    # In:
    going: wp.array(dtype=int),
    square: wp.array2d(dtype=real),
    jacobian: wp.array3d(dtype=vec6),
    response: wp.array3d(dtype=real),
    # Out:
    compliance_out: wp.array4d(dtype=real),
):
    """A column of the compliance: motions of all bodies by that."""
    w, c = wp.tid()
    if going[w] == 0:
        return
    groups = jacobian.shape[0]
    for g in range(groups):
        m = vec6()
        # of two bodies whose steps differ the mean, so that it stays symmetric
        both = wp.sqrt(square[g, w] * square[c / 6, w])
        for i in range(response.shape[2]):
            m += (both * response[w, c, i]) * jacobian[g, w, i]
        for b in range(6):
            compliance_out[groups * g + c / 6, w, b, c % 6] = m[b]


@wp.kernel
def add_stiffness(
    # In:
    jacobian: wp.array3d(dtype=vec6),
    model: Model,
    # In and out:
    stiffness: wp.array3d(dtype=real),
):
    """Adds a skin's stiffness against the degrees of freedom [world, dof, dof], a row by each thread."""
    w, i = wp.tid()
    for g in range(jacobian.shape[0]):
        held = wp.transpose(model.tangent0[g, w]) * jacobian[g, w, i]
        if wp.dot(held, held) > real(0.0):
            for j in range(jacobian.shape[2]):
                stiffness[w, i, j] = stiffness[w, i, j] + wp.dot(held, jacobian[g, w, j])


@wp.kernel
def drive(
    # In:
    stiffness: wp.array3d(dtype=real),
    L: wp.array3d(dtype=real),
    response: wp.array3d(dtype=real),
    # Out:
    driven_out: wp.array3d(dtype=real),
):
    """Accelerations by what all skins do against motions of the degrees of freedom [world, column, dof]."""
    w, c = wp.tid()
    for i in range(stiffness.shape[1]):
        held = real(0.0)
        for j in range(stiffness.shape[1]):
            held += stiffness[w, i, j] * response[w, c, j]
        driven_out[w, c, i] = held
    substitute(L, w, c, driven_out)


@wp.kernel
def add_powers(
    # In:
    stiffness: wp.array3d(dtype=real),
    response: wp.array3d(dtype=real),
    driven: wp.array3d(dtype=real),
    model: Model,
    # Out:
    power_out: wp.array2d(dtype=wp.vec2d),
):
    """What each wrench on a skin's bodies [world, column] adds to the traces of the second and the fourth
    power of the modes, see `SkinGroup.frequencies`."""
    w, c = wp.tid()
    g = c / 6
    second = vec6()
    fourth = vec6()
    if wp.ddot(model.tangent0[g, w], model.tangent0[g, w]) > real(0.0):
        for i in range(stiffness.shape[1]):
            once = real(0.0)
            twice = real(0.0)
            for j in range(stiffness.shape[1]):
                once += stiffness[w, i, j] * response[w, c, j]
                twice += stiffness[w, i, j] * driven[w, c, j]
            for b in range(6):
                second[b] = second[b] + once * response[w, 6 * g + b, i]
                fourth[b] = fourth[b] + twice * driven[w, 6 * g + b, i]
    T = model.tangent0[g, w]
    power_out[w, c] = wp.vec2d((T * second)[c % 6], (T * fourth)[c % 6])


@wp.kernel
def find_frequencies(
    # In:
    taking_part: wp.array(dtype=int),
    power: wp.array2d(dtype=wp.vec2d),
    # Out:
    frequency_out: wp.array2d(dtype=real),
):
    """As `SkinGroup.frequencies`."""
    g, w = wp.tid()
    if taking_part[w] == 0:
        return
    total = wp.vec2d()
    for c in range(6 * g, 6 * g + 6):
        total += power[w, c]
    frequency = real(0.0)
    if total[0] > real(0.0) and total[1] > real(0.0):
        frequency = wp.sqrt(wp.sqrt(total[1] / total[0]))
    frequency_out[g, w] = frequency


class Factor:
    """Cholesky's factors of inertias, with the springs that MuJoCo's constraints are.

    Args:
      m: mujoco_warp Model. nworld: number of worlds.

    Attributes:
      L: (nworld, nv, nv), lower triangles.
    """

    def __init__(self, m: "mjw.Model", nworld: int):
        self._inertia_rows = [m.M_rownnz, m.M_rowadr, m.M_colind]
        with wp.ScopedDevice(m.qpos0.device):
            self.L = wp.zeros((nworld, m.nv, m.nv), dtype=real)
            self._none = wp.zeros(nworld, dtype=int), wp.zeros((0, nworld), dtype=int)

    def find(
        self,
        m: "mjw.Model",
        d: "mjw.Data",
        going: wp.array,
        inertia: wp.array,
        springs: bool = True,
        own: wp.array | None = None,
    ) -> None:
        """Factors the inertias. Launches only.

        Args:
          going: (nworld,) of int, 1 where it is to be done.
          inertia: (nworld, nM) matrices laid out as mujoco_warp's M.
          springs: whether constraints hold, as its solver left them. own: (slot, nworld) the first of six
            rows each that do not.
        """
        efc, (none, no_slot) = d.efc, self._none
        held = [no_slot if own is None else own, d.nefc if springs else none]
        held += [efc.state, efc.J, efc.D, int(m.is_sparse), efc.J_rownnz, efc.J_rowadr, efc.J_colind]
        known = [going, inertia, *self._inertia_rows, *held]
        launcher, n = Launcher(self.L.device), len(self.L)
        if self.L.device.is_cuda:
            launcher.launch_blocks(factor, [n], known, [self.L], block_dim=_BLOCK)
        else:
            launcher.launch(factor, [n, 1], known, [self.L])


class Response:
    """Of the bodies that a skin meets to wrenches on them.

    Args:
      m: mujoco_warp Model. groups: number of the bodies. nworld: number of worlds.

    Attributes:
      response: (nworld, 6 groups, nv) accelerations of the degrees of freedom by a unit of each component.
    """

    def __init__(self, m: "mjw.Model", groups: int, nworld: int):
        self._factor = Factor(m, nworld)
        with wp.ScopedDevice(m.qpos0.device):
            self.response = wp.zeros((nworld, 6 * groups, m.nv), dtype=real)

    @property
    def L(self) -> wp.array:
        """(nworld, nv, nv) Cholesky's factors of what was found last."""
        return self._factor.L

    def find(
        self,
        m: "mjw.Model",
        d: "mjw.Data",
        going: wp.array,
        inertia: wp.array,
        own: wp.array,
        jacobian: wp.array,
    ) -> None:
        """Finds the response of bodies whose Jacobians are (group, world, dof). Launches only.

        Args:
          going: (nworld,) of int, 1 where it is to be done.
          inertia: (nworld, nM) matrices laid out as mujoco_warp's M.
          own: (slot, nworld) the first of six rows each that do not hold.
        """
        self._factor.find(m, d, going, inertia, own=own)
        dim, device = self.response.shape[:2], self.response.device
        wp.launch(give, dim, [going, self._factor.L, jacobian], [self.response], device=device)

    def write(self, going: wp.array, jacobian: wp.array, square: wp.array, compliance: wp.array) -> None:
        """Writes the compliance [group, group, world] of what was found. Launches only.

        Args:
          going: (nworld,) of int, 1 where it is to be done.
          square: [group, world] by which an acceleration moves bodies to where the skin is solved [m per
            m/s^2].
        """
        groups, n, device = jacobian.shape[0], len(self.response), self.response.device
        entries = wp.array(
            ptr=compliance.ptr,
            shape=(groups * groups, n, 6, 6),
            dtype=real,
            device=device,
            copy=False,
        )
        known = [going, square, jacobian, self.response]
        wp.launch(move, (n, 6 * groups), known, [entries], device=device)
