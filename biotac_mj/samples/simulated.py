"""Simulates touches for samples, and a set of them, in a minute."""

import io
import pathlib

import mujoco
import numpy as np

from ..coupling import attach
from ..data.generation.plan import plan_motions
from ..data.objects import make_object
from ..effects.catalogue import by_id
from ..geometry import load_skin
from ..geometry.rigid import quaternion
from ..plugin import explained
from ..press.indenter import add_indenter
from ..quality.clock import BUS_RATE
from ..recordings import Recording
from ..recordings.simulated import of_simulation
from ..resimulation.resimulate import ResimulateOptions, resimulate
from .contents import EFFECT, EVERY, OBJECT, PLACES, SKIN, TOUCHES

_TOUCH, _AWAY = 80, 40  # rows of a touch, as slow as a hand's, and on either side of it
_GENTLE = 0.3, 0.6  # range of the drawn fraction of the planned depth: hard presses take long to solve
_BEFORE = 1000  # rows before the first touch
_CLEAR = 4e-3  # [m] distance of the object between touches
_SET_RATE = 10.0  # [Hz] of the set's rows: eight or nine per touch


def tables(recording: Recording) -> dict[str, bytes]:
    """electrodes.txt, forces.txt and log.csv of a recording."""
    first = _BEFORE + PLACES * (_TOUCH + 2 * _AWAY)
    columns = {
        "time": recording.time,
        **{f"e{i + 1}": column for i, column in enumerate(recording.electrodes.T)},
        **{name: getattr(recording, name) for name in ("pdc", "tac", "tdc")},
        **{f"F{a}": column for a, column in zip("xyz", recording.force.T)},
        **{f"object_pos_{a}": column for a, column in zip("xyz", recording.object_pos.T)},
        **{f"object_q{a}": column for a, column in zip("wxyz", recording.object_quat.T)},
    }
    return {
        "electrodes.txt": _table(recording.electrodes, "%.0f"),
        "forces.txt": _table(recording.force, "%.4f"),
        "log.csv": _table(np.column_stack(list(columns.values()))[:first:EVERY], "%.9g", ",".join(columns)),
    }


def make_set(recording: Recording, out: pathlib.Path, seed: int, progress: bool) -> None:
    """Resimulates a recording's touches as a set.

    Raises:
      ValueError: the folder holds another one.
    """
    options = ResimulateOptions(skin=SKIN, rate=_SET_RATE, batch=TOUCHES, seed=seed)
    resimulate(recording, out, options, workers=0, progress=progress)


def _table(rows, form, header=""):
    memory = io.BytesIO()
    np.savetxt(memory, rows, form, "," if header else " ", header=header, comments="")
    return memory.getvalue()


def record_touches(seed: int = 0, touches: int = TOUCHES) -> Recording:
    """A sphere presses and slides at PLACES of the skin, round after round to other depths, with a sensor
    that has EFFECT, at 100 Hz: synthetic, with the condensed skin.

    Args:
      seed: of the touches and the noise. touches: number of touches.
    """
    paths = plan_motions(
        load_skin(SKIN), OBJECT, [[seed, i] for i in range(min(PLACES, touches))], _TOUCH, ("press", "slide")
    )
    depths = np.random.default_rng([seed, PLACES]).uniform(*_GENTLE, touches)
    pos, quat = _touch_paths([paths[i % PLACES] for i in range(touches)], depths)
    pos, quat = (np.concatenate([np.tile(x[:1], (_BEFORE, 1)), x]) for x in (pos, quat))
    spec = mujoco.MjSpec()
    spec.option.timestep, spec.option.gravity = 1 / BUS_RATE, np.zeros(3)
    spec.worldbody.add_body(name="finger")
    body = spec.worldbody.add_body(name="object", pos=pos[0], quat=quat[0], mocap=True)
    # without friction of its own: MuJoCo takes the larger one, so the skin's counts
    slick = [0.0, 0.005, 1e-4]
    add_indenter(spec, body, make_object(OBJECT), contype=0, conaffinity=0, friction=slick)
    name, theta = EFFECT
    handle = attach(
        spec,
        body="finger",
        skin=SKIN,
        tier="condensed",
        coupling="one-way",
        geoms=["indenter"],
        effects=[(by_id(name), theta)],
        seed=seed,
        on_error="raise",
    )
    reads = []
    with explained():
        model = spec.compile()
        data = mujoco.MjData(model)
        for p, q in zip(pos, quat):
            data.mocap_pos[0], data.mocap_quat[0] = p, q
            mujoco.mj_step(model, data)
            reads.append(handle.read(data))
    return of_simulation(
        np.arange(len(pos)) / BUS_RATE,
        reads,
        object_pos=pos,
        object_quat=quat,
        name="synthetic",
        object=OBJECT,
        source="biotac data samples: synthetic",
    )


def _touch_paths(paths, depths):
    """Poses (n, 3) and (n, 4) of successive touches: approach and retraction; depths: fraction of each
    path."""  # Slow near the skin, because electrodes are read with a delay of some milliseconds.
    out = np.r_[1.0, 1.0, np.linspace(1, 0, _AWAY - 2, endpoint=False) ** 2][:, None]
    pos, mat = [], []
    for path, depth in zip(paths, depths):
        inside = path.pos[0] + depth * (path.pos - path.pos[0])
        first, last = (inside[k] - _CLEAR * out * path.mat[k][:, 1] for k in (0, -1))
        pos += [first, inside, last[::-1]]
        mat.append(path.mat[np.r_[np.zeros(_AWAY, int), : len(path.mat), np.full(_AWAY, -1)]])
    return np.concatenate(pos), quaternion(np.concatenate(mat))
