"""Factors of the inertias of all worlds of mujoco_warp."""

import typing

import mujoco
import warp as wp

from ...coupling.implicit.compliance import THREADS, factor
from ...kernels import kernel_module
from ...skin.program import Launcher
from ...skin.types import real, vec6
from ..engine import Contacts, Rows, contacts_of, rows_of

if typing.TYPE_CHECKING:
    import mujoco_warp as mjw

kernel_module(__name__)

_CONE = wp.constant(int(mujoco.mjtConstraintState.mjCNSTRSTATE_CONE))
_ELLIPTIC = int(mujoco.mjtCone.mjCONE_ELLIPTIC)


@wp.kernel
def find_hessians(
    # In:
    going: wp.array(dtype=int),
    contact: Contacts,
    rows: Rows,
    stretch: wp.array(dtype=float),
    qacc: wp.array2d(dtype=float),
    # Out:
    cone_out: wp.array2d(dtype=int),
    hessian_out: wp.array2d(dtype=vec6),
):
    """Hessians of the contacts that slide on their elliptic cones: as in MuJoCo, of the cost
    D0 / (mu^2 (1 + mu^2)) (N - mu T)^2 / 2, with N and T the rows' residuals times mu and times friction.

    Args:
      stretch: 1 / sqrt(impratio).
    """
    c = wp.tid()
    if c >= contact.nacon[0]:
        return
    first = contact.efc_address[c, 0]
    w = contact.worldid[c]
    if first < 0 or going[w] == 0 or rows.state[w, first] != _CONE:
        return
    friction = contact.friction[c]
    mu = real(friction[0] * stretch[w % stretch.shape[0]])
    scale = vec6()
    u = vec6()
    square = real(0.0)
    for k in range(contact.dim[c]):
        r = first + k
        left = -real(rows.aref[w, r])
        if rows.sparse == 1:
            for n in range(rows.J_rownnz[w, r]):
                at = rows.J_rowadr[w, r] + n
                left += real(rows.J[w, 0, at]) * real(qacc[w, rows.J_colind[w, 0, at]])
        else:
            for n in range(qacc.shape[1]):
                left += real(rows.J[w, r, n]) * real(qacc[w, n])
        scale[k] = mu
        if k > 0:
            scale[k] = real(friction[k - 1])
            square += scale[k] * left * scale[k] * left
        u[k] = scale[k] * left
    T = wp.max(wp.sqrt(square), real(1e-15))
    slope = mu * u[0] / T
    stiff = real(rows.D[w, first]) / (mu * mu * (real(1.0) + mu * mu))
    for k in range(contact.dim[c]):
        row = vec6()
        for n in range(contact.dim[c]):
            h = slope * u[k] * u[n] / (T * T)
            if k == 0 and n == 0:
                h = real(1.0)
            elif k == 0 or n == 0:
                h = -mu * u[k + n] / T
            elif k == n:
                h += mu * mu - slope
            row[n] = stiff * scale[k] * scale[n] * h
        cone_out[w, first + k] = first
        hessian_out[w, first + k] = row


class Cones:
    """Hessians of mujoco_warp's contacts that slide on elliptic cones, see `compliance.factor`: cone, hessian
    [world, row], empty where its cones are pyramids."""

    def __init__(self, m: "mjw.Model", d: "mjw.Data"):
        self._wanted = m.opt.cone == _ELLIPTIC
        self.rows = d.nworld, d.njmax
        shape = self.rows if self._wanted else (d.nworld, 0)
        with wp.ScopedDevice(d.qpos.device):
            self.cone, self.hessian = wp.full(shape, -1, dtype=int), wp.zeros(shape, dtype=vec6)

    def find(self, m: "mjw.Model", d: "mjw.Data", going: wp.array) -> None:
        """Finds them in worlds that are going (nworld,), after mujoco_warp's constraint solver. Launches
        only."""
        if not self._wanted:
            return
        known = [going, contacts_of(d), rows_of(m, d), m.opt.impratio_invsqrt, d.qacc]
        found = [self.cone, self.hessian]
        wp.launch(find_hessians, d.naconmax, known, found, device=self.cone.device)


class Factor:
    """Cholesky's factors of inertias, with the springs that MuJoCo's constraints are.

    Args:
      m: mujoco_warp Model. nworld: number of worlds. cones: of its Data, which several share.

    Attributes:
      L: (nworld, nv, nv), lower triangles.
    """

    def __init__(self, m: "mjw.Model", nworld: int, cones: Cones):
        self._cones = cones
        self._inertia_rows = [m.M_rownnz, m.M_rowadr, m.M_colind]
        with wp.ScopedDevice(m.qpos0.device):
            self.L = wp.zeros((nworld, m.nv, m.nv), dtype=real)
            self._springs = wp.zeros(cones.rows, dtype=int)
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
        none, no_slot = self._none
        held = [no_slot if own is None else own, d.nefc if springs else none, rows_of(m, d)]
        held += [self._cones.cone, self._cones.hessian]
        if springs:
            self._cones.find(m, d, going)
        known = [going, inertia, *self._inertia_rows, *held]
        found = [self._springs, self.L]
        Launcher(self.L.device).launch_blocks(factor, [len(self.L)], known, found, block_dim=THREADS)
