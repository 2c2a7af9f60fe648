"""Presses of the nearly incompressible preset to 2.4 mm with the full FEM: does every step find balance, and
what does it cost?

    python benchmarks/rubber.py --json out/rubber.json [--skins coarse,default] [--indenters
    sphere_7mm,cube_14mm] [--material ansys]

At x = -12 mm on the pad's midline, along the inward normal, steps of 0.1 mm. iterations: of Newton, all
steps. seconds: processor time of the skin's steps alone. least det F: at the integration points, over all
steps. in core: the deepest corner of an inner face."""

import os

# before numpy reads them
os.environ.update(OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1", MKL_NUM_THREADS="1")

import argparse
import functools
import pathlib
import sys

import numpy as np
import warp as wp

sys.path.insert(0, str(pathlib.Path(__file__).parent))

from condensed import run
from records import write_json

from biotac_mj.skin import PRESETS, SkinModel
from biotac_mj.skin.contact.penetration import rest_gap

__all__ = ["main", "press", "shape"]

LOCATION, STEP = (-12e-3, 0.0), 10e-3  # [m, rad]; [s], at 10 mm/s


def shape(model, vert_xpos) -> tuple[float, float]:
    """Least det F at the integration points of a skin at vert_xpos (nvert, 3), and how deep its inner faces
    are in the core [m]."""
    mesh = model.elements.mesh
    at = vert_xpos[mesh.elem.numpy().T]
    edges = np.einsum("eai,qak->eqik", at, mesh.shape.numpy())
    jacobian = np.linalg.det(edges @ mesh.inverse.numpy())
    face, core = model.core_surface.face_np, model.core(1).struct
    corner = wp.array(face.reshape(-1, 1).repeat(3, 1), dtype=wp.vec3i)  # a "face" of one node
    gap = wp.zeros(len(corner), dtype=wp.float64)
    sample = wp.array([[1.0, 0.0, 0.0]], dtype=wp.vec3d)
    x = wp.array(np.asarray(vert_xpos, float)[:, None], dtype=wp.vec3d, ndim=2)
    wp.launch(rest_gap, (len(corner), 1), [corner, sample, core, x], [gap])
    return float(jacobian.min()), float(-gap.numpy().min())


@functools.cache
def press(
    skin: str, indenter: str, material: str = "ansys", depth: float = 2.4e-3, timestep: float = STEP
) -> dict:
    """Force [N] and pressure [Pa] by step, what the steps cost, and the worst shape of the skin."""
    record, results, seconds = run("full", skin, indenter, LOCATION, material, depth, timestep)
    model = SkinModel(record.geometry, PRESETS[material])
    jacobian, inside = zip(*(shape(model, r.vert_xpos) for r in results), strict=True)
    return {
        "skin": skin,
        "indenter": indenter,
        "depth_mm": [float(1e3 * d) for d in record.depth[1:]],
        "force_N": [float(np.linalg.norm(r.wrench[0, :3])) for r in results],
        "pressure_Pa": [r.pressure for r in results],
        "steps": len(results),
        "not_converged": sum(not r.converged for r in results),
        "iterations": sum(r.iterations for r in results),
        "seconds": float(seconds[:, 1].sum()),
        "slowest_step_s": float(seconds[:, 1].max()),
        "least_jacobian": min(jacobian),
        "deepest_in_core_um": 1e6 * max(inside),
    }


def main(arguments=None) -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--json", required=True, help="file to write")
    parser.add_argument("--skins", default="coarse,default")
    parser.add_argument("--indenters", default="sphere_7mm,cube_14mm")
    parser.add_argument("--material", default="ansys")
    options = parser.parse_args(arguments)
    wp.config.quiet = True
    rows = []
    print(
        "| skin | indenter | force N | iterations | not converged | seconds | slowest step s | least det F "
        "| in core um |\n|" + 9 * "---|"
    )
    for skin in options.skins.split(","):
        for indenter in options.indenters.split(","):
            r = press(skin, indenter, options.material)
            rows.append(r)
            print(
                f"| {skin} | {indenter} | {r['force_N'][-1]:.2f} | {r['iterations']} | {r['not_converged']} "
                f"of {r['steps']} "
                f"| {r['seconds']:.1f} | {r['slowest_step_s']:.1f} | {r['least_jacobian']:.2f} | "
                f"{r['deepest_in_core_um']:.0f} |",
                flush=True,
            )
            write_json(options.json, rows)


if __name__ == "__main__":
    main()
