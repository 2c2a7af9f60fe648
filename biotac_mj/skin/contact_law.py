"""Contact beyond Coulomb and push: friction whose coefficient falls with pressure, and adhesion with hysteresis.

Both act at the samples inside the faces, as contact itself does (`contact`), each on its share of the face's area:

- mu = friction (p / friction_pressure)^-friction_exponent, p the push on a node over its area, linear between nodes (flat faces touch
  round bodies in spots, whose pressure is the mesh's). With exponent 1 the shear stress is one number whatever the pressure (smooth
  rubber: Sahli et al., PNAS 2018); Hertz's contact turns p^-n into N^(-n/3).
- traction t(g) at the gap g: the contact's own spring k carries on into tension up to the peak 2 W / range, then the traction falls
  in a straight line to zero at `adhesion_range`. The area under it is W, the work of adhesion, whatever k. A sample that has touched
  is parted by `adhesion_hysteresis` times W until it is out of range: both laws have one branch where it touches, so that within a
  step traction has a potential and energy is lost only by parting.
"""

import dataclasses
import math

import numpy as np
import warp as wp

from .contact import Geoms
from .elasticity import gather
from .shapes import distance, distance_bound
from .types import mat33, real, vec3

__all__ = ["ContactLaw", "WorldLaws", "lawful_contact_force", "world_laws"]

wp.set_module_options({"enable_backward": False})

_LEAST = 1e-2  # of friction_pressure: below this pressure the coefficient stays
_RESOLVED = 4.0  # range^2 = this W h / E*: softening then takes half of the stiffness E* / h of a patch as wide as a face


@dataclasses.dataclass(frozen=True)
class ContactLaw:
    """Friction and adhesion of a skin with what touches it; the defaults are Coulomb's law and none.

    Attributes:
      friction_exponent: n in mu = friction (p / friction_pressure)^-n; the geoms' `friction` is the coefficient at that pressure.
      friction_pressure: [Pa]; the default is what a sphere of 7 mm presses with at 1 N (Hertz: 0.24 MPa on the average). Below a
        hundredth of it mu stays.
      adhesion: work of adhesion W [J/m^2] of surfaces that come together. Rubber: 0.02-0.1.
      adhesion_hysteresis: factor on W once surfaces have touched.
      adhesion_range: gap at which adhesion ends [m]; None takes the shortest that the mesh resolves, sqrt(4 W h / E*) with the work that
        parts the surfaces and h the length of the outer faces' edges. A shorter one snaps face by face.

    Raises:
      ValueError: a value is out of its range.
    """

    friction_exponent: float = 0.0
    friction_pressure: float = 3e5
    adhesion: float = 0.0
    adhesion_hysteresis: float = 1.0
    adhesion_range: float | None = None

    def __post_init__(self):
        if not -1 <= self.friction_exponent <= 2:
            raise ValueError(f"friction_exponent is {self.friction_exponent}: pass a number from -1 to 2; 0 is Coulomb's law")
        if not (math.isfinite(self.friction_pressure) and self.friction_pressure > 0):
            raise ValueError(f"friction_pressure is {self.friction_pressure}: pass a positive number of Pa")
        if not (math.isfinite(self.adhesion) and self.adhesion >= 0):
            raise ValueError(f"adhesion is {self.adhesion}: pass a work >= 0 in J/m^2")
        if not (math.isfinite(self.adhesion_hysteresis) and self.adhesion_hysteresis >= 1):
            raise ValueError(f"adhesion_hysteresis is {self.adhesion_hysteresis}: parting takes at least the work of joining, pass >= 1")
        if self.adhesion_range is not None and not (math.isfinite(self.adhesion_range) and self.adhesion_range > 0):
            raise ValueError(f"adhesion_range is {self.adhesion_range}: pass a positive length in m, or None")


@wp.struct
class Laws:
    """One number for each world: n; W of coming together and of parting [J/m^2]; range [m]. For all: p0 [Pa]; nodal areas [m^2]."""

    exponent: wp.array(dtype=real)
    work: wp.array(dtype=real)
    parting: wp.array(dtype=real)
    reach: wp.array(dtype=real)
    pressure: real
    node_area: wp.array(dtype=real)


class WorldLaws:
    """The model's ContactLaw in every world; a world may have its own exponent and work.

    Args:
      model: SkinModel on the CPU with a contact law; nworld: number of worlds.

    Attributes:
      range: (nworld,) at which adhesion ends [m].
    """

    def __init__(self, model, nworld):
        self.law, self.nworld = model.options.contact_law, nworld
        self.stiffness = model.contact_stiffness
        face, vert = model.outer.face_np, model.geometry.vert
        self.edge = float(np.linalg.norm(vert[face] - vert[np.roll(face, 1, 1)], axis=2).mean())
        self.modulus = model.material.youngs_modulus / (1 - model.material.poissons_ratio**2)
        self.struct = Laws()
        self.struct.pressure = self.law.friction_pressure
        area = np.bincount(face.ravel(), np.repeat(model.outer.area.numpy() / 3, 3), len(vert))
        self.struct.node_area = wp.array(area, dtype=real, device="cpu")
        self.node_push = wp.zeros((len(vert), nworld), dtype=vec3, device="cpu")
        for name in ("exponent", "work", "parting", "reach"):
            setattr(self.struct, name, wp.zeros(nworld, dtype=real, device="cpu"))
        self.bond = wp.full((len(face) * len(model.sample), nworld), -1, dtype=int, device="cpu")
        self.set(self.law.friction_exponent, self.law.adhesion)

    @property
    def range(self) -> np.ndarray:
        return self.struct.reach.numpy().copy()

    def set(self, friction_exponent=None, adhesion=None):
        """Gives each world its law, from the next step on.

        Args:
          friction_exponent, adhesion: (nworld,) or a number; see `ContactLaw`. None leaves them.

        Raises:
          ValueError: a value out of its range, or adhesion whose range is too short for the contact's stiffness.
        """
        s = self.struct
        n = s.exponent.numpy() if friction_exponent is None else np.asarray(friction_exponent, float)
        work = s.work.numpy() if adhesion is None else np.asarray(adhesion, float)
        for name, value in (("friction_exponent", n), ("adhesion", work)):
            if value.shape not in ((), (self.nworld,)):
                raise ValueError(f"{name} has shape {value.shape}: pass one number or ({self.nworld},)")
            for one in np.unique(value):
                dataclasses.replace(self.law, **{name: float(one)})  # refuses what no law can have
        parting = work * self.law.adhesion_hysteresis
        reach = np.sqrt(_RESOLVED * parting * self.edge / self.modulus) if self.law.adhesion_range is None else self.law.adhesion_range
        reach = np.where(parting > 0, reach, 0.0)
        if (4 * parting > self.stiffness * reach**2).any():
            raise ValueError(
                f"adhesion_range {np.max(reach):g} m is too short for a work of {np.max(parting):g} J/m^2: the contact's own springs of "
                f"{self.stiffness:g} Pa/m stretch by half of it; take a range above {2 * np.sqrt(np.max(parting) / self.stiffness):.1e} m"
            )
        for array, value in ((s.exponent, n), (s.work, work), (s.parting, parting), (s.reach, reach)):
            array.fill_(0.0)
            array.numpy()[:] = value

    @property
    def pulls(self) -> bool:
        """Whether there is adhesion in any world."""
        return bool(self.struct.parting.numpy().any())

    def inputs(self, launch, state, sample, stiffness, geoms, x) -> list:
        """What `lawful_contact_force` needs beyond `contact.contact_force`: the laws, and how the geoms push the nodes now."""
        if self.struct.exponent.numpy().any():
            surface = state.surface
            launch(push, state.touching.shape, [surface.face, surface.area, sample, stiffness, geoms.struct, x], [state.corner])
            launch(gather, x.shape, [surface.start, surface.slot, state.corner, 1.0, 0], [self.node_push])
        return [self.struct, self.node_push]

    def check(self, geoms):
        """Refuses meshes whose distance is not exact as far as adhesion reaches (ValueError)."""
        spacing = geoms.struct.grids.spacing.numpy()
        reach = self.struct.reach.numpy().max()
        if len(spacing) and reach > 0.4 * spacing.min():
            raise ValueError(
                f"adhesion reaches {reach * 1e6:.0f} um, and the distance to a mesh geom is exact within {0.4e6 * spacing.min():.0f} um: "
                "bake its grid with a larger spacing, or shorten adhesion_range"
            )


def world_laws(model, nworld, resident, outer) -> WorldLaws | None:
    """WorldLaws of a model that has a contact law, known to the outer surface's ContactState; else None.

    Raises:
      ValueError: the state is resident, or on CUDA.
    """
    if model.options.contact_law is None:
        return None
    if resident or model.device.is_cuda:
        raise ValueError(
            "a contact law (load-dependent friction, adhesion) is solved on the CPU's full tier only: choose device='cpu' and "
            "resident=False, or leave contact_law out of SkinOptions"
        )
    laws = WorldLaws(model, nworld)
    outer.bond = laws.bond
    return laws


@wp.func
def normal_traction(k: real, peak: real, reach: real, gap: real):
    """Push (negative: pull) per area and its slope where it is not softening, for contact springs k; all three in one unit of area."""
    if k * gap <= peak:
        return wp.vec2d(-k * gap, k)
    return wp.vec2d(-peak * (reach - gap) / (reach - peak / k), real(0.0))


@wp.kernel
def push(
    # In:
    face: wp.array(dtype=wp.vec3i),
    area: wp.array(dtype=real),
    sample: wp.array(dtype=vec3),
    stiffness: real,
    geoms: Geoms,
    x: wp.array2d(dtype=vec3),
    # Out:
    corner_out: wp.array2d(dtype=vec3),
):
    """Size of the normal push on the corners of every face [N], as the first component."""
    f, w = wp.tid()
    t = face[f]
    c0 = x[t[0], w]
    center = (c0 + x[t[1], w] + x[t[2], w]) / real(3.0)
    radius = wp.max(wp.length(c0 - center), wp.max(wp.length(x[t[1], w] - center), wp.length(x[t[2], w] - center)))
    total = vec3()
    k = stiffness * area[f] / real(sample.shape[0])
    for g in range(geoms.count):
        R = wp.transpose(geoms.mat[g, w])
        y = R * (center - geoms.pos[g, w])
        if distance_bound(geoms.kind[g], geoms.size[g], geoms.rounding[g], geoms.grids, geoms.grid[g], y) < radius:
            for s in range(sample.shape[0]):
                b = sample[s]
                y = R * (b[0] * c0 + b[1] * x[t[1], w] + b[2] * x[t[2], w] - geoms.pos[g, w])
                dn = distance(geoms.kind[g], geoms.size[g], geoms.rounding[g], geoms.grids, geoms.grid[g], y)
                total += wp.max(-k * dn[3], real(0.0)) * b
    for c in range(3):
        corner_out[3 * f + c, w] = vec3(total[c], real(0.0), real(0.0))


@wp.func
def touch_sample(
    i: int,
    w: int,
    b: vec3,
    t: wp.vec3i,
    x0: vec3,
    x1: vec3,
    x2: vec3,
    k: real,
    kt: real,
    share: real,
    node_push: wp.array2d(dtype=vec3),
    laws: Laws,
    geoms: Geoms,
    x_last: wp.array2d(dtype=vec3),
    anchor_geom: wp.array2d(dtype=int),
    anchor: wp.array2d(dtype=vec3),
):
    """Contact of sample i with its share of area [m^2]: geom (-1: none), the geom that it has touched, force [N], its tangent [N/m],
    anchor."""
    p = b[0] * x0 + b[1] * x1 + b[2] * x2
    touched = int(-1)
    gap = laws.reach[w]
    normal = vec3()
    local = vec3()
    for g in range(geoms.count):
        R = geoms.mat[g, w]
        y = wp.transpose(R) * (p - geoms.pos[g, w])
        dn = distance(geoms.kind[g], geoms.size[g], geoms.rounding[g], geoms.grids, geoms.grid[g], y)
        if dn[3] < gap:
            gap = dn[3]
            touched = g
            normal = vec3(dn[0], dn[1], dn[2])
            local = y
    force = vec3()
    K = mat33()
    stick = local
    bond = int(-1)
    if touched >= 0:
        joined = real(2.0) * laws.work[w] * share  # peak force times range
        work = joined
        if anchor_geom[i, w] == touched:
            work = real(2.0) * laws.parting[w] * share
            bond = touched
        peak = real(0.0)
        if laws.reach[w] > real(0.0):
            peak = work / laws.reach[w]
            joined = joined / laws.reach[w]
        if k * gap <= joined:
            bond = touched
        tn = normal_traction(k, peak, laws.reach[w], gap)
        fn = tn[0]
        force = fn * normal
        nn = wp.outer(normal, normal)
        K = tn[1] * nn
        mu = geoms.friction[touched, w]
        if mu > real(0.0) and fn > real(0.0):
            if laws.exponent[w] != real(0.0):
                pressure = real(0.0)
                for c in range(3):
                    pressure += b[c] * node_push[t[c], w][0] / laws.node_area[t[c]]
                pressure = wp.max(pressure, real(_LEAST) * laws.pressure)
                mu = mu * wp.pow(pressure / laws.pressure, -laws.exponent[w])
            if anchor_geom[i, w] == touched:
                stick = anchor[i, w]
            else:
                last = b[0] * x_last[t[0], w] + b[1] * x_last[t[1], w] + b[2] * x_last[t[2], w]
                stick = wp.transpose(geoms.mat_last[touched, w]) * (last - geoms.pos_last[touched, w])
            slip = local - stick
            slip = slip - wp.dot(slip, normal) * normal
            length = wp.length(slip)
            tangent = wp.identity(n=3, dtype=real) - nn
            if kt * length <= mu * fn:
                force = force - kt * slip
                K = K + kt * tangent
            else:
                along = slip / length
                force = force - mu * fn * along
                K = K + mu * fn / length * (tangent - wp.outer(along, along))
                stick = local - mu * fn / kt * along
        R = geoms.mat[touched, w]
        force = R * force
        K = R * K * wp.transpose(R)
    return touched, bond, force, K, stick


@wp.kernel
def lawful_contact_force(
    # In:
    face: wp.array(dtype=wp.vec3i),
    area: wp.array(dtype=real),
    sample: wp.array(dtype=vec3),
    stiffness: real,
    stick_ratio: real,
    geoms: Geoms,
    x: wp.array2d(dtype=vec3),
    x_last: wp.array2d(dtype=vec3),
    anchor_geom: wp.array2d(dtype=int),
    anchor: wp.array2d(dtype=vec3),
    laws: Laws,
    node_push: wp.array2d(dtype=vec3),
    # Out:
    corner_out: wp.array2d(dtype=vec3),
    block_out: wp.array2d(dtype=mat33),
    touching_out: wp.array2d(dtype=int),
    geom_out: wp.array2d(dtype=int),
    anchor_out: wp.array2d(dtype=vec3),
    force_out: wp.array2d(dtype=vec3),
    bond_out: wp.array2d(dtype=int),
):
    """As `contact.contact_force`; bond_out: the geom that a sample is in contact with, or has been and is still in range of."""
    f, w = wp.tid()
    nsample = sample.shape[0]
    t = face[f]
    x0 = x[t[0], w]
    x1 = x[t[1], w]
    x2 = x[t[2], w]
    center = (x0 + x1 + x2) / real(3.0)
    radius = wp.sqrt(wp.max(wp.length_sq(x0 - center), wp.max(wp.length_sq(x1 - center), wp.length_sq(x2 - center))))
    near = int(0)
    for g in range(geoms.count):
        R = geoms.mat[g, w]
        y = wp.transpose(R) * (center - geoms.pos[g, w])
        bound = distance_bound(geoms.kind[g], geoms.size[g], geoms.rounding[g], geoms.grids, geoms.grid[g], y)
        if bound < radius + laws.reach[w]:
            near = 1
    touching = int(0)
    f0 = vec3()
    f1 = vec3()
    f2 = vec3()
    b00 = mat33()
    b01 = mat33()
    b02 = mat33()
    b11 = mat33()
    b12 = mat33()
    b22 = mat33()
    share = area[f] / real(nsample)
    k = stiffness * area[f] / real(nsample)
    kt = k * stick_ratio
    for s in range(nsample):
        i = f * nsample + s
        geom_out[i, w] = -1
        bond_out[i, w] = -1
        if near == 1:
            b = sample[s]
            touched, bond, force, K, stick = touch_sample(
                i, w, b, t, x0, x1, x2, k, kt, share, node_push, laws, geoms, x_last, anchor_geom, anchor
            )
            if touched >= 0:
                touching = 1
                geom_out[i, w] = touched
                bond_out[i, w] = bond
                anchor_out[i, w] = stick
                force_out[i, w] = force
                f0 += b[0] * force
                f1 += b[1] * force
                f2 += b[2] * force
                b00 += (b[0] * b[0]) * K
                b01 += (b[0] * b[1]) * K
                b02 += (b[0] * b[2]) * K
                b11 += (b[1] * b[1]) * K
                b12 += (b[1] * b[2]) * K
                b22 += (b[2] * b[2]) * K
    touching_out[f, w] = touching
    corner_out[3 * f, w] = f0
    corner_out[3 * f + 1, w] = f1
    corner_out[3 * f + 2, w] = f2
    if touching == 1:
        block_out[6 * f, w] = b00
        block_out[6 * f + 1, w] = b01
        block_out[6 * f + 2, w] = b02
        block_out[6 * f + 3, w] = b11
        block_out[6 * f + 4, w] = b12
        block_out[6 * f + 5, w] = b22
