"""How foreign the synthetic measured sensors are, beside real ones: agreement with the plain film.

    python benchmarks/foreign.py --real epfl_f1 E1 F1 --real epfl_f2 E2 F2 --sensors 8 --json OUT

A table has 120 states of the default skin under a flat plate: 12 directions (pitch 0, 9, 20, 30 degrees, roll
0 and 26 to both sides), 10 loads each. A row in touch (more than 0.5 N) takes the state whose change of ln Z
correlates best with its own over the 19 electrodes; a correlation does not see what all electrodes share, as
warm-up. Real rows change from the preset's rest, `--real PRESET ELECTRODES FORCE`; synthetic ones from their
tare, under plates in random directions within the table's, dragged as a hand does (to 1.4 of the depth).
`same state`: the film of the default skin under the very same plate, which real recordings do not have."""

import argparse
import pathlib

import numpy as np
from records import write_json

from biotac_mj.data.generation.plan import Motion
from biotac_mj.data.generation.simulate import simulate
from biotac_mj.data.generation.synthetic_sensor import SyntheticSensor
from biotac_mj.geometry import load_skin
from biotac_mj.geometry.design import electrode_positions
from biotac_mj.matching.fit import rows_of
from biotac_mj.matching.response import log_changes
from biotac_mj.matching.states import PlateGrid, plate_states
from biotac_mj.recordings import load_one
from biotac_mj.resimulation.fitted import PLATE, plate_path
from biotac_mj.sensor.channels import NELECTRODE, log_impedance
from biotac_mj.sensor.film import FilmConduction
from biotac_mj.sensor.presets import SENSORS
from biotac_mj.skin import PRESETS, SkinModel

_TOUCH = 0.5  # [N], as `matching.rows_of`
_STEPS, _RATE = 10, 20.0


def correlation(a, b):
    """Of rows (n, 19) with rows that broadcast with them."""
    a, b = (x - x.mean(-1, keepdims=True) for x in (a, b))
    return (a * b).sum(-1) / np.sqrt((a * a).sum(-1) * (b * b).sum(-1))


def table(geometry):
    """(120, 19) change of ln Z in the states, rolled to both sides."""
    grid = PlateGrid(
        pitch=tuple(np.radians([0, 9, 20, 30])),
        roll=tuple(np.radians([0, 26])),
        drag=(),
        load=tuple(np.geomspace(0.5, 20, 10) / PRESETS["default"].youngs_modulus),
    )
    states = plate_states(geometry, PRESETS["default"], grid=grid)
    change = log_changes(states, FilmConduction(geometry, sensor=None))[:, :, 0]
    place = electrode_positions()
    mirror = np.abs(place[:, None] * [1, -1, 1] - place).sum(-1).argmin(0)
    return np.concatenate([change[:, 0], change[:, 1], change[:, 1][..., mirror]]).reshape(-1, NELECTRODE)


def real(name, electrodes, force):
    """(n, 19) change of ln Z in the loaded rows of a recording."""
    recording, _ = load_one(electrodes, force=force)
    rows = rows_of(recording.counts()[0], recording.force)
    return log_impedance(rows.counts) - log_impedance(np.array(SENSORS[name].rest))


def plates(geometry, rng):
    """A plate's way (Motion) towards the core."""
    pitch, roll = np.radians([rng.uniform(0, 30), rng.uniform(-26, 26)])
    state = np.tile([pitch, roll, *rng.uniform(-1.4, 1.4, 2) / np.sqrt(2)], (_STEPS, 1))
    depth = np.concatenate([[-5e-6], np.linspace(0.1, 1, _STEPS - 1) * rng.uniform(0.8e-3, 2.2e-3)])
    pos, mat, _ = plate_path(geometry, state, depth)
    return Motion("press", {}, pos, mat)


def synthetic(seed, skin, presses, device):
    """Change of ln Z (n, 19) of a synthetic sensor in touch, and of the plain film in the same states."""
    sensor, geometry = SyntheticSensor(seed, skin, device), load_skin(skin)
    plain = SkinModel(geometry, PRESETS["default"], device=device)
    film, meter = FilmConduction(plain.geometry, sensor=None), sensor.meter()
    rest = np.log(film.impedance(plain.geometry.vert))
    time, rng = np.arange(_STEPS) / _RATE, np.random.default_rng([seed, 1])
    measured, modelled = [], []
    for k in range(presses):
        motion = plates(geometry, rng)
        mine, its = (simulate(model, PLATE, [motion]) for model in (plain, sensor.model))
        nodes = its.vert_xpos(sensor.model.geometry.vert, 0)
        counts = meter.measure(nodes, time, its.pressure[0], 12.0 * k, seed + k)[0][:, :NELECTRODE]
        touch = np.linalg.norm(its.wrench[0, :, :3], axis=1) > _TOUCH
        touch &= (np.linalg.norm(mine.wrench[0, :, :3], axis=1) > 0) & its.converged[0] & mine.converged[0]
        measured.append((log_impedance(counts) - log_impedance(counts[0]))[touch])
        modelled += [np.log(film.impedance(x)) - rest for x in mine.vert_xpos(plain.geometry.vert, 0)[touch]]
    return np.concatenate(measured), np.array(modelled).reshape(-1, NELECTRODE)


def agreement(change, states):
    """Best correlation (n,) of each row with a state."""
    return correlation(change[:, None], states[None]).max(1)


def main(argv=None):
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument(
        "--real", nargs=3, action="append", default=[], metavar=("PRESET", "ELECTRODES", "FORCE")
    )
    parser.add_argument("--sensors", type=int, default=8, help="synthetic ones, from number 0 on")
    parser.add_argument("--presses", type=int, default=6, help="of each")
    parser.add_argument("--skin", default="coarse", help="mesh of table and synthetic sensors")
    parser.add_argument("--device", default="cpu", help="of Warp")
    parser.add_argument("--json", type=pathlib.Path, help="where the figures go")
    given = parser.parse_args(argv)
    states = table(load_skin(given.skin))
    print(f"{len(states)} states of the plain film; correlation of a row with the best of them")
    print(f"  {'':<26}{'rows':>6}{'median':>9}{'lowest tenth':>14}{'same state':>12}")
    found = {"real": {}, "synthetic": {}}

    def report(kind, name, change, same=None):
        value = agreement(change, states)
        row = {"rows": len(value), "median": np.median(value), "lowest_tenth": np.percentile(value, 10)}
        row |= {} if same is None else {"same_state": np.median(correlation(change, same))}
        found[kind][name] = {k: float(v) for k, v in row.items()}
        beside = f"{row['same_state']:>12.3f}" if same is not None else ""
        text = f"{row['rows']:>6}{row['median']:>9.3f}{row['lowest_tenth']:>14.3f}{beside}"
        print(f"  {kind + ' ' + name:<26}{text}", flush=True)

    for name, electrodes, force in given.real:
        report("real", name, real(name, electrodes, force))
    parts = []
    for seed in range(given.sensors):
        parts.append(synthetic(seed, given.skin, given.presses, given.device))
        report("synthetic", f"number {seed}", *parts[-1])
    if parts:
        report("synthetic", "all", *(np.concatenate(part) for part in zip(*parts)))
    if given.json:
        write_json(given.json, {"settings": {**vars(given), "json": None}, **found})


if __name__ == "__main__":
    main()
