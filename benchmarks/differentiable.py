"""Gradients of a press, measured: the time of a backward pass beside the forward one, gradients beside
central differences on random slides, balances of a press on a sharp edge, and a fit by gradients beside the
one by differences.

    python benchmarks/differentiable.py --json OUT
    python benchmarks/differentiable.py --json OUT --only worlds --device cuda --worlds 1,256

Worlds go together on the device; the first of them are held against one world at a time on the CPU. Slides
go on where they were stopped. All data are synthetic: forces of a simulated skin with known constants, with
white noise."""

import argparse
import dataclasses
import functools
import json
import pathlib
import time

import numpy as np
import torch
from records import read_json, write_json

from biotac_mj import differentiable
from biotac_mj.calibration import (
    calibrate,
    configuration,
    parameter,
    plan_indentation,
    plan_shear,
    simulate,
)
from biotac_mj.calibration.forward import steps_of
from biotac_mj.geometry import load_skin
from biotac_mj.geometry.indenters import INDENTERS
from biotac_mj.geometry.rigid import quaternion
from biotac_mj.skin import Material, SkinOptions

TRUTH = Material(youngs_modulus=1.2e6, poissons_ratio=0.38, friction=0.5)
START = dataclasses.replace(TRUTH, youngs_modulus=1.5e6, poissons_ratio=0.32, friction=0.6)
FILL = 2e-8  # [m^3]
NOISE = 2e-3  # [N]
COSINE = 0.9999  # below which a slide is named
DIFFERENCE = 1e-5  # of what a slide's gradient is held against, in its units


PASSES = 5


def measure_passes(element: str, liquid: bool) -> dict:
    """Seconds of the processor for a press forward and backward, medians of PASSES; both take the same
    steps."""
    way = plan_shear(skin="coarse")
    steps, geoms = steps_of(way)
    body = configuration("shell_with_core", element=element, liquid=liquid)
    skin = differentiable.Skin(body.geometry, TRUTH, body.options, **geoms)
    pos = torch.tensor(steps.pos, requires_grad=True)
    quat = torch.tensor(quaternion(steps.mat))
    out, seconds = {"element": element, "liquid": liquid, "steps": len(pos)}, []
    for _ in range(1 + PASSES):  # the first makes factors and compiles
        begin = time.process_time()
        pressed = differentiable.press(
            skin, pos, quat, youngs_modulus=torch.tensor(1.2e6, requires_grad=True)
        )
        middle = time.process_time()
        (pressed.wrench**2).sum().backward()
        seconds.append((middle - begin, time.process_time() - middle))
    forward, backward = np.array(seconds[1:]).T
    out |= {"forward_s": np.median(forward), "backward_s": np.median(backward)}
    return out | {"ratio": np.median(backward / forward), **dataclasses.asdict(pressed.counts)}


MOVED = 5e-5  # [m] by which the paths of worlds differ
ALONE = 3  # worlds that are held against those that go one after another


def measure_worlds(element: str, nworld: int, device: str) -> dict:
    """Seconds for a press of many worlds together, forward and backward, medians of PASSES: of the clock on
    CUDA, of the processor on the CPU; and how far forces and gradients are from one world at a time."""
    way = plan_shear(skin="coarse")
    steps, geoms = steps_of(way)
    body = configuration("shell_with_core", element=element, liquid=False)
    skin = differentiable.Skin(body.geometry, TRUTH, body.options, **geoms)
    draw = np.random.default_rng(7)
    begin = torch.tensor(steps.pos + MOVED * draw.normal(size=(nworld, 1, 1, 3)))
    quat = torch.tensor(quaternion(steps.mat)).expand(nworld, -1, -1, -1)
    weights = torch.tensor(draw.normal(size=(nworld, len(steps.pos), 1, 6)))
    cuda = torch.device(device).type == "cuda"
    out, seconds = {"element": element, "worlds": nworld, "device": device, "steps": len(steps.pos)}, []

    def clock():
        if cuda:
            torch.cuda.synchronize()
        return time.perf_counter() if cuda else time.process_time()

    def pressed_by(worlds, together):
        pos = begin[worlds].clone().requires_grad_()
        stiff = torch.full((len(pos),), 1.2e6, dtype=torch.float64, requires_grad=True)
        times = [clock()]
        pressed = differentiable.press(
            skin, pos, quat[worlds], youngs_modulus=stiff, together=device if together else None
        )
        times.append(clock())
        (pressed.wrench * weights[worlds].to(pressed.wrench.device)).sum().backward()
        times.append(clock())
        return np.diff(times), (pressed.wrench.detach().cpu(), pos.grad, stiff.grad), pressed

    for _ in range(1 + PASSES):  # the first makes factors and compiles
        took, found, pressed = pressed_by(slice(None), True)
        seconds.append(took)
    forward, backward = np.array(seconds[1:]).T
    few = slice(min(ALONE, nworld))
    expected = pressed_by(few, False)[1]
    for name, one, other in zip(("wrench", "by_pos", "by_E"), expected, found):
        out[f"{name}_error"] = ((one - other[few]).abs().max() / one.abs().max()).item()
    if cuda:
        left, all_of_it = torch.cuda.mem_get_info()
        out["memory_GB"] = (all_of_it - left) / 1e9  # of PyTorch and Warp together
        out["gpu"] = torch.cuda.get_device_name()
    out["products"] = skin.in_worlds(nworld, device).products  # of a backward pass
    out |= {
        "first_s": seconds[0].tolist(),
        "forward_s": np.median(forward),
        "backward_s": np.median(backward),
    }
    return out | {"ratio": np.median(backward / forward), **dataclasses.asdict(pressed.counts)}


SLIDES, DIRECTIONS = 30, 4


def measure_slide(seed: int) -> dict:
    """Cosine of a gradient with central differences, over a press and a slide drawn by seed.

    Numbers moved by: all of the path, the end of its slide [mm], ln E, nu, ln mu and ln of the contact's
    stiffness; with liquid its filling [10 mm^3] and ln of its modulus. Differences are taken along random
    directions of these, and the cosine is that of the projections. A direction has a kink where contact
    changes otherwise on one side of the difference than on the other."""
    draw = np.random.default_rng([seed, 30])
    liquid = bool(seed // 2 % 2)
    turn, name = draw.uniform(0, 2 * np.pi), INDENTERS[seed % len(INDENTERS)]
    way = plan_indentation(
        name,
        (draw.uniform(-0.0145, -0.006), draw.uniform(-0.7, 0.7)),
        draw.uniform(0.6e-3, 2.4e-3),
        draw.uniform(0.4e-3, 1e-3),
        (np.cos(turn), 0.0, np.sin(turn)),
        samples=10,
    )
    steps, geoms = steps_of(way)
    body = configuration(
        "shell_with_core", element=("linear", "quadratic")[seed % 2], liquid=liquid, tolerance=1e-9
    )
    start = {
        "youngs_modulus": draw.uniform(0.6e6, 2e6),
        "poissons_ratio": draw.uniform(0.3, 0.42),
        "friction": draw.uniform(0.1, 0.5),
        "contact_stiffness": 2e11,
    }
    if liquid:
        start |= {"fill_volume": draw.uniform(0, 2e-8), "bulk_modulus": 1e7}
    skin = differentiable.Skin(body.geometry, TRUTH, body.options, **geoms)
    quat = torch.tensor(quaternion(steps.mat))
    slid = torch.linspace(-1, 1, len(quat), dtype=torch.float64).clamp(min=0)[:, None, None]
    weights = {k: torch.tensor(draw.normal(size=(*n,))) for k, n in (
        ("wrench", (len(quat), 1, 6)), ("nodes", (skin.model.nvert, 3))
    )}  # fmt: skip

    def loss(moved):
        own = {
            k: v + m * 1e-8 if k == "fill_volume" else v + m if k == "poissons_ratio" else v * m.exp()
            for (k, v), m in zip(start.items(), moved[6:])
        }
        friction = own.pop("friction")[None]
        pos = torch.tensor(steps.pos) + 1e-3 * (moved[:3] + slid * moved[3:6])
        pressed = differentiable.press(skin, pos, quat, friction=friction, **own)
        wrench = pressed.wrench * torch.tensor([1, 1, 1, 1e2, 1e2, 1e2])
        total = (weights["wrench"] * wrench).sum() + 1e2 * (weights["nodes"] * pressed.nodes[-1]).sum()
        return total + 1e-4 * pressed.pressure.sum(), pressed

    at = torch.zeros(6 + len(start), dtype=torch.float64, requires_grad=True)
    value, pressed = loss(at)
    value.backward()
    ways = np.linalg.qr(np.random.default_rng([seed, 31]).normal(size=(len(at), DIRECTIONS)))[0].T
    gradient, slope, kinks = ways @ at.grad.numpy(), [], 0
    with torch.no_grad():
        for way in torch.tensor(ways):
            (ahead, there), (back, here) = loss(DIFFERENCE * way), loss(-DIFFERENCE * way)
            slope.append((ahead - back).item() / (2 * DIFFERENCE))
            kinks += there.changes != here.changes
    slope = np.array(slope)
    return {
        "seed": seed, "indenter": name, "element": body.options.element, "liquid": liquid,
        "core": bool(np.abs(skin.data.core_force).max() > 1e-3), "steps": len(quat),
        "cosine": float(gradient @ slope / np.linalg.norm(gradient) / np.linalg.norm(slope)),
        "error": float(np.linalg.norm(gradient - slope) / np.linalg.norm(slope)),
        "kinks": kinks, "gradient": gradient.tolist(), "differences": slope.tolist(),
        **dataclasses.asdict(pressed.counts),
    }  # fmt: skip


EDGES, MOVES = (0.0, 3e-4), 80


def measure_edges(rounding: float, friction: bool) -> dict:
    """How many of MOVES presses that differ in E alone, by 1 Pa to some kPa, come out in another balance than
    the first: one step of a sphere and a box whose edge is in touch."""
    draw = np.random.default_rng(55)
    skin = differentiable.Skin(
        load_skin("coarse"), types=["sphere", "box"], sizes=[[3e-3] * 3, [3e-3, 2e-3, 4e-3]],
        rounding=[0.0, rounding], friction=[0.4, 0.25] if friction else [0.0, 0.0],
        options=SkinOptions(tolerance=1e-9),
    )  # fmt: skip
    pos = torch.tensor([[[-0.0125, -0.0113, 0.0006], [-0.004, -0.0106, -0.001]]], dtype=torch.float64)
    quat = 0.5 * (0.15 * torch.tensor(draw.normal(size=(1, 2, 4))) + torch.tensor([1.0, 0, 0, 0]))
    draw = np.random.default_rng(1)
    moves = np.concatenate([np.arange(MOVES // 2 + 1), 1e3 * draw.normal(size=MOVES // 2)])
    with torch.no_grad():
        pressed = [
            differentiable.press(skin, pos, quat, youngs_modulus=1.1e6 + move, poissons_ratio=0.42)
            for move in moves
        ]
    apart = [float((each.nodes - pressed[0].nodes).norm(dim=-1).max()) for each in pressed[1:]]
    return {
        "rounding": rounding, "friction": friction, "presses": len(apart),
        "others": sum(a > 1e-6 for a in apart), "apart_m": max(apart),
        "force_N": float(pressed[0].wrench[..., :3].norm()), "sharp": pressed[0].counts.sharp,
        "lost": sum(each.counts.lost for each in pressed),
    }  # fmt: skip


def measure_fits(names: list, fill: float) -> dict:
    """Fits of the same data from the same start, one after the other, in seconds of the processor."""
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
    fits = {
        "gradients": functools.partial(calibrate, forces=differentiable.Forces()),
        "differences": calibrate,
    }
    if fill:
        fits["four_starts"] = functools.partial(calibrate, forces=differentiable.Forces(), starts=4)
    for name, fit in fits.items():
        begin = time.process_time()
        found = fit(body, START, data, names)
        seconds = time.process_time() - begin
        error = found.standard_error.tolist()
        out[name] = {"seconds": seconds, "value": found.value.tolist(), "standard_error": error}
        out[name] |= {"rms_N": found.rms, "evaluations": found.evaluations}
    slow = out["differences"]["seconds"]
    return out | {"faster": {name: slow / out[name]["seconds"] for name in fits}}


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", type=pathlib.Path, default="out/benchmarks/differentiable.json")
    parts = "passes", "worlds", "slides", "edges", "fit", "fill"
    parser.add_argument("--only", choices=parts, nargs="*", default=parts)
    parser.add_argument("--device", default="cpu", help="of worlds that go together")
    parser.add_argument("--worlds", default="1,8", help="how many go together, with commas")
    parser.add_argument("--elements", default="linear,quadratic", help="of these worlds, with commas")
    given = parser.parse_args()
    given.json.parent.mkdir(parents=True, exist_ok=True)
    only, out = given.only, read_json(given.json, {})
    if "passes" in only:
        kinds = [("linear", False), ("linear", True), ("quadratic", False), ("quadratic", True)]
        out["passes"] = [measure_passes(*kind) for kind in kinds]
    if "worlds" in only:
        rows = out.setdefault("worlds", [])
        for element in given.elements.split(","):
            for nworld in map(int, given.worlds.split(",")):
                rows.append(measure_worlds(element, nworld, given.device))
                print(json.dumps(rows[-1]), flush=True)
                write_json(given.json, out)
    if "slides" in only:
        rows = out.setdefault("slides", [])
        for seed in range(len(rows), SLIDES):
            rows.append(measure_slide(seed))
            write_json(given.json, out)
        cosines = np.array([row["cosine"] for row in rows])
        out["slides_below"] = [row["seed"] for row in rows if row["cosine"] < COSINE]
        print(f"cosines: median {np.median(cosines)}, least {cosines.min()}")
    if "edges" in only:
        rows = out["edges"] = []
        for rounding in EDGES:
            rows += [measure_edges(rounding, friction) for friction in (True, False)]
            write_json(given.json, out)
    if "fit" in only:
        out["fit"] = measure_fits(["E", "nu", "mu"], 0.0)
    if "fill" in only:
        out["fill"] = measure_fits(["E", "nu", "mu", "fill_volume:0:1e-7"], FILL)
    write_json(given.json, out)
    print(json.dumps(out, indent=1))


if __name__ == "__main__":
    main()
