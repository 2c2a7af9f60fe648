"""Gradients of a press, measured: the time of a backward pass beside the forward one, and a fit by gradients
beside the one by differences.

    python benchmarks/differentiable.py --json OUT

All data are synthetic: forces of a simulated skin with known constants, with white noise."""

import argparse
import dataclasses
import json
import pathlib
import time

import numpy as np
import torch

from biotac_mj import differentiable
from biotac_mj.calibration import calibrate, configuration, parameter, plan_shear, simulate
from biotac_mj.calibration.forward import steps_of
from biotac_mj.geometry.rigid import quaternion
from biotac_mj.skin import Material

TRUTH = Material(youngs_modulus=1.2e6, poissons_ratio=0.38, friction=0.5)
START = dataclasses.replace(TRUTH, youngs_modulus=1.5e6, poissons_ratio=0.32, friction=0.6)
FILL = 2e-8  # [m^3]
NOISE = 2e-3  # [N]


def measure_passes(element: str, liquid: bool) -> dict:
    """Seconds of a press forward and backward; both take the same steps."""
    way = plan_shear(skin="coarse")
    steps, geoms = steps_of(way)
    body = configuration("shell_with_core", element=element, liquid=liquid)
    skin = differentiable.Skin(body.geometry, TRUTH, body.options, **geoms)
    pos = torch.tensor(steps.pos, requires_grad=True)
    quat = torch.tensor(quaternion(steps.mat))
    out = {"element": element, "liquid": liquid, "steps": len(pos)}
    for _ in range(2):  # the first makes factors and compiles
        begin = time.perf_counter()
        pressed = differentiable.press(
            skin, pos, quat, youngs_modulus=torch.tensor(1.2e6, requires_grad=True)
        )
        middle = time.perf_counter()
        (pressed.wrench**2).sum().backward()
        out |= {"forward_s": middle - begin, "backward_s": time.perf_counter() - middle}
    return out | {"ratio": out["backward_s"] / out["forward_s"], **dataclasses.asdict(pressed.counts)}


def measure_fits(names: list, fill: float) -> dict:
    """Both fits of the same data from the same start, one after the other."""
    body = configuration("shell_with_core", liquid=bool(fill), bulk_modulus=1e7)
    exact = dataclasses.replace(body.options, tolerance=1e-6, max_newton=200, contact_stiffness=2e11)
    way = plan_shear(skin="coarse")
    true = simulate(body.geometry, dataclasses.replace(exact, fill_volume=fill), [TRUTH], way).force[0]
    noise = NOISE * np.random.default_rng(1).standard_normal(true.shape)
    data, body = dataclasses.replace(way, force=true + noise), dataclasses.replace(body, options=exact)
    names = [parameter(name) for name in names]
    if fill:
        body = dataclasses.replace(body, options=dataclasses.replace(exact, fill_volume=fill / 2))
    out = {"parameters": [p.name for p in names]}
    for name, fit in (("gradients", differentiable.calibrate), ("differences", calibrate)):
        begin = time.perf_counter()
        found = fit(body, START, data, names)
        seconds = time.perf_counter() - begin
        error = found.standard_error.tolist()
        out[name] = {"seconds": seconds, "value": found.value.tolist(), "standard_error": error}
        out[name] |= {"rms_N": found.rms, "evaluations": found.evaluations}
    return out | {"faster": out["differences"]["seconds"] / out["gradients"]["seconds"]}


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", type=pathlib.Path, required=True)
    parser.add_argument("--only", choices=("passes", "fit", "fill"), nargs="*")
    given = parser.parse_args()
    only, out = given.only or ("passes", "fit", "fill"), {}
    if "passes" in only:
        kinds = [("linear", False), ("linear", True), ("quadratic", False), ("quadratic", True)]
        out["passes"] = [measure_passes(*kind) for kind in kinds]
    if "fit" in only:
        out["fit"] = measure_fits(["E", "nu", "mu"], 0.0)
    if "fill" in only:
        out["fill"] = measure_fits(["E", "nu", "mu", "fill_volume:0:1e-7"], FILL)
    given.json.write_text(json.dumps(out, indent=1))
    print(json.dumps(out, indent=1))


if __name__ == "__main__":
    main()
