"""Measures what one real sensor has of its own in a recording: the numbers of `sensor/presets.py`.

python benchmarks/sensor_presets.py RECORDING [--force F.txt] [--rate HZ] [--json OUT]

RECORDING is a text of 19 columns of raw counts (`--force`: three of force [N] beside it, where it was
loaded), a native log `*.btd[.gz]`, or a folder of `*_HOLD.mat` (two sensors of a gripper, whose effort
says how hard). Numbers are what one reads at no load and at the recording's beginning:

  rest      ln Z of each electrode as a + b . (force, normal force^2) + warm-up, at no force and time 0,
            from the 8 % of the rows under least force; a log's is the median of its first seconds, of a
            gripper that of its softest holds. `loaded` says that it was never untouched.
  warm_up   [C] that the change of ln Z that all electrodes share stands for, at 7.1 % per degree, when it is
            over, and warm_time [s] of its exponential.
  noise     RMS from second differences, which drift and slow loads hardly change; that of rounding is taken
            off. PAC's: first order, by its lag-one correlation (holds: in their quietest second)."""

import argparse
import pathlib
import re

import numpy as np
import scipy.io
from records import write_json
from vibration import read_rows

from biotac_mj.recordings.own import noise, rest_of
from biotac_mj.sensor.channels import ELECTRODES

_BEGIN = 5.0  # [s] of a log that nothing touches
_FRAME = 100  # rows of a hold in a second


def colour(pac: np.ndarray) -> tuple[float, float]:
    """Lag-one correlation and white-noise RMS of samples (n, k) of PAC, blocks of k."""
    pac = pac - pac.mean()
    keep = float((pac[:, 1:] * pac[:, :-1]).mean() / (pac**2).mean())
    return keep, float(pac.std() * np.sqrt(1 - keep**2))


def of_text(path: pathlib.Path, force: pathlib.Path | None, rate: float) -> dict:
    """Of a text of 19 columns."""
    return {path.name: rest_of(np.loadtxt(path), rate, None if force is None else np.loadtxt(force))}


def of_log(path: pathlib.Path) -> dict:
    """Of a native log: frames of a resting sensor at its beginning."""
    rows = read_rows(path)
    held = {}
    for channel in (1, 2, 3, *range(17, 36)):
        one = rows[rows[:, 1] == channel]
        held[channel] = one[:, 2:], one[one[:, 0] < _BEGIN, 2:]
    count = min(len(begin) for _, begin in held.values())
    electrodes = np.column_stack([held[17 + e][1][:count] for e in range(len(ELECTRODES))])
    pac = rows[(rows[:, 1] == 0) & (rows[:, 0] < _BEGIN)][:, 2]
    keep, white = colour(pac[: len(pac) // 88 * 88].reshape(-1, 88))
    out = {"rest": np.median(electrodes, axis=0), "loaded": False, "noise": noise(electrodes)}
    for name, channel in (("pdc", 1), ("tac", 2), ("tdc", 3)):
        out[f"{name}_rest"] = float(np.mean(held[channel][1]))
        out[f"{name}_noise"] = float(noise(held[channel][1])[0])
    return {path.name: out | {"pac_rest": float(pac.mean()), "pac_colour": keep, "pac_noise": white}}


def of_holds(folder: pathlib.Path) -> dict:
    """Of both sensors of a gripper. They are never untouched: rests are those of the holds with least effort,
    a third of all."""
    trials = [scipy.io.loadmat(p) for p in folder.glob("*_HOLD.mat")]
    if not trials:
        raise SystemExit(f"{folder} has no *_HOLD.mat: give the folder of the holds")
    trials.sort(key=lambda trial: abs(np.median(trial["JEff"])))
    out = {}
    for finger in ("F0", "F1"):
        all_ = [{k[2:]: t[k].T.astype(float) for k in t if k.startswith(finger)} for t in trials]
        soft = all_[: -(-len(all_) // 3)]
        one = {
            "rest": np.median([np.median(t["Electrodes"], axis=0) for t in soft], axis=0),
            "loaded": True,
            "noise": np.median([noise(t["Electrodes"]) for t in all_], axis=0),
        }
        for name in ("pdc", "tac", "tdc"):
            one[f"{name}_rest"] = float(np.median([np.median(t[name]) for t in soft]))
            one[f"{name}_noise"] = float(np.median([noise(t[name]) for t in all_]))
        seconds = [t["pac"].reshape(-1, _FRAME * t["pac"].shape[1]) for t in soft]
        quiet = np.array([min(blocks, key=np.std) for blocks in seconds])
        keep, white = colour(quiet)
        out[finger] = one | {"pac_rest": float(quiet.mean()), "pac_colour": keep, "pac_noise": white}
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("recording", type=pathlib.Path)
    parser.add_argument("--force", type=pathlib.Path)
    parser.add_argument("--rate", type=float, default=118.0, help="of a text [Hz]")
    parser.add_argument("--json", type=pathlib.Path)
    args = parser.parse_args()
    path = args.recording
    if path.is_dir():
        found = of_holds(path)
    elif re.search(r"\.btd(\.gz)?$", path.name):
        found = of_log(path)
    else:
        found = of_text(path, args.force, args.rate)
    plain = {
        name: {
            k: np.round(v, 2).tolist() if isinstance(v, (np.ndarray, float)) else v for k, v in one.items()
        }
        for name, one in found.items()
    }
    for name, one in plain.items():
        print(name)
        for key, value in one.items():
            print(f"  {key:11}", " ".join(f"{v:g}" for v in np.ravel(value)))
    if args.json:
        write_json(args.json, plain)


if __name__ == "__main__":
    main()
