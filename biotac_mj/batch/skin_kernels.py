"""Kernels of `skin.py`: where a step begins, and its outputs."""

import warp as wp

from ..kernels import kernel_module
from ..skin.contact.posed import Geoms
from ..skin.newton.worlds import CONVERGED, Worlds
from ..skin.types import mat33, real, vec3, vec6

kernel_module(__name__)


@wp.kernel
def read_outputs(
    # In:
    rest_pressure: wp.array(dtype=real),
    has_liquid: int,
    st: Worlds,
    wrench: wp.array3d(dtype=real),
    fraction: wp.array(dtype=real),
    # Out:
    pressure_out: wp.array(dtype=real),
    wrench_out: wp.array2d(dtype=vec6),
):
    """Pressure, and of the wrench on each group the fraction that this skin answers for."""
    w = wp.tid()
    if has_liquid == 1:
        pressure_out[w] = st.pressure[w] - rest_pressure[w]
    for g in range(wrench_out.shape[0]):
        v = vec6()
        for i in range(6):
            v[i] = fraction[g] * wrench[g, w, i]
        wrench_out[g, w] = v


@wp.kernel
def begin_near(
    wanted: wp.array(dtype=int),
    reason: wp.array(dtype=int),
    reset: wp.array(dtype=bool),
    # Out:
    begins_out: wp.array(dtype=int),
):
    """Lets solves of the wanted worlds begin where the previous one of the step has found an equilibrium."""
    w = wp.tid()
    begins_out[w] = wp.where(wanted[w] == 1 and reason[w] == CONVERGED and not reset[w], 1, 0)


@wp.kernel
def scale_tangents(
    fraction: wp.array(dtype=real), path: wp.array(dtype=real), tangent: wp.array2d(dtype=wp.spatial_matrixd)
):
    """Takes of tangents what this skin answers for, and how far what it meets goes with a group."""
    g, w = wp.tid()
    if path[g] != real(1.0):
        tangent[g, w] = fraction[g] * path[g] * tangent[g, w]


@wp.kernel
def begin_at_rest(
    # In:
    fresh: wp.array(dtype=int),
    pos: wp.array(dtype=vec3),
    mat: wp.array(dtype=mat33),
    pos_end: wp.array(dtype=vec3),
    mat_end: wp.array(dtype=mat33),
    dt: wp.array(dtype=real),
    x: wp.array2d(dtype=vec3),
    # Out:
    velocity_out: wp.array2d(dtype=vec3),
):
    """Skins whose first step this is move with their core."""
    i, w = wp.tid()
    if fresh[w] == 1:
        velocity_out[i, w] = ((mat_end[w] - mat[w]) * x[i, w] + pos_end[w] - pos[w]) / dt[w]


@wp.kernel
def begin_frames(
    # In:
    pos: wp.array(dtype=vec3),
    mat: wp.array(dtype=mat33),
    # Out:
    fresh_out: wp.array(dtype=int),
    pos_out: wp.array(dtype=vec3),
    mat_out: wp.array(dtype=mat33),
):
    w = wp.tid()
    fresh_out[w] = 0
    pos_out[w] = pos[w]
    mat_out[w] = mat[w]


@wp.kernel
def forget_poses(
    # In:
    placed: wp.array2d(dtype=int),
    began: wp.array(dtype=int),
    by_mocap: wp.array(dtype=bool),
    awake: wp.array(dtype=int),
    # In and out:
    geoms: Geoms,
):
    """Forgets the last poses of geoms on bodies that were placed [group, world]. After the first step the
    poses of a body that a mocap body moves are its motion. Near a skin that this step leaves at rest they are
    those at its end already."""
    g, w = wp.tid()
    h = geoms.group[g]
    if awake[w] == 1 and placed[h, w] == 1 and not (by_mocap[h] and began[w] == 1):
        geoms.pos_last[g, w] = vec3(real(wp.nan), real(wp.nan), real(wp.nan))


@wp.kernel
def forget_contacts(
    # In:
    on: wp.array(dtype=int),
    nsample: int,
    geoms: Geoms,
    # In and out:
    anchor_geom: wp.array2d(dtype=int),
    # Out:
    touched_out: wp.array(dtype=int),
):
    """Clears the contact of the samples of face f with geoms whose last poses are not known; whether other
    contact is left."""
    f, w = wp.tid()
    if on[w] == 0:
        return
    for i in range(f * nsample, (f + 1) * nsample):
        g = anchor_geom[i, w]
        if g >= 0 and not wp.isfinite(geoms.pos_last[g, w][0]):
            anchor_geom[i, w] = -1
        elif g >= 0:
            touched_out[w] = 1


@wp.kernel
def copy_anchors(
    # In:
    on: wp.array(dtype=int),
    kept: wp.array2d(dtype=int),
    geom: wp.array2d(dtype=int),
    anchor: wp.array2d(dtype=vec3),
    # In and out:
    kept_out: wp.array2d(dtype=int),
    geom_out: wp.array2d(dtype=int),
    anchor_out: wp.array2d(dtype=vec3),
):
    """Copies the contact of face f, see `contact.faces.commit_face`: anchors of faces that have some."""
    w, f = wp.tid()
    has = kept[f, w]
    if on[w] == 0 or (has == 0 and kept_out[f, w] == 0):
        return
    kept_out[f, w] = has
    nsample = geom.shape[0] / kept.shape[0]
    for i in range(f * nsample, (f + 1) * nsample):
        g = int(-1)
        if has == 1:
            g = geom[i, w]
        geom_out[i, w] = g
        if g >= 0:
            anchor_out[i, w] = anchor[i, w]


@wp.kernel
def find_bare(
    # In:
    on: wp.array(dtype=int),
    touched: wp.array(dtype=int),
    began: wp.array(dtype=int),
    # Out:
    bare_out: wp.array(dtype=bool),
):
    """Skins that nothing touches any more since bodies were placed."""
    w = wp.tid()
    bare_out[w] = on[w] == 1 and began[w] == 1 and touched[w] == 0
