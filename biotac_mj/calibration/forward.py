"""Forward model: one indentation of many materials in parallel, each material a world of one batch.

Responses are cached on disk, so that an interrupted fit or comparison continues where it stopped."""

import dataclasses
from collections.abc import Callable

import numpy as np

from ..cache import cached
from ..geometry.rigid import matrix
from ..geometry.skin_geometry import SkinGeometry
from ..geometry.surface import face_areas, node_areas
from ..press.indenter import make_indenter
from ..skin import GeomSet, SkinModel, SkinOptions, step
from ..skin.per_world import make_worlds
from ..skin.settings import plain
from .indentation import Indentation

_LARGEST_STEP = 2.5e-4  # [m] longer displacements between two samples are divided into several steps
CODE = ("geometry", "skin", "press/indenter", "calibration/forward")  # which makes a response


@dataclasses.dataclass(frozen=True)
class Response:
    """Response of k materials to one indentation of n samples.

    Attributes:
      force: (k, n, 3) of the skin on the indenter [N].
      peak_norm, mean_norm: (k, n) largest nodal displacement of the outer surface and its mean over the area
        [m].
      nonconverged: (k,) steps that did not converge.
      steps: steps taken.
    """

    force: np.ndarray
    peak_norm: np.ndarray
    mean_norm: np.ndarray
    nonconverged: np.ndarray
    steps: int


def simulate(
    geometry: SkinGeometry,
    options: SkinOptions,
    materials: list,
    indentation: Indentation,
    device: str = "cpu",
    progress: Callable | None = None,
    modulus: np.ndarray | Callable | None = None,
) -> Response:
    """Simulates the indentation once, with every material as a world of one batch.

    The contact stiffness is `options.contact_stiffness`, or each material's own.

    Args:
      geometry, options: the body; options are common to all.
      materials: k Materials with one law; Young's modulus, Poisson's ratio and friction may differ.
      indentation: path and times; its force is not used. Before the first sample the skin is at rest for the
        first interval.
      progress: called after every simulated sample.
      modulus: factors on Young's modulus of the body's elements, see `SkinModel`.

    Raises:
      ValueError: materials with different laws, or an indenter deep inside the rigid core.
    """
    materials = list(materials)

    def make():
        return vars(_simulate(geometry, options, materials, indentation, device, progress, modulus))

    inputs = [*inputs_of(geometry, options, modulus, indentation), materials, str(device).split(":")[0]]
    found = cached("indentation", inputs, make, CODE)
    return Response(**{**found, "steps": int(found["steps"])})


def inputs_of(
    geometry: SkinGeometry,
    options: SkinOptions,
    modulus: np.ndarray | Callable | None,
    indentation: Indentation,
) -> list:
    """Body and path as inputs of `cache.cached`; arguments as for `simulate`."""
    path = make_indenter(indentation.indenter), indentation.time, indentation.tip, indentation.quat
    return [geometry, options, plain(modulus, geometry), *path]


def _simulate(geometry, options, materials, indentation, device, progress, modulus):
    model = SkinModel(geometry, materials[0], options, device, modulus=modulus)
    data = make_worlds(model, len(materials), materials)
    steps, shape = steps_of(indentation)
    geoms = GeomSet(**shape, nworld=len(materials), device=device)
    geoms.set_friction([[m.friction] for m in materials])
    force, norms = [], []
    weight, outer = _outer_weights(geometry)
    for i, (pos, mat, dt) in enumerate(zip(steps.pos, steps.mat, steps.dt)):
        geoms.set_pose(pos, mat)
        step(model, data, geoms, dt)
        if i not in steps.ends:
            continue
        force.append(data.wrench[:, 0, :3])
        norms.append(displacement_norms(data.vert_xpos[:, outer] - geometry.vert[outer], weight))
        if progress:
            progress()
    peak, mean = np.moveaxis(np.array(norms), 0, -1)
    return Response(np.swapaxes(force, 0, 1), peak, mean, data.nonconverged.copy(), len(steps.pos))


@dataclasses.dataclass(frozen=True)
class Steps:
    """Path of an indentation in steps.

    Attributes:
      pos: (nstep, 1, 3) [m], mat: (nstep, 1, 3, 3) of the geom. dt: (nstep,) [s].
      ends: (n,) number of the step that ends at each sample.
    """

    pos: np.ndarray
    mat: np.ndarray
    dt: np.ndarray
    ends: np.ndarray


def steps_of(indentation: Indentation) -> tuple[Steps, dict]:
    """Steps of an indentation, and the indenter as arguments of `skin.GeomSet`."""
    shape = make_indenter(indentation.indenter)
    frame = matrix(indentation.quat / np.linalg.norm(indentation.quat))
    tips, times, ends = [], [], []
    at = indentation.tip[0]
    times_of_samples = np.diff(indentation.time, prepend=2 * indentation.time[0] - indentation.time[1])
    for tip, dt in zip(indentation.tip, times_of_samples):
        count = max(1, int(np.ceil(np.linalg.norm(tip - at) / _LARGEST_STEP - 1e-9)))
        tips += [at + (tip - at) * k / count for k in range(1, count + 1)]
        times += [dt / count] * count
        at = tip
        ends.append(len(tips) - 1)
    pos, mat = shape.pose(np.array(tips), np.tile(frame, (len(tips), 1, 1)))
    return Steps(pos[:, None], mat[:, None], np.array(times), np.array(ends)), shape.geom


def displacement_norms(displacement: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Largest and mean norm of nodal displacements (..., m, 3) [m]; weights of the mean: (m,)."""
    norm = np.linalg.norm(displacement, axis=-1)
    return norm.max(-1), norm @ weight / weight.sum()


def _outer_weights(geometry):
    """Area per node of the outer surface, a third of that of its faces (m,) [m^2], and the nodes (m,)."""
    face, nodes = geometry.outer_face, np.unique(geometry.outer_face)
    area = np.linalg.norm(face_areas(geometry.vert, face), axis=1)
    return node_areas(face, area, geometry.nvert)[nodes], nodes
