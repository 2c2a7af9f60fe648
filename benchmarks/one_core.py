"""Processor time of a step on one core where BioTacs rest, press, grip and clench: the scenes of one hand.

    MENAGERIE_ROOT=DIR python benchmarks/one_core.py [--json OUT] [--cases ball,fingers,grip,fist] [--turns 1]
        [--tier condensed] [--skin coarse] [--self-touch] [--against DIR]
    python benchmarks/one_core.py --table OUT                                            # prints it again

  ball     100 g fall on a pad that looks up, bounce and come to rest, steps of 2 ms
  fingers  a Shadow Hand; a ball follows, presses and rubs each of its five pads, as in hands.py --moving;
           steps of 4 ms
  grip     a Robotiq 2F-85 closes on a cube of 50 g, lifts it by 50 mm, holds it and shakes it at 8 Hz, steps
           of 2 ms
  fist     a Shadow Hand closes to a fist around a free ball of 60 mm without gravity, five skins, steps of
           4 ms; --self-touch: fingers touch fingers, too

Each turn is a process of its own. A row is a phase of a case: median and slowest ms of processor time of
`mj_step`, which part of it the kernels of the skins take and which the film (the rest is Python and MuJoCo),
solves of skins in a step (mean, most) and iterations of each, skin steps without a balance, and the mean
force of each BioTac [N]. Of several turns the least of each time counts. --against DIR: the same of another
checkout's package, in turns, and the ratio of this one's times to that one's."""

import os

# before numpy reads them
os.environ.update(OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1", MKL_NUM_THREADS="1")

import argparse
import functools
import json
import pathlib
import sys
import time
from collections.abc import Callable

import mujoco
import numpy as np

sys.path.insert(0, str(pathlib.Path(__file__).parent))

__all__ = ["CASES", "main", "table"]

GRIPPER = """<mujoco><compiler angle="radian"/>
<option timestep="0.002" integrator="implicitfast" cone="elliptic" impratio="10"/>
<worldbody><geom name="floor" type="plane" size=".3 .3 .01"/>
<body name="cube" pos="0 0 .015"><freejoint/><geom type="box" size=".015 .015 .015" mass=".05"/></body>
<body name="carriage" pos="0 0 .168"><joint name="lift" type="slide" axis="0 0 1" damping="50"/>
<inertial pos="0 0 0" mass=".5" diaginertia="1e-3 1e-3 1e-3"/><site name="flange" quat="0 1 0 0"/></body>
</worldbody>
<actuator><position name="lift" joint="lift" kp="5000" dampratio="1"/></actuator></mujoco>"""
GRIP = 0.35  # limit of the gripper's actuator [N m]: 5 is its own, and more than the condensed tier is for
# goals of the thumb's servos and of the palm in a fist [rad]; those of the other joints are their limits
FIST = {"THJ5": 0.4, "THJ4": 1.2, "THJ3": 0.0, "THJ2": 0.6, "THJ1": 0.6, "LFJ5": 0.0}
STRAIGHT = ("WRJ1", "WRJ2", "FFJ4", "MFJ4", "RFJ4", "LFJ4")


class _Clock:
    """Processor time of the calls of a method [ms]; number of those that returned, and the iterations that
    these say they took."""

    def __init__(self, owner: type, name: str):
        self.spent, method = 0.0, getattr(owner, name)
        self.calls = self.iterations = 0

        def timed(*given, **named):
            begin = time.process_time()
            try:
                found = method(*given, **named)
            finally:
                self.spent += 1e3 * (time.process_time() - begin)
            self.calls += 1
            self.iterations += getattr(found, "iterations", 0)
            return found

        setattr(owner, name, timed)


@functools.cache
def _clocks():
    """Clocks of the skins' kernels, of the film, and of solves in either tier. They must be there before a
    skin is made."""
    from biotac_mj.coupling.steppers.condensed import CondensedStepper
    from biotac_mj.coupling.steppers.fem import FemStepper
    from biotac_mj.sensor.film.conduction import FilmConduction
    from biotac_mj.skin.program import Program

    of_solves = [_Clock(stepper, "solve_skin") for stepper in (CondensedStepper, FemStepper)]
    return _Clock(Program, "run"), _Clock(FilmConduction, "impedance"), *of_solves


def _counts():
    """What the clocks say: time in kernels and film, solves, iterations of these."""
    kernels, film, *of_solves = _clocks()
    of_solves = [sum(clock.calls for clock in of_solves), sum(clock.iterations for clock in of_solves)]
    return np.array([kernels.spent, film.spent, *of_solves])


def _follow(model, handles, until, drive: Callable[[mujoco.MjData], None] = lambda data: None, data=None):
    """Steps until a time [s], `drive` before each: times at their ends [s], ms of processor time, of it in
    the skins' kernels and in the film, solves, their iterations, skins without a balance, and forces (steps,
    BioTacs) [N]."""
    data, rows = data or mujoco.MjData(model), []
    mujoco.mj_forward(model, data)
    while data.time < until:
        drive(data)
        before, begin = _counts(), time.process_time()
        mujoco.mj_step(model, data)
        spent = 1e3 * (time.process_time() - begin)
        parts = _counts() - before
        lost = sum(handle.read(data, "status")[0] == 0 for handle in handles)
        force = [np.linalg.norm(handle.read(data, "contact_force")[:3]) for handle in handles]
        rows.append([data.time, spent, *parts, lost, *force])
    return np.array(rows)


def _phase(rows, begin=0.0, end=np.inf):
    """The row of the steps that end between two times [s]."""
    some = rows[(rows[:, 0] > begin) & (rows[:, 0] <= end)]
    whole, solves, film = some[:, 1:4].sum(0)
    return {
        "steps": len(some),
        "ms_median": float(np.median(some[:, 1])),
        "ms_most": float(some[:, 1].max()),
        "solves": float(solves / whole),
        "film": float(film / whole),
        "solves_mean": float(some[:, 4].mean()),
        "solves_most": int(some[:, 4].max()),
        "iterations": float(some[:, 5].sum() / max(some[:, 4].sum(), 1)),
        "unsettled": int(some[:, 6].sum()),
        "force_n": some[:, 7:].mean(0).round(4).tolist(),
    }


def _menagerie(*names):
    path = pathlib.Path(os.environ.get("MENAGERIE_ROOT", "mujoco_menagerie")).joinpath(*names)
    if not path.is_file():
        raise FileNotFoundError(f"no {path}: set MENAGERIE_ROOT to a clone of MuJoCo Menagerie")
    return str(path)


def ball_case(tier: str, skin: str, **_) -> dict:
    """100 g that come to rest."""
    import biotac_mj

    spec = mujoco.MjSpec()
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.worldbody.add_site(name="tip", quat=[1, -1, 0, 0])
    ball = spec.worldbody.add_body(pos=[-10e-3, 0, 13.5e-3])
    ball.add_joint(type=mujoco.mjtJoint.mjJNT_SLIDE, axis=[0, 0, 1])
    ball.add_geom(size=[5e-3, 0, 0], mass=0.1)
    handle = biotac_mj.attach(spec, site="tip", tier=tier, skin=skin)
    rows = _follow(spec.compile(), [handle], 2.0)
    return {"falls": _phase(rows, 0, 0.4), "bounces": _phase(rows, 0.4, 0.8), "at rest": _phase(rows, 1.4)}


def fingers_case(tier: str, skin: str, **_) -> dict:
    """Five moving fingers."""
    from hands import SETTLING, TIMESTEP, build, slide

    model, handles = build(_menagerie("shadow_hand", "right_hand.xml"), 5, tier=tier, skin=skin)
    handles, data, step = list(handles.values()), mujoco.MjData(model), iter(range(10**6))
    bodies = [handle.body for handle in handles]
    rows = _follow(
        model, handles, TIMESTEP * (SETTLING + 100.5), lambda d: slide(d, bodies, next(step)), data
    )
    return {"moving": _phase(rows, TIMESTEP * (SETTLING + 0.5))}


def grip_case(tier: str, skin: str, **_) -> dict:
    """A cube that is gripped, lifted, held and shaken."""
    import biotac_mj

    spec = mujoco.MjSpec.from_string(GRIPPER)
    gripper = mujoco.MjSpec.from_file(_menagerie("robotiq_2f85", "2f85.xml"))
    spec.attach(gripper, site="flange", prefix="g_")
    spec.actuator("g_fingers_actuator").forcerange = [-GRIP, GRIP]
    fingers = biotac_mj.attach_to_hand(spec, "robotiq_2f85", link_prefix="g_", tier=tier, skin=skin)
    model = spec.compile()
    close, lift, cube = model.actuator("g_fingers_actuator").id, model.actuator("lift").id, []

    def drive(data):
        data.ctrl[close] = np.interp(data.time, [0.2, 0.7], [0.0, 200.0])
        shaken = 8e-3 * np.sin(2 * np.pi * 8 * (data.time - 2.2)) if 2.2 < data.time < 2.8 else 0.0
        data.ctrl[lift] = np.interp(data.time, [1.0, 1.6], [0.0, 50e-3]) + shaken
        cube.append(data.xpos[model.body("cube").id, 2])

    rows = _follow(model, list(fingers.values()), 3.2, drive)
    spans = {"closing": (0.2, 0.9), "lifted": (1.0, 1.6), "held": (1.7, 2.2), "shaken": (2.2, 2.8)}
    found = {name: _phase(rows, *span) for name, span in spans.items()} | {"all": _phase(rows)}
    found["held"]["height_m"] = float(np.mean(cube[850:1100]))  # of the cube's middle: 65 mm, or it was lost
    return found


def fist_case(tier: str, skin: str, self_touch: bool) -> dict:
    """Five skins around a ball."""
    import biotac_mj

    spec = mujoco.MjSpec()
    spec.option.timestep, spec.option.gravity = 4e-3, [0, 0, 0]
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.cone, spec.option.impratio = mujoco.mjtCone.mjCONE_ELLIPTIC, 10
    ball = spec.worldbody.add_body(pos=[0.33, 0, 0.055])
    ball.add_freejoint()
    ball.add_geom(size=[0.03, 0, 0], mass=0.05)
    hand = mujoco.MjSpec.from_file(_menagerie("shadow_hand", "right_hand.xml"))
    spec.attach(hand, frame=spec.worldbody.add_frame(), prefix="")
    fingers = biotac_mj.attach_to_hand(spec, "shadow_hand", tier=tier, skin=skin, self_touch=self_touch)
    model = spec.compile()
    goal = model.actuator_ctrlrange[:, 1].copy()
    for u in range(model.nu):
        joint = model.actuator(u).name.rpartition("_")[2]
        goal[u] = 0.0 if joint in STRAIGHT else FIST.get(joint, goal[u])

    def drive(data):
        data.ctrl[:] = min(data.time / 0.8, 1.0) * goal

    rows = _follow(model, list(fingers.values()), 1.2, drive)
    return {"closing": _phase(rows, 0, 0.6), "closed": _phase(rows, 0.6), "all": _phase(rows)}


CASES = {"ball": ball_case, "fingers": fingers_case, "grip": grip_case, "fist": fist_case}


def _least(turns: list[dict]) -> dict:
    """Phases of several turns of a case as one: the least times, the most that was unsettled."""
    out = {}
    for phase, first in turns[0].items():
        out[phase] = dict(first)
        for name, choose in (("ms_median", min), ("ms_most", min), ("unsettled", max)):
            out[phase][name] = choose(turn[phase][name] for turn in turns)
    return out


def table(found: dict) -> str:
    """What was measured, in Markdown."""
    other = any("against" in case for case in found["cases"].values())
    heads = ["case", "phase", "steps", "ms a step, median", "slowest", "solves %", "film %"]
    heads += ["solves a step", "most", "iterations of each", "unsettled skin steps", "N of each"]
    against = ["median", "slowest", "solves a step", "iterations of each", "unsettled"]
    heads += [*(f"{name} against" for name in against), "ratio of medians"] * other
    lines = [f"{found['tier']}, {found['skin']}, {found['turns']} turns\n"]
    lines += [f"| {' | '.join(heads)} |", "|" + "---|" * len(heads)]
    for case, turns in found["cases"].items():
        here = _least(turns["here"])
        there = _least(turns["against"]) if turns.get("against") else {}
        for phase, row in here.items():
            force = ", ".join(f"{f:.3g}" for f in row["force_n"])
            cells = [case, phase, str(row["steps"]), f"{row['ms_median']:.2f}", f"{row['ms_most']:.1f}"]
            cells += [
                *(f"{100 * row[part]:.0f}" for part in ("solves", "film")),
                f"{row['solves_mean']:.2f}",
                str(row["solves_most"]),
                f"{row['iterations']:.1f}",
                str(row["unsettled"]),
                force,
            ]
            if phase in there:
                that = there[phase]
                cells += [f"{that['ms_median']:.2f}", f"{that['ms_most']:.1f}", f"{that['solves_mean']:.2f}"]
                cells += [f"{that['iterations']:.1f}", str(that["unsettled"])]
                cells += [f"{row['ms_median'] / that['ms_median']:.3f}"]
            lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def main(arguments=None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument(
        "--json", type=pathlib.Path, default="out/benchmarks/one_core.json", help="file to write"
    )
    parser.add_argument("--table", type=pathlib.Path, help="print the table of such a file, and end")
    parser.add_argument("--cases", default=",".join(CASES), help="comma-separated")
    parser.add_argument("--tier", default="condensed")
    parser.add_argument("--skin", default="coarse")
    parser.add_argument("--self-touch", action="store_true", help="of the fist: fingers touch fingers")
    parser.add_argument("--turns", type=int, default=1, help="of which the least times count")
    parser.add_argument("--against", type=pathlib.Path, help="the root of another checkout")
    parser.add_argument("--child", choices=CASES, help=argparse.SUPPRESS)
    options = parser.parse_args(arguments)
    if options.table:
        print(table(json.loads(options.table.read_text(encoding="utf-8"))))
        return 0
    if options.child:
        _clocks()
        how = {"tier": options.tier, "skin": options.skin, "self_touch": options.self_touch}
        print(json.dumps(CASES[options.child](**how)))
        return 0
    options.json.parent.mkdir(parents=True, exist_ok=True)
    if unknown := set(options.cases.split(",")) - set(CASES):
        parser.error(f"unknown case {', '.join(sorted(unknown))}: choose from {', '.join(CASES)}")
    from checkouts import beside, run_with
    from records import write_json

    found = {"tier": options.tier, "skin": options.skin, "self_touch": options.self_touch}
    found |= {"turns": options.turns, "cases": {}}
    worker = [__file__, "--tier", options.tier, "--skin", options.skin]
    worker += ["--self-touch"] * options.self_touch
    with beside(options.against) as folders:
        for case in options.cases.split(","):
            turns = found["cases"][case] = {name: [] for name in folders}
            for turn in range(options.turns):
                for name in folders if turn % 2 else reversed(folders):
                    said = run_with(folders[name], [*worker, "--child", case], 1)
                    turns[name].append(json.loads(said.splitlines()[-1]))
                    write_json(options.json, found)
    print(table(found))
    return 0


if __name__ == "__main__":
    sys.exit(main())
