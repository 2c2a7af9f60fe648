"""What a process pays before its first step: import, attach, first step that touches, with both tiers.

    python benchmarks/startup.py --json out/startup.json [--skins coarse,default] [--tiers full,condensed]
                                 [--fills 0,1e-7] [--threads 1] [--runs 3] [--against DIR]

Each run is a process of its own; one before the counted ones fills the caches (compiled kernels, and what the
skin keeps on disk). Seconds of processor time and wall time, least of the runs, each stage for itself. "step"
compiles the model too, in which MuJoCo asks the plugin for a first solution. fill: liquid beyond what the
unstressed skin holds [m^3].

--against DIR: the same of another checkout, in turns with this one, and the ratio of this one's processor
time to that one's. --threads: of BLAS and OpenMP; without it the libraries choose, and threads that wait
count as processor time."""

import argparse
import json
import pathlib
import sys
import time

sys.path.insert(0, str(pathlib.Path(__file__).parent))

__all__ = ["main", "measure", "press_ball"]

STAGES = ("import", "attach", "step")
RADIUS, PLACE = 3.5e-3, (-12e-3, -11.5e-3, 0.0)  # of the ball, 0.2 mm in the pad [m]


def press_ball(steps: int = 1, lap=lambda: None, **settings) -> None:
    """A ball that begins in the pad of a BioTac, from attach over some steps to the end of the model.

    Args:
      lap: called when the BioTac is attached, and after the steps. settings: of `attach`.

    Raises:
      RuntimeError: the ball did not touch.
    """
    import mujoco

    import biotac_mj

    spec = mujoco.MjSpec()
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    ball = spec.worldbody.add_body(name="ball", pos=PLACE)
    ball.add_freejoint()
    ball.add_geom(size=[RADIUS, 0, 0], mass=0.01)
    handle = biotac_mj.attach(spec, body="world", **settings)
    lap()
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, steps)
    lap()
    if not abs(handle.read(data, "contact_force")[:3]).max() > 1e-3:
        raise RuntimeError("the ball does not touch the skin")


def start(tier: str, skin: str, fill: float) -> dict[str, tuple[float, float]]:
    """Processor and wall seconds of each stage, in this process."""
    clocks = [(time.process_time(), time.perf_counter())]

    def lap():
        clocks.append((time.process_time(), time.perf_counter()))

    import mujoco  # noqa: F401 - what `press_ball` needs

    import biotac_mj  # noqa: F401

    lap()
    options = {"skin": {"fill_volume": fill}} if fill else {}
    press_ball(lap=lap, tier=tier, skin=skin, options=options)
    laps = [(b[0] - a[0], b[1] - a[1]) for a, b in zip(clocks, clocks[1:])]
    return dict(zip(STAGES, laps, strict=True))


def measure(folder: pathlib.Path, case: tuple, threads: int | None) -> dict[str, list[float]]:
    """Stage -> processor and wall seconds, of a new process that imports from the folder.

    Raises:
      RuntimeError: the process failed.
    """
    from checkouts import run_with

    text = run_with(folder, [__file__, "--child", *map(str, case)], threads)
    return json.loads(text.splitlines()[-1])


def _least(runs):
    """Of each stage; and all stages together."""
    least = {stage: [min(run[stage][clock] for run in runs) for clock in (0, 1)] for stage in STAGES}
    least["all"] = [sum(least[stage][clock] for stage in STAGES) for clock in (0, 1)]
    return {stage: {"cpu_s": cpu, "wall_s": wall} for stage, (cpu, wall) in least.items()}


def main(arguments=None) -> int:
    """The command; writes the JSON and prints a line for each case."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", type=pathlib.Path, default="out/benchmarks/startup.json")
    parser.add_argument("--skins", default="coarse,default")
    parser.add_argument("--tiers", default="full,condensed")
    parser.add_argument("--fills", default="0,1e-7")
    parser.add_argument("--threads", type=int)
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--against", type=pathlib.Path)
    args = parser.parse_args(arguments)
    args.json.parent.mkdir(parents=True, exist_ok=True)
    from checkouts import beside
    from records import write_json

    rows = []
    cases = [
        (tier, skin, float(fill))
        for skin in args.skins.split(",")
        for fill in args.fills.split(",")
        for tier in args.tiers.split(",")
    ]
    with beside(args.against) as folders:
        for case in cases:
            runs = {name: [] for name in folders}
            for _ in range(1 + args.runs):
                for name, folder in folders.items():
                    runs[name].append(measure(folder, case, args.threads))
            row = dict(zip(("tier", "skin", "fill"), case, strict=True)) | {"threads": args.threads}
            rows.append(row | {name: _least(found[1:]) for name, found in runs.items()})
            print(_line(rows[-1]), flush=True)
            write_json(args.json, {"runs": args.runs, "rows": rows})
    return 0


def _line(row):
    """Processor seconds of the stages, and the ratio to the other checkout."""
    text = f"{row['tier']:<10}{row['skin']:<9}{row['fill']:<8g}"
    for stage in (*STAGES, "all"):
        cpu = row["here"][stage]["cpu_s"]
        text += f"{stage:>8} {cpu:.2f} s"
        if "against" in row:
            text += f" ({cpu / row['against'][stage]['cpu_s']:.2f})"
    return text + f"   wall {row['here']['all']['wall_s']:.2f} s"


if __name__ == "__main__":
    if sys.argv[1:2] == ["--child"]:
        print(json.dumps(start(sys.argv[2], sys.argv[3], float(sys.argv[4]))))
    else:
        sys.exit(main())
