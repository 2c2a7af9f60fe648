"""What one constant, the same for all sensors, does to the tip (E7 to E10) on rows kept aside.

python benchmarks/real_tip.py --press E1.txt F1.txt --press E2.txt F2.txt --mechanism fill --json OUT

Recordings of flat presses on a force plate. A mechanism of `biotac diagnose --simulate` is in the model as
a whole (an amount of 1); then those of --then are tried on top of it, as one number more, on blocks of the
first 70 % of the rows that they are not fitted on. The last 30 % are judged with it and without, gains held
at 1 and fitted, all electrodes seen and five of them not."""

import argparse
import copy
import json
import pathlib

import numpy as np
from real_match import HELD_OUT
from records import write_json

from biotac_mj.discrepancy.evidence import sign_flip
from biotac_mj.discrepancy.plates.models import blocks, judge, press_rows
from biotac_mj.discrepancy.plates.tables import base_response, with_effects
from biotac_mj.discrepancy.recordings.recording import read_recording
from biotac_mj.effects.plate import PLATE
from biotac_mj.geometry.skins import load_skin
from biotac_mj.matching.fit import Setup, fit_constants, fit_states
from biotac_mj.quality.noise import noise_level

TIP = [6, 7, 8, 9]
ONE, GAINS = Setup(gains=0.0), Setup()


def locked(response: dict, rows: object, aside: object) -> dict:
    """Scores of the rows kept aside by name of the model and of the gains; blocks better than the first."""
    out, first = {}, None
    const, matched = fit_constants(response["base"], rows, ONE)
    start = const, matched.state  # all go on from here, the base model too
    for model, answers in response.items():
        for gains, setup in (("gains 1", ONE), ("gains fitted", GAINS)):
            const, _ = fit_constants(answers, rows, setup, start)
            seen = np.setdiff1d(np.arange(19), HELD_OUT)
            error = fit_states(answers, aside, const, setup).counts - aside.counts
            blind = fit_states(answers, aside, const, setup, electrodes=seen).counts - aside.counts
            views = {"tip": error[:, TIP], "all": error, "not seen": blind[:, HELD_OUT]}
            first = first or views
            out[f"{model}, {gains}"] = {"E_Pa": const.modulus} | {
                name: {"rms": float(np.sqrt((e**2).mean())), "blocks_better": _better(first[name], e)}
                for name, e in views.items()
            }
    return out


def _better(before, after):
    return sum(int((before[b] ** 2).mean() > (after[b] ** 2).mean()) for b in blocks(len(after)))


def _compared(smaller, larger, noise):
    """RMS at the tip and of all electrodes by both models, and the evidence for the larger one."""
    gain = larger.gain(smaller, noise)
    out = {"nats": float(gain.sum()), "p": sign_flip(gain)}
    for where, which in {"tip": TIP, "all": slice(None)}.items():
        before, after = (float(np.sqrt((one.error[:, which] ** 2).mean())) for one in (smaller, larger))
        out[where] = {"before": before, "after": after}
    return out


def main(argv: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--press", nargs=2, action="append", required=True, metavar=("E", "F"))
    names = [one.id for one in PLATE]
    parser.add_argument("--mechanism", choices=names, default="fill")
    parser.add_argument("--then", choices=names, nargs="*", default=["tip_film", "friction"])
    parser.add_argument("--json", type=pathlib.Path, default="out/benchmarks/real_tip.json")
    given = parser.parse_args(argv)
    given.json.parent.mkdir(parents=True, exist_ok=True)
    by_id, geometry = {one.id: one for one in PLATE}, load_skin("coarse")
    tried = [by_id[name] for name in dict.fromkeys([given.mechanism, *given.then])]
    base, _, states = base_response(geometry)
    response = with_effects(base, states, geometry, tried)
    whole = response.amended(np.eye(len(tried))[0])
    out = {}
    for electrodes, force in given.press:
        recording = read_recording(electrodes, force)
        rows, aside = press_rows(recording)
        one = judge(base, rows, ONE, judge(base, rows, ONE))
        more = judge(whole, rows, ONE, one)
        noise = noise_level(recording.electrodes, recording.repeated)
        found = {given.mechanism: _compared(one, more, noise)}
        for k, then in enumerate(tried[1:], 1):
            answers = copy.copy(whole)
            answers.changes = response.changes[k : k + 1]
            on_top = judge(answers, rows, Setup(gains=0.0, amount=1.0), more)
            found[f"{then.id} on top"] = _compared(more, on_top, noise)
            print(then.id, [then.value(float(c.amount[0])) for c in on_top.constants], then.unit)
        out[recording.name] = {
            "first_70": found,
            "locked": locked({"base": base, given.mechanism: whole}, rows, aside),
        }
        print(recording.name, json.dumps(out[recording.name], indent=1))
    write_json(given.json, out)


if __name__ == "__main__":
    main()
