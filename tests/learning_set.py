"""A small data set whose truth is known: smooth dents, and electrodes that answer to the film above them by a
rule written here."""

import numpy as np

from biotac_mj.data import Interaction, shard_path, write_shard
from biotac_mj.data.contact import contact_labels
from biotac_mj.geometry import load_skin

OBJECTS = ("sphere_7mm", "cube_14mm", "ring_7mm", "cylinder_long_7mm")


def dent(geometry, centre, depth, radius, slide):
    """(nvert, 3) [m]: a Gaussian dent towards the finger's axis, with a slide along x."""
    vert = geometry.vert
    inward = -vert * [0, 1, 1]
    inward /= np.linalg.norm(inward, axis=1, keepdims=True) + 1e-9
    bell = np.exp(-0.5 * ((vert - centre) ** 2).sum(1) / radius**2)
    u = bell[:, None] * (depth * inward + slide * np.array([1.0, 0, 0]))
    u[geometry.fixed] = 0
    return u


def log_change(geometry, u):
    """(nelectrode,): the rule. 600 per metre of the mean inward motion of the inner nodes within 2.5 mm of an
    electrode."""
    inner = np.setdiff1d(np.unique(geometry.inner_face), geometry.fixed)
    out = np.empty(len(geometry.electrode_pos))
    for e, (place, normal) in enumerate(zip(geometry.electrode_pos, geometry.electrode_normal)):
        w = np.exp(-0.5 * ((geometry.vert[inner] - place) ** 2).sum(1) / 1.5e-3**2)
        out[e] = -600 * (w @ (u[inner] @ normal)) / w.sum()
    return out


def make_set(folder, count=40, steps=6, seed=0, skin="coarse", noise=1.0, labelled=None, gain=1.0):
    """Writes shards and returns their folder. The first `labelled` interactions are labelled; simulated
    changes are 0.8 as large."""
    geometry = load_skin(skin)
    rng = np.random.default_rng(seed)
    outer = np.unique(geometry.outer_face)
    pad = geometry.vert[outer]
    pad = pad[(pad[:, 1] < -3e-3) & (pad[:, 0] < 0)]
    n, rest = geometry.design.nelectrode, np.array(geometry.design.rests[1 % len(geometry.design.rests)])
    z0 = np.log(4095 / rest - 1)
    groups = {True: [], False: []}
    for k in range(count):
        name = OBJECTS[k % len(OBJECTS)]
        centre = pad[rng.integers(len(pad))]
        depth = np.linspace(0, rng.uniform(0.3e-3, 1.2e-3), steps)
        slide = np.linspace(0, rng.uniform(-0.3e-3, 0.3e-3), steps)
        radius = (1.5e-3, 3e-3, 2e-3, 2.5e-3)[k % 4]
        u = np.array([dent(geometry, centre, d, radius, s) for d, s in zip(depth, slide)])
        d = np.array([log_change(geometry, x) for x in u])
        counts = np.full((steps, len(geometry.design.channels)), 2000.0)
        counts[:, :n] = np.rint(4095 / (1 + np.exp(z0 + 0.8 * d)))
        bell = np.exp(-0.5 * ((geometry.vert[outer] - centre) ** 2).sum(1) / radius**2)
        force = (depth[:, None] * 1e3 * np.where(bell > 0.4, bell, 0) / bell.sum())[..., None] * [
            0.0,
            1.0,
            0.0,
        ]
        flag = labelled is None or k < labelled
        zeros = {
            "wrench": np.zeros((steps, 6)),
            "pressure": np.zeros(steps),
            "indenter_pos": np.zeros((steps, 3)),
        }
        one = dict(
            id=f"t{seed}-{k}",
            object=name,
            kind="press",
            split="train",
            seed=k,
            parameters={},
            time=0.05 * np.arange(steps),
            displacement=u,
            contact_force=force,
            **contact_labels(geometry, u, force),
            impedance=1e4 * np.exp(z0 + 0.8 * d),
            **zeros,
            counts=counts,
            indenter_quat=np.tile([1.0, 0, 0, 0], (steps, 1)),
            converged=np.ones(steps, bool),
        )
        if flag:
            measured = counts.copy()
            measured[:, :n] = np.rint(
                4095 / (1 + np.exp(z0 + gain * d)) + noise * rng.normal(size=(steps, n))
            )
            measured[0, :n] = rest
            one |= dict(measured_counts=measured, measured_wrench=np.zeros((steps, 6)))
        groups[flag].append(Interaction(**one))
    for number, part in enumerate(g for g in groups.values() if g):
        write_shard(shard_path(folder, number), part, geometry, {"synthetic": True})
    return folder
