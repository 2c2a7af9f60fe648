"""Vibration: the model of PAC against recordings.

python benchmarks/vibration.py --data DIR --json OUT

DIR has slides of a robot over materials at 100 Hz, `<material>_<trial>_bio.csv[.gz]` (22 PAC samples a row),
`_cv` (velocity) and `_cw` (wrench), and a MATERIALS.txt. A native log `*.btd[.gz]` of a resting sensor is
looked for there and beside it.

  floor     spectrum of the resting log against that of the simulated acquisition, 25 to 1000 Hz.
  slides    one roughness per material, fitted on trial 1, predicts trial 2 in three bands. Values in the
            recordings are never negative: they look like absolute deviations from rest, and signs are put
            back where that makes the curve smoothest. Pressed flat on a plate the FEM gives what a height
            makes at the force of the wrench; the speed is the robot's.
  ridges    a ridged plate slides on the pad in mj_step, five speeds: the peak and speed / pitch.
  slip      a block pressed on the pad is pulled along it harder and harder: when PAC tells (twice the
            hold's), and when the block has moved 0.5 mm."""

import argparse
import gzip
import json
import pathlib
import re
import sys
import time

import mujoco
import numpy as np
import scipy.optimize
import scipy.signal
from records import write_json

import biotac_mj
from biotac_mj.coupling.config import Config
from biotac_mj.coupling.sensing.vibration import Shaking
from biotac_mj.coupling.stepper import Geom
from biotac_mj.coupling.steppers.condensed import CondensedStepper
from biotac_mj.geometry import load_skin
from biotac_mj.sensor.acquisition import Acquisition
from biotac_mj.sensor.acquisition_kernels import SLOT_RATE, SLOTS_PER_FRAME
from biotac_mj.sensor.channels import (
    NPAC,
    PAC_COLOUR,
    PAC_NOISE,
    counts_from_pac,
    impedance_from_counts,
    pac_from_counts,
)
from biotac_mj.sensor.vibration import Texture, Vibration

RATE = SLOT_RATE / 2  # [Hz] of PAC
BANDS = ((25.0, 100.0), (100.0, 300.0), (300.0, 1000.0))  # [Hz]
_BLOCK = 88  # samples of PAC in 40 ms, which a log holds without gaps
_RESTING = 6.0  # [counts] RMS of a block of a sensor that nothing touches, and [counts] off the common level
_PITCH = 1e-3  # [m] of the ridged plate
_BAND = 3.0  # [dB]
_FEWEST = 40  # rows of a recorded slide: two windows of `energy`
_SEEDS = 4  # draws of a roughness whose energies are averaged
_PLATE = np.array([-9e-3, -13.3e-3, 0.0])


def _open(path):
    return gzip.open(path, "rt", errors="replace") if path.suffix == ".gz" else open(path, errors="replace")


# --- floor ---


def read_rows(path: pathlib.Path) -> np.ndarray:
    """(n, 3) time [s], channel and count of a native log: rows of time, batch, frame, channel, ..., count,
    flag."""
    rows = []
    with _open(path) as file:
        for line in file:
            if line.startswith("Begin"):
                break
        for line in file:
            row = line.split()
            if len(row) == 10:
                rows.append((float(row[0]), float(row[3]), float(row[8])))
    return np.array(rows)


def read_log(path: pathlib.Path) -> np.ndarray:
    """PAC blocks (n, 88) [counts] of a native log."""
    rows = read_rows(path)
    time_, value = rows[rows[:, 1] == 0][:, [0, 2]].T
    starts = np.concatenate([[0], np.flatnonzero(np.diff(time_) > 1.2 / RATE) + 1, [len(time_)]])
    blocks = [
        value[a : a + (b - a) // _BLOCK * _BLOCK].reshape(-1, _BLOCK)
        for a, b in zip(starts[:-1], starts[1:], strict=True)
    ]
    return np.concatenate(blocks)


def _spectrum(blocks):
    f, power = scipy.signal.welch(blocks, RATE, nperseg=_BLOCK, axis=-1)
    inside = (f >= 25) & (f <= 1000)
    return f[inside], power.mean(0)[inside]


def resting(path: pathlib.Path, frames: int = 4000) -> tuple[np.ndarray, np.ndarray]:
    """Blocks (n, 88) of PAC [counts], those of a log that rest and those of the simulated sensor."""
    blocks = read_log(path)
    blocks = blocks[(blocks > 0).all(1)]
    level = np.median(blocks)
    quiet = (blocks.std(1) < _RESTING) & (np.abs(blocks.mean(1) - level) < _RESTING)
    sensor = Acquisition(seed=1)
    state, rest = np.zeros(sensor.nstate), impedance_from_counts(np.full(19, 3000.0))
    sensor.reset(state, rest)
    rows = []
    for i in range(frames):
        sensor.advance(state, i * 0.01, 0.01, rest)
        rows.append(sensor.readings(state)["pac"])
    mine = np.ravel(rows)
    return blocks[quiet], mine[: len(mine) // _BLOCK * _BLOCK].reshape(-1, _BLOCK).astype(float)


def floor(path: pathlib.Path) -> dict:
    """The resting blocks' spectrum, that of the simulated sensor, and the colour fitted anew."""
    blocks, mine = resting(path)
    (f, real), (_, model) = _spectrum(blocks), _spectrum(mine)
    error = 10 * np.log10(model / real)

    def colour(q):
        shape = np.abs(1 - q[1] * np.exp(-2j * np.pi * f / RATE)) ** -2
        return 10 * np.log10(np.exp(q[0]) * shape / (RATE / 2)) - 10 * np.log10(real)

    best = scipy.optimize.least_squares(colour, (2.0, 0.0)).x
    return {
        "floor_error_db": float(np.abs(error).max()),
        "floor_error_db_rms": float(np.sqrt((error**2).mean())),
        "floor_seconds": blocks.size / RATE,
        "floor_rms_pa": float(pac_from_counts(blocks.std() + counts_from_pac(0.0))),
        "floor_fit": {"colour": float(best[1]), "noise": float(np.exp(best[0] / 2))},
    }


# --- slides ---


def unfold(size: np.ndarray) -> np.ndarray:
    """Signs put back to (n,) sizes such that second differences are least in square (Viterbi)."""
    sign = np.array([1.0, -1.0])
    cost, back = np.zeros((2, 2)), np.zeros((len(size), 2, 2), int)
    for i in range(2, len(size)):
        bend = sign * size[i] - 2 * sign[:, None] * size[i - 1] + sign[:, None, None] * size[i - 2]
        total = cost[:, :, None] + bend**2
        back[i], cost = total.argmin(0), total.min(0)
    out = np.zeros(len(size), int)
    out[-2], out[-1] = np.unravel_index(cost.argmin(), (2, 2))
    for i in range(len(size) - 1, 1, -1):
        out[i - 2] = back[i, out[i - 1], out[i]]
    return sign[out] * size


class Slide:
    """One recorded slide: `pac` (n,) [counts] at 2.2 kHz, and at its frames speed and force (n / 22,) [m/s],
    [N]."""

    def __init__(self, folder: pathlib.Path, name: str):
        bio, velocity, wrench = (
            _table(folder, f"{name}_{part}", columns)
            for part, columns in (("bio", 4 + NPAC), ("cv", 4), ("cw", 4))
        )
        self.pac = unfold(bio[:, 4 : 4 + NPAC].ravel())
        self.speed = _smooth(bio[:, 0], velocity)
        self.force = _smooth(bio[:, 0], wrench)


def _table(folder, name, columns):
    """Raises ValueError where a recording has no such table, or one with gaps: PAC would jump there."""
    path = next(folder.glob(f"{name}.csv*"), None)
    if path is None:
        raise ValueError(f"there is no {name}.csv")
    with _open(path) as file:
        lines = file.read().splitlines()[1:]
    if lines and lines[-1].count(",") < lines[0].count(","):
        lines.pop()  # cut where recording ended
    try:
        table = np.array([[float(x) for x in line.split(",")[:columns]] for line in lines])
    except ValueError as error:
        raise ValueError(f"{path.name} has a row that is cut or no number ({error})") from error
    if len(table) < _FEWEST or table.shape[1] < columns or not np.isfinite(table).all():
        raise ValueError(f"{path.name}: give {_FEWEST} rows or more of {columns} finite columns")
    return table


def _smooth(at, rows):
    """Size of the vectors in columns 1 to 3 at given times, a median over a third of a second."""
    size = np.linalg.norm(rows[:, 1:4], axis=1)
    return np.interp(at, rows[:, 0], scipy.signal.medfilt(size, 31))


def energy(pac: np.ndarray) -> np.ndarray:
    """Mean square (3,) of PAC (n,) in each of `BANDS`."""
    f, power = scipy.signal.welch(pac, RATE, nperseg=440)
    return np.array([power[(f >= low) & (f < high)].sum() for low, high in BANDS]) * (f[1] - f[0])


def floor_energy() -> np.ndarray:
    """Mean square (3,) [counts^2] of PAC at rest in each of `BANDS`."""
    f = np.arange(0.5, 1100)
    power = PAC_NOISE**2 / np.abs(1 - PAC_COLOUR * np.exp(-2j * np.pi * f / RATE)) ** 2 / (RATE / 2)
    return np.array([power[(f >= low) & (f < high)].sum() for low, high in BANDS])


class FlatPress:
    """A flat plate pressed on the pad to more than 20 N: what a height under it does, over force."""

    def __init__(self, skin: str):
        geometry = load_skin(skin)
        geoms = [Geom("plate", "box", np.array([0.03, 0.005, 0.03]), 0.3, 0)]
        stepper = CondensedStepper(Config(skin=skin, tier="condensed"), geometry, geoms)
        shaking = Shaking(stepper, geoms)
        state, self.modes = np.zeros(stepper.nstate), shaking.modes
        stepper.reset(state)
        force, gain, area = [0.0], [], []
        depth = 0.5e-3
        while force[-1] < 20 and depth < 2.5e-3:
            depth += 2e-5
            result = stepper.solve_skin(state, (_PLATE + [0, depth, 0])[None], np.eye(3)[None], 2e-3)
            found = shaking.of_step(state, result, 2e-3)
            state = result.state
            if found is not None and result.converged:
                force.append(np.linalg.norm(result.wrench[0, :3]))
                gain.append(found[1][0])
                area.append(found[3][0])
        self.force, self._gain, self._area = np.array(force[1:]), np.array(gain), np.array(area)

    def at(self, force: float) -> tuple[np.ndarray, float]:
        """Gains (nmode + 1,) and area [m^2] at a force [N]."""
        gain = [np.interp(force, self.force, column) for column in self._gain.T]
        return np.array(gain), float(np.interp(force, self.force, self._area))

    def slide(self, slide: Slide, roughness: float, seed: int) -> np.ndarray:
        """PAC (n,) [counts] without noise of a slide over a roughness [m]."""
        sound = Vibration(self.modes, [Texture(roughness=roughness)], seed=seed)
        out = []
        for i, (speed, force) in enumerate(zip(slide.speed, slide.force, strict=True)):
            gain, area = self.at(force)
            sound.time.numpy()[0] = i * SLOTS_PER_FRAME / SLOT_RATE
            sound.gain.numpy()[0, 0], sound.area.numpy()[0, 0] = gain, area
            sound.slip.numpy()[0, 0] = speed
            sound.advance(SLOTS_PER_FRAME / SLOT_RATE)
            out.append(sound.pressure.numpy()[0, 1:SLOTS_PER_FRAME:2].copy())
        return counts_from_pac(np.ravel(out)) - counts_from_pac(0.0)


def slides(folder: pathlib.Path, skin: str) -> dict:
    """One number per material of trial 1, held against trial 2."""
    names = {}
    if (folder / "MATERIALS.txt").exists():
        names = dict(l.split(" ", 1) for l in (folder / "MATERIALS.txt").read_text().splitlines() if l)
    found = sorted({re.sub(r"_1_bio.*", "", p.name) for p in folder.glob("*_1_bio.csv*")})
    read, left_out = {}, {}
    for name in found:
        try:
            read[names.get(name, name)] = [Slide(folder, f"{name}_{t}") for t in (1, 2)]
        except ValueError as error:
            left_out[name] = str(error)
            print(f"left out: {name}: {error}", file=sys.stderr)
    out = {"energy_error_db": {}, "roughness": {}, "energy_db": {}, "trials_differ_db": {}}
    out["left_out"] = left_out
    if not read:
        return out
    press, quiet = FlatPress(skin), floor_energy()
    for label, trials in read.items():
        recorded = [energy(t.pac) for t in trials]
        unit = [np.mean([energy(press.slide(t, 1e-6, k)) for k in range(_SEEDS)], axis=0) for t in trials]

        def error(log_square, trial, recorded=recorded, unit=unit):
            return 10 * np.log10((np.exp(log_square) * unit[trial] + quiet) / recorded[trial])

        # the energy of all bands, as far as none of them is off by more than _BAND
        grid = np.linspace(-15, 15, 6001)
        worst = np.array([np.abs(error(x, 0)).max() for x in grid])
        whole = np.array([np.log((np.exp(x) * unit[0] + quiet).sum() / recorded[0].sum()) for x in grid])
        able = worst <= max(_BAND, worst.min())
        best = grid[able][np.argmin(np.abs(whole[able]))]
        out["roughness"][label] = float(1e-6 * np.exp(best / 2))
        out["energy_error_db"][label] = error(best, 1).tolist()
        out["energy_db"][label] = {
            "recorded": (10 * np.log10(recorded[1])).tolist(),
            "model": (10 * np.log10(recorded[1]) + error(best, 1)).tolist(),
        }
        out["trials_differ_db"][label] = (10 * np.log10(recorded[0] / recorded[1])).tolist()
    loud = np.array(
        [
            [(10 ** (np.array(e[k]) / 10)).sum() for k in ("recorded", "model")]
            for e in out["energy_db"].values()
        ]
    )
    first, second = np.argsort(loud[:, 0]), np.argsort(loud[:, 1])
    n = len(loud)
    pairs = [(loud[i, 0] < loud[j, 0]) == (loud[i, 1] < loud[j, 1]) for i in range(n) for j in range(i)]
    out |= {"order_right": bool((first == second).all()), "pairs_in_order": float(np.mean(pairs or [True]))}
    out["worst_energy_error_db"] = float(np.abs(list(out["energy_error_db"].values())).max())
    return out


# --- in mj_step ---


def _pac_of_step(handle, data, before, after):
    """Counts of the PAC slots after `before` up to `after`."""
    frame = handle.read(data, "pac")
    return [frame[k % SLOTS_PER_FRAME // 2] for k in range(before, after) if k % 2 == 0]


def _slots(seconds):
    return int(np.floor(seconds * SLOT_RATE + 1e-6))


def ridges(speed: float, pitch: float, height: float = 2e-4, skin: str = "coarse") -> tuple:
    """A ridged plate pressed 1.5 mm deep slides on the pad: PAC's peak [Hz], share of steps that converged,
    and seconds of a step."""
    dt, press, seconds = 2e-3, 75, 0.75
    spec = mujoco.MjSpec()
    spec.option.timestep, spec.option.gravity = dt, np.zeros(3)
    plate = spec.worldbody.add_body(name="plate", mocap=True, pos=_PLATE)
    plate.add_geom(
        name="plate", type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.06, 0.005, 0.03], friction=[0.3, 0, 0]
    )
    handle = biotac_mj.attach(
        spec,
        body="world",
        skin=skin,
        tier="condensed",
        coupling="one-way",
        friction=0.3,
        textures={"plate": {"pitch": pitch, "height": height}},
    )
    model = spec.compile()
    data = mujoco.MjData(model)
    pac, good = [], []
    for k in range(press + round(seconds / dt)):
        data.mocap_pos[0] = _PLATE + [speed * dt * max(0, k - press), 1.5e-3 * min(1, (k + 1) / press), 0]
        mujoco.mj_step(model, data)
        good.append(handle.read(data, "status")[0] == 1)
        pac += _pac_of_step(handle, data, _slots(k * dt), _slots((k + 1) * dt))
    biotac_mj.plugin.check()
    steady = np.array(pac[-int(0.6 * RATE) :], float)
    n = 2**16
    power = np.abs(np.fft.rfft((steady - steady.mean()) * np.hanning(len(steady)), n))
    f = np.fft.rfftfreq(n, 1 / RATE)
    beyond = f > 12
    return float(f[beyond][power[beyond].argmax()]), float(np.mean(good))


def slip(texture: str = "fiberboard", skin: str = "coarse") -> dict:
    """A block of 50 g held on the pad with 3 N is pulled along the finger with 2 N/s."""
    dt, settle = 2e-3, 0.3
    spec = mujoco.MjSpec()
    spec.option.timestep, spec.option.gravity = dt, np.zeros(3)
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    block = spec.worldbody.add_body(name="block", pos=_PLATE + [0, -2e-4, 0])
    for name, axis in (("along", [1, 0, 0]), ("press", [0, 1, 0])):
        block.add_joint(name=name, type=mujoco.mjtJoint.mjJNT_SLIDE, axis=axis, damping=[2.0, 0, 0])
    block.add_geom(
        name="block",
        type=mujoco.mjtGeom.mjGEOM_BOX,
        size=[0.02, 0.005, 0.02],
        mass=0.05,
        friction=[0.3, 0, 0],
    )
    handle = biotac_mj.attach(
        spec, body="world", skin=skin, tier="condensed", friction=0.3, textures={"block": texture}
    )
    model = spec.compile()
    data = mujoco.MjData(model)
    pac, moved, still = [], None, None
    for k in range(round(2.5 / dt)):
        pull = 2.0 * max(0.0, k * dt - settle)
        data.qfrc_applied[:] = pull, 3.0 * min(1.0, k * dt / (0.5 * settle))
        mujoco.mj_step(model, data)
        if k * dt <= settle:
            still = data.qpos[0]
        pac += _pac_of_step(handle, data, _slots(k * dt), _slots((k + 1) * dt))
        if abs(data.qpos[0] - still) > 0.5e-3:
            moved = (k + 1) * dt
            break
    biotac_mj.plugin.check()
    if moved is None:
        return {"slip_lead_ms": None}
    pac = np.array(pac, float)
    frames = pac[: len(pac) // NPAC * NPAC].reshape(-1, NPAC)
    loud = frames.std(1)  # a pull that grows is a steady offset of PAC
    held = slice(int((settle - 0.1) * 100), int(settle * 100))
    threshold = 2 * loud[held].mean()  # of noise alone, one frame in ten million
    heard = np.flatnonzero((loud > threshold) & (np.arange(len(loud)) > held.stop))
    seen = float(heard[0] + 1) * 0.01 if len(heard) else None
    return {
        "slip_seen_s": seen,
        "slip_half_mm_s": moved,
        "slip_lead_ms": 1e3 * (moved - seen) if seen else None,
        "slip_threshold_counts": float(threshold),
    }


def cost(steps: int = 2000) -> dict:
    """Seconds that vibration adds to a step of 2 ms on a firm press, default skin: modes and what the
    contacts do to them."""
    geoms = [Geom("plate", "box", np.array([0.03, 0.005, 0.03]), 0.3, 0)]
    stepper = CondensedStepper(Config(tier="condensed"), load_skin("default"), geoms)
    shaking, state = Shaking(stepper, geoms), np.zeros(stepper.nstate)
    stepper.reset(state)
    for depth in np.arange(5e-4, 1.6e-3, 2e-5):
        before = state
        result = stepper.solve_skin(state, (_PLATE + [0, depth, 0])[None], np.eye(3)[None], 2e-3)
        state = result.state
    sound = Vibration(shaking.modes, [Texture(roughness=1e-6)])
    sound.slip.numpy()[:] = 0.02
    out = {}
    for name, call in (
        ("modes", lambda: sound.advance(2e-3)),
        ("contacts", lambda: shaking.of_step(before, result, 2e-3)),
    ):
        call()
        taken = []
        for _ in range(steps):
            begin = time.perf_counter()
            call()
            taken.append(time.perf_counter() - begin)
        out[f"seconds_{name}"] = float(np.median(taken))
    return out


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--data", required=True, type=pathlib.Path)
    parser.add_argument("--json", type=pathlib.Path)
    parser.add_argument("--skin", default="default", help="of the slides")
    args = parser.parse_args()
    result = {}
    logs = [
        p for folder in (args.data, *args.data.parent.glob("btd*")) for p in sorted(folder.glob("*.btd*"))
    ]
    if logs:
        result |= floor(logs[0])
    if list(args.data.glob("*_bio.csv*")):
        result |= slides(args.data, args.skin)
    result["ridges"], errors = [], []
    for speed in (0.02, 0.03, 0.04, 0.05, 0.06):
        peak, good = ridges(speed, _PITCH)
        errors.append(abs(peak * _PITCH / speed - 1))
        result["ridges"].append(
            {"speed": speed, "peak_hz": peak, "expected_hz": speed / _PITCH, "converged": good}
        )
    result["peak_error_rel"] = max(errors)
    result |= slip() | {"slip_lead_ms_smooth": slip("smooth")["slip_lead_ms"]} | cost()
    text = json.dumps(result, indent=1)
    print(text)
    if args.json:
        write_json(args.json, result)


if __name__ == "__main__":
    main()
