"""Is the paper's latent projection better than PointNet++, when all rivals get what one of them has?

Rows of a table, all with five seeds: logarithm and tare for everybody; touches mirrored for nobody, since no
sensor is as symmetric as the simulation, and for all in rows of their own; three rates of dropout, with and
without the film's features, an electrode VAE that sees unpaired recordings too, mesh codes of a VAE and of
principal components, few to many labelled interactions; judged on unseen
trajectories, objects and sensors.

    O="--measured-skin default --device cuda"
    biotac generate --count 2600 --labelled 1400 $O --out out/set
    biotac generate --count 24 --labelled 24 --seed 1 --measured-seed 1 $O --out out/other
    python benchmarks/claim.py out/set out/other --device cuda --json out/claim.json
    python benchmarks/claim.py --table out/claim.json

The labels of most interactions are hidden, as in the paper: 323 train and choose, a tenth judges; of the
others meshes and readings, where there are any, may be used, but not their pairing. Networks of one kind
train side by side, a member for each seed and split, so that a GPU is busy. Rows that are in the JSON are
kept: a run that was stopped goes on.
"""

import argparse
import contextlib
import copy
import dataclasses
import json
import multiprocessing
import os
import pathlib
import re
import tempfile
import time

import numpy as np
import torch
from torch import nn
from torch.func import functional_call, stack_module_state, vmap

from biotac_mj.files import replacing
from biotac_mj.learning.instants.force import ridge
from biotac_mj.learning.networks.electrode_vae import ElectrodeVAE, mlp
from biotac_mj.learning.networks.heads import LocalHead, PodHead
from biotac_mj.learning.networks.hierarchy import build_hierarchy
from biotac_mj.learning.networks.mesh_vae import MeshVAE
from biotac_mj.learning.networks.pointnet import PointNet, farthest_points
from biotac_mj.learning.protocol import paired_test, quartiles
from biotac_mj.learning.training.arrays import load_arrays
from biotac_mj.learning.training.config import LearningConfig
from biotac_mj.learning.training.features import ELECTRODE_MIRROR, Pod
from biotac_mj.learning.training.fitting import _one_cycle, fast_products
from biotac_mj.learning.training.local import Features, counts_change
from biotac_mj.sensor.channels import log_impedance

SEEDS = (0, 1, 2, 3, 4)
OBJECTS = ("ring_7mm", "cube_14mm", "sphere_3-5mm")
DROPOUT = (0.0, 0.1, 0.3)
LABELLED, CHOOSING = 258, 65  # of the paper's 359: 72 and 18 %
CURVE = (64, 128, 258, 512, 1024)


@dataclasses.dataclass
class Member:
    """A network's part of the set: interactions that train with labels, without, that choose, and that judge,
    by name of the table."""

    split: str
    seed: int
    train: np.ndarray
    unpaired: np.ndarray
    choose: np.ndarray
    judge: dict[str, np.ndarray]


def members(objects, sensor, splits, labelled=LABELLED, measured=None):
    """Of all splits and seeds. objects, sensor, measured: (k,) of the interactions, of which sensor (those of
    sensor 0 train), and whether there are readings (None: of all)."""
    number = np.arange(len(objects))
    measured = np.ones(len(objects), bool) if measured is None else np.asarray(measured, bool)
    own = sensor == 0
    held = np.random.default_rng(5).permutation(len(number)) < len(number) / 10
    out = []
    for split in splits:
        mine = own & (~held if split == "trajectory" else objects != split)
        pool, read = number[mine], number[mine & measured]
        table = read[: round(min(LABELLED + CHOOSING, 0.7 * len(read)))]
        judge = {split: number[own & (held if split == "trajectory" else objects == split)]}
        if split == "trajectory" and (~own).any():
            judge["sensor"] = number[~own]
        choosing = round(len(table) * CHOOSING / (LABELLED + CHOOSING))
        for seed in SEEDS:
            order = np.random.default_rng([seed, 7]).permutation(table)
            choose, train = order[:choosing], order[choosing:]
            rest = np.setdiff1d(read, table)
            more = np.concatenate([train, np.random.default_rng([seed, 8]).permutation(rest)])
            if labelled != LABELLED and labelled > len(more):
                continue
            train = train if labelled == LABELLED else more[:labelled]
            out.append(Member(split, seed, train, np.setdiff1d(pool, np.r_[train, choose]), choose, judge))
    return out


def prepare(arrays, sensor, splits, config, file):
    """Writes all that networks read; arrays: of all sets in one; sensor: (k,) numbers of theirs."""
    features = Features(arrays, dataclasses.replace(config, window=()))
    geometry = arrays.geometry
    free = np.setdiff1d(np.arange(geometry.nvert), geometry.fixed)
    sample = free[farthest_points(geometry.vert[free], 128)]
    points = [torch.cat([f(u)[:, sample] for u in arrays.field.split(512)])
              for f in (lambda u: u.float(), features.mirror)]  # fmt: skip
    logs = lambda x: torch.as_tensor(log_impedance(x.double().cpu().numpy()), dtype=torch.float32)  # noqa: E731
    film = logs(arrays.simulated).to(arrays.device)
    pods = {}
    for split in splits:
        one = members(arrays.objects, sensor, [split], measured=arrays.labelled)[0]
        basis = Pod.fit(arrays.field, arrays.rows(np.r_[one.train, one.unpaired]), config.pod)
        both = torch.stack([features.components(basis), features.components(basis, True)])
        pods[split] = nn.functional.pad(both * (basis.scale / basis.scale[0]).sqrt(), (0, 0, 0, 1))
    torch.save(
        {
            "local": torch.stack([features.local, features.mirrored]),
            "points": torch.stack(points),
            "pod": pods,
            "change": logs(arrays.counts).to(film) - logs(arrays.tare).to(film),
            "film": film - film[arrays.first],
            "counts": arrays.counts,
            "tare": arrays.tare,
            "owner": arrays.owner,
            "first": arrays.first,
            "objects": list(map(str, arrays.objects)),
            "sensor": torch.as_tensor(sensor),
            "measured": torch.as_tensor(arrays.labelled),
            "place": torch.as_tensor(geometry.vert[sample]),
            "settings": dataclasses.asdict(config),
        },
        file,
    )


class FromRest(nn.Module):
    """A network's output less that for zero."""

    def __init__(self, net):
        super().__init__()
        self.net = net

    def forward(self, x):
        y = self.net(torch.cat([x, torch.zeros_like(x[:1])]))
        return y[:-1] - y[-1:]


class Film(nn.Module):
    """The head on each electrode's film features, with PointNet++ beside it or without."""

    def __init__(self, features, points=None):
        super().__init__()
        self.local, self.points = LocalHead(features, 32), points

    def forward(self, local, pod, *points):
        y = self.local(local, pod[:, :32])
        return y + self.points(*points) if points else y


class Call(nn.Module):
    """One method of a module, for functional calls."""

    def __init__(self, module, name):
        super().__init__()
        self.module, self.name = module, name

    def forward(self, x):
        y = getattr(self.module, self.name)(x)
        return y[0] if isinstance(y, tuple) else y


class Side:
    """Networks of one kind side by side, one for each member.

    Args:
      make: function () -> module, called with the seed set for each of `seeds`. rate: of dropout.
    """

    def __init__(self, make, seeds, device, rate=None):
        models = []
        for seed in seeds:
            torch.manual_seed(seed)
            models.append(make().to(device))
            for layer in models[-1].modules():
                if isinstance(layer, nn.Dropout) and rate is not None:
                    layer.p = rate
        self.parameters, buffers = stack_module_state(models)
        own = ("scale", "damp")  # what differs between members, and is no index
        self.buffers = {k: v if k.endswith(own) else v[0] for k, v in buffers.items()}
        self._where = {k: 0 if k.endswith(own) else None for k in buffers}
        self.base = copy.deepcopy(models[0])

    def __call__(self, *x, method=None):
        base, name = (self.base, "") if method is None else (Call(self.base, method), "module.")
        base.train(self.base.training)
        given = [{name + k: v for k, v in part.items()} for part in (self.parameters, self.buffers)]
        where = {name + k: v for k, v in self._where.items()}
        work = lambda p, b, *x: functional_call(base, (p, b), x)  # noqa: E731
        return vmap(work, (0, where, *[0] * len(x)), randomness="different")(*given, *x)


class Table:
    """What jobs share: the prepared tensors, and where the codes of the mesh VAE come to lie."""

    def __init__(self, folder, device, steps, until):
        self.folder, self.device, self.steps, self.until = pathlib.Path(folder), device, steps, until
        d = torch.load(self.folder / "prepared.pt", map_location=device, weights_only=True)
        self.__dict__.update(d)
        self.objects, self.sensor = np.array(self.objects), self.sensor.cpu().numpy()
        self.measured = self.measured.cpu().numpy()
        self.order = torch.as_tensor(ELECTRODE_MIRROR, device=device)
        self.config = LearningConfig(**self.settings)
        self.place = self.place.cpu().numpy()

    def rows(self, interactions, labelled=True):
        wanted = torch.zeros(len(self.objects), dtype=torch.bool, device=self.device)
        wanted[torch.as_tensor(np.asarray(interactions), device=self.device)] = True
        mask = wanted[self.owner]
        if labelled:
            mask = mask & torch.isfinite(self.counts).all(1)
            mask &= torch.arange(len(mask), device=self.device) != self.first
        return mask.nonzero()[:, 0]

    def pick(self, sets, count, generator=None):
        """(members, count) rows of each member's: drawn, or spread evenly."""
        if generator is None:
            return torch.stack(
                [r[torch.linspace(0, len(r) - 1, count, device=self.device).long()] for r in sets]
            )
        return torch.stack(
            [r[torch.randint(len(r), (count,), device=self.device, generator=generator)] for r in sets]
        )

    def targets(self, rows, flip, value):
        y = value[rows]
        return torch.where(flip[..., None], y[..., self.order], y)

    def train(self, side, loss, sets, check=None, judge=None, batch=128, rate=1e-3):
        """Trains all members; loss: function (rows, flip) -> (members,). judge: the same, on rows `check`."""
        parameters = list(side.parameters.values())
        for p in parameters:
            p.requires_grad_(True)
        optimizer = torch.optim.AdamW(parameters, rate, weight_decay=0.01)
        generator = torch.Generator(device=self.device).manual_seed(0)
        best, kept = None, None
        side.base.train()
        for step in range(self.steps):
            if time.time() > self.until:
                raise TimeoutError
            optimizer.param_groups[0]["lr"] = rate * _one_cycle(step / self.steps)
            rows = self.pick(sets, batch, generator)
            flip = torch.rand(rows.shape, device=self.device, generator=generator) < 0.5
            optimizer.zero_grad(set_to_none=True)
            loss(rows, flip).sum().backward()
            optimizer.step()
            if check is not None and ((step + 1) % max(1, self.steps // 12) == 0 or step + 1 == self.steps):
                side.base.eval()
                with torch.no_grad():
                    now = (judge or loss)(check, torch.zeros_like(check, dtype=torch.bool))
                    better = torch.ones_like(now, dtype=torch.bool) if best is None else now < best
                    best = now if best is None else torch.minimum(now, best)
                    kept = [
                        torch.where(better.view(-1, *[1] * (p.ndim - 1)), p, k)
                        for p, k in zip(parameters, kept or parameters)
                    ]
                side.base.train()
        with torch.no_grad():
            for p, k in zip(parameters, kept or ()):
                p.copy_(k)
        for p in parameters:
            p.requires_grad_(False)
        side.base.eval()

    def code(self, name, parts):
        """Function (rows, flip) -> (members, k, n) codes of the mesh, and that of rest (members, 1, n)."""
        if name == "pod":
            tables = self.pod
        else:
            tables = {
                one.split: torch.load(self.folder / f"code-{one.split}.pt", map_location=self.device)["code"]
                for one in parts
            }
        splits = list(dict.fromkeys(one.split for one in parts))
        stack = torch.stack([tables[s] for s in splits])
        which = torch.tensor([splits.index(one.split) for one in parts], device=self.device)[:, None]
        read = lambda rows, flip: stack[which, flip.long(), rows]  # noqa: E731
        last = torch.full((len(parts), 1), stack.shape[2] - 1, device=self.device)
        return read, read(last, torch.zeros_like(last, dtype=torch.bool))


@fast_products()
def head(t, parts, kind, dropout, teach=False, log=True, mirror=False):
    """Networks trained in one piece; yields a function (rows) -> (members, k, 19) change of counts."""
    film, points = kind in ("local", "pointnet_film"), "pointnet" in kind
    pods, rest = t.code("pod", parts)

    def make():
        if kind == "pod":
            return PodHead(rest.shape[-1])
        net = PointNet(t.place, np.arange(len(t.place))) if points else None
        net = FromRest(net) if points and log else net
        return Film(t.local.shape[-1], net) if film else net

    side = Side(make, [one.seed for one in parts], t.device, dropout)
    if film:
        size = t.local[0][t.rows(parts[0].train, False)].square().mean((0, 1)).sqrt() + 1e-6
        side.buffers["local.scale"] = size.expand(len(parts), -1).clone()

    def output(rows, flip):
        at = (flip.long(), rows)
        if kind == "pod":
            return side(torch.zeros_like(rows[..., None, None], dtype=torch.float32), pods(rows, flip))
        given = (t.local[at], pods(rows, flip)) if film else ()
        return side(*given, *((t.points[at],) if points else ()))

    def counts(rows, flip):
        y = output(rows, flip)
        return counts_change(y, t.targets(rows, flip, t.tare)) if log else 2048 * y

    def loss(rows, flip):
        flip = flip & mirror
        error = counts(rows, flip) - t.targets(rows, flip, t.counts - t.tare)
        return (error.square().mean(-1) + 1e-10).sqrt().mean(-1) / 2048

    def teacher(rows, flip):
        error = output(rows, flip) - t.targets(rows, flip, t.film)
        return (error.square().mean(-1) + 1e-10).sqrt().mean(-1)

    if teach:
        t.train(side, teacher, [t.rows(np.r_[one.train, one.unpaired], False) for one in parts], rate=2e-3)
    check = [t.rows(one.choose) for one in parts]
    check = t.pick(check, min(600, min(map(len, check))))
    t.train(side, loss, [t.rows(one.train) for one in parts], check, rate=5e-4 if teach else 1e-3)
    return lambda rows: counts(rows, torch.zeros_like(rows, dtype=torch.bool))


@fast_products()
def latent(t, parts, code, dropout, unpaired=True, log=True, mirror=False, film=False, decoded=False):
    """Latent projection: electrode VAE, then a projection from the mesh's code to its code, frozen."""
    y = t.change if log else (t.counts - t.tare) / 2048
    tare_row = (torch.arange(len(y), device=t.device) == t.first)[:, None]
    y = torch.where(tare_row, 0.0, y)
    seeds = [one.seed for one in parts]
    vae = Side(ElectrodeVAE, seeds, t.device)
    labelled = [t.rows(one.train) for one in parts]
    sets = [t.rows(np.r_[one.train, one.unpaired]) for one in parts] if unpaired else labelled
    check = [t.rows(one.choose) for one in parts]
    check = t.pick(check, min(600, min(map(len, check))))

    def vae_loss(rows, flip):
        x = t.targets(rows, flip & mirror, y)
        got, mean, log_variance = vae(x)
        divergence = 0.5 * (mean.square() + log_variance.exp() - 1 - log_variance).sum(-1)
        return ((got - x).square().sum(-1) + t.config.electrode_kl * divergence).mean(-1)

    t.train(vae, vae_loss, sets, check)
    codes, rest = t.code(code, parts)
    size = t.local[0][labelled[0]].square().mean((0, 1)).sqrt() + 1e-6
    width = rest.shape[-1] + (t.local[0, 0].numel() if film else 0)
    side = Side(lambda: mlp([width, *t.config.forward_hidden, 8], dropout or 1e-9), seeds, t.device, dropout)
    decode = lambda z: vae(z, method="decode")  # noqa: E731

    def project(rows, flip):
        x = codes(rows, flip)
        if film:
            x = torch.cat([x, (t.local[flip.long(), rows] / size).flatten(-2)], -1)
        return side(x)

    def readings(rows, flip):
        got = decode(project(rows, flip))
        if not log:
            return 2048 * got
        start = torch.cat([rest, torch.zeros(len(parts), 1, width - rest.shape[-1], device=t.device)], -1)
        return counts_change(got - decode(side(start)), t.targets(rows, flip, t.tare))

    def in_counts(rows, flip):
        flip = flip & mirror
        error = readings(rows, flip) - t.targets(rows, flip, t.counts - t.tare)
        return (error.square().mean(-1) + 1e-10).sqrt().mean(-1) / 2048

    def in_code(rows, flip):
        flip = flip & mirror
        with torch.no_grad():
            z = vae(t.targets(rows, flip, y), method="encode")
        return ((project(rows, flip) - z).square().mean(-1) + 1e-10).sqrt().mean(-1)

    t.train(side, in_counts if decoded else in_code, labelled, check)
    predict = lambda rows: readings(rows, torch.zeros_like(rows, dtype=torch.bool))  # noqa: E731

    def bound(rows):  # the readings themselves through the code of 8
        got = vae(y[rows])[0]
        return counts_change(got, t.tare[rows]) if log else 2048 * got

    return {"": predict, " bound": bound}


def plain(t, parts, kind):
    """Rows without a network."""
    zero = torch.zeros(len(parts), 19, device=t.device)
    if kind == "tare":
        return lambda rows: torch.zeros(*rows.shape, 19, device=t.device)
    if kind.startswith("physics"):
        gain = zero + 1
        if kind == "physics_gain":
            fits = [t.rows(one.train) for one in parts]
            gain = torch.stack(
                [(t.film[r] * t.change[r]).sum(0) / t.film[r].square().sum(0).clamp(min=1e-9) for r in fits]
            )
        return lambda rows: counts_change(gain[:, None] * t.film[rows], t.tare[rows])
    pods, _ = t.code("pod", parts)
    weights = []
    for k, one in enumerate(parts):

        def read(rows, flip, k=k):
            rows = rows[None].expand(len(parts), -1)
            return pods(rows, torch.full_like(rows, flip, dtype=torch.bool))[k].double().cpu().numpy()

        fit, check = t.rows(one.train), t.rows(one.choose)
        x = np.concatenate([read(fit, False), read(fit, True)])
        y = t.change[fit].double().cpu().numpy()
        y = np.concatenate([y, y[:, ELECTRODE_MIRROR]])
        xc, yc = read(check, False), t.change[check].double().cpu().numpy()
        tries = [ridge(x, y, s)[0] for s in (1e-3, 1e-2, 1e-1, 1.0, 10.0)]
        weights.append(min(tries, key=lambda w: ((xc @ w - yc) ** 2).mean()))
    weights = torch.as_tensor(np.array(weights), dtype=torch.float32, device=t.device)
    return lambda rows: counts_change(
        pods(rows, torch.zeros_like(rows, dtype=torch.bool)) @ weights, t.tare[rows]
    )


@torch.no_grad()
def errors(t, parts, predict):
    """{table: {seed: {interaction: RMS over electrodes, averaged over its steps [counts]}}}."""
    sets = [torch.cat([t.rows(j) for j in one.judge.values()]) for one in parts]
    most = max(map(len, sets))
    padded = torch.stack([torch.cat([r, r[-1:].expand(most - len(r))]) for r in sets])
    got = torch.cat([predict(r) for r in padded.split(256, 1)], 1)
    truth = (t.counts - t.tare)[padded]
    got = torch.minimum(torch.maximum(got, -t.tare[padded]), 4095 - t.tare[padded])
    rms = (got - truth).square().mean(-1).sqrt().cpu().numpy()
    out = {}
    for one, rows, value in zip(parts, sets, rms):
        owner = t.owner[rows].cpu().numpy()
        for name, judge in one.judge.items():
            found = {
                str(k): round(float(value[: len(rows)][owner == k].mean()), 3)
                for k in judge
                if (owner == k).any()
            }
            out.setdefault(name, {})[str(one.seed)] = found
    return out


RATES = 5e-4, 1.7e-4, 5.6e-5  # of a mesh VAE, one after the other
PATIENCE, GAIN = 6, 0.99  # checks after which a rate is done if the validation error has not fallen so far


def converge(net, loss, rows, validate, batch, seconds, keep, said, every=None, seed=0):
    """Trains at each of RATES until the validation error no longer falls: it did not come below GAIN times
    what it was for PATIENCE checks, after which the best state goes on at the next rate. Where time runs
    short a rate ends before (at 55, 80 and 100 % of it).

    Args:
      loss: function (rows) -> scalar. rows: (k,) to draw from. validate: function () -> [mm].
      keep: file of the state, from which a training that was stopped goes on. said: called with what is found
        so far after each check.
      every: steps between checks; None: an epoch.

    Returns:
      {"steps", "epochs", "curve": [[step, rate, validation]], "seconds", "ended": for each rate whether
      "flat" or "time", "converged": all flat}.
    """
    parameters = list(net.parameters())
    optimizer = torch.optim.AdamW(parameters, RATES[0], weight_decay=0.0, fused=rows.is_cuda)
    generator = torch.Generator(device=rows.device).manual_seed(seed)
    every = every or max(1, len(rows) // batch)
    at = {
        "step": 0,
        "stage": 0,
        "spent": 0.0,
        "best": None,
        "mark": None,
        "since": 0,
        "curve": [],
        "ended": [],
    }
    best = copy.deepcopy(net.state_dict())
    if keep.is_file():
        kept = torch.load(keep, map_location=rows.device, weights_only=True)
        at, best = kept["at"], kept["best"]
        net.load_state_dict(kept["net"])
        optimizer.load_state_dict(kept["optimizer"])
        generator.set_state(kept["generator"].cpu())
    shares, begun = (0.55, 0.8, 1.0), time.time() - at["spent"]
    net.train()
    while at["stage"] < len(RATES):
        for group in optimizer.param_groups:
            group["lr"] = RATES[at["stage"]]
        for _ in range(every):
            chosen = rows[torch.randint(len(rows), (batch,), generator=generator, device=rows.device)]
            optimizer.zero_grad(set_to_none=True)
            value = loss(chosen)
            value.backward()
            optimizer.step()
        at["step"] += every
        if not torch.isfinite(value):
            raise ValueError(f"the mesh VAE's loss is {float(value)} at step {at['step']}")
        net.eval()
        with torch.no_grad():
            now = float(validate())
        net.train()
        at["curve"].append([at["step"], RATES[at["stage"]], round(now, 5)])
        at["since"] += 1
        if at["best"] is None or now < at["best"]:
            at["best"], best = now, copy.deepcopy(net.state_dict())
        if at["mark"] is None or now < GAIN * at["mark"]:
            at["mark"], at["since"] = now, 0
        at["spent"] = time.time() - begun
        late = at["spent"] > shares[at["stage"]] * seconds
        if at["since"] >= PATIENCE or late:
            at["ended"].append("flat" if at["since"] >= PATIENCE else "time")
            at["stage"], at["since"] = at["stage"] + 1, 0
            net.load_state_dict(best)
        with replacing(keep) as temporary:
            torch.save(
                {"at": at, "best": best, "net": net.state_dict(), "optimizer": optimizer.state_dict(),
                 "generator": generator.get_state()},
                temporary,
            )  # fmt: skip
        said(_found(at, batch, len(rows)))
    net.load_state_dict(best)
    net.eval()
    return _found(at, batch, len(rows))


def _found(at, batch, rows):
    return {
        "steps": at["step"],
        "batch": batch,
        "rows": rows,
        "epochs": round(at["step"] * batch / rows, 2),
        "seconds": round(at["spent"], 1),
        "curve": at["curve"],
        "validation_mm": at["best"],
        "ended": at["ended"],
        "converged": len(at["ended"]) == len(RATES) and set(at["ended"]) == {"flat"},
    }


def mesh_vae(t, split, seconds):
    """Trains the mesh VAE of a split until it is flat, or the time is up; keeps the codes of all rows, says
    what it came to. What it has so far lies in "mesh_vae SPLIT.part" after each check."""
    begun = time.time()
    full = torch.load(t.folder / "field.pt", map_location="cpu", weights_only=False)
    arrays, mirrored = full["arrays"], full["mirrored"]
    field = arrays.field.to(t.device)
    c, g = t.config, arrays.geometry
    torch.manual_seed(0)
    net = MeshVAE(build_hierarchy(g.vert, g.tets, c.mesh_factors), c.mesh_first, c.mesh_channels, c.mesh_last,
                  c.mesh_hidden, c.mesh_latent, c.mesh_order).to(t.device)  # fmt: skip
    one = members(t.objects, t.sensor, [split], measured=t.measured)[0]
    # of seed 0: other seeds' interactions that choose are among them
    unseen = np.random.default_rng(9).permutation(np.r_[one.train, one.unpaired])
    unseen, check = unseen[: int(0.95 * len(unseen))], unseen[int(0.95 * len(unseen)) :]
    rows, check = t.rows(unseen, False), t.rows(check, False)
    check = check[torch.linspace(0, len(check) - 1, min(512, len(check))).long()]

    def loss(r):
        u = field[r].float()
        got, mean, log_variance = net(u)
        divergence = 0.5 * (mean.square() + log_variance.exp() - 1 - log_variance).sum(1)
        return (got - u).square().flatten(1).sum(1).mean() + c.mesh_kl * divergence.mean()

    def node_error(r):
        return torch.cat(
            [(net(field[k].float())[0] - field[k].float()).norm(dim=2).mean(1) for k in r.split(64)]
        )

    def said(found):
        with replacing(t.folder / f"mesh_vae {split}.part") as temporary:
            pathlib.Path(temporary).write_text(json.dumps(found))
        step, rate, now = found["curve"][-1]
        print(f"{found['seconds']:6.0f} s  mesh_vae {split}: step {step}, {found['epochs']} epochs, "
              f"rate {rate:g}, {1e3 * now:.1f} um", flush=True)  # fmt: skip

    with fast_products():
        left = min(seconds, t.until - begun) - (time.time() - begun) - 10
        validate = lambda: node_error(check).mean()  # noqa: E731
        found = converge(net, loss, rows, validate, c.mesh_batch, left, t.folder / f"vae-{split}.pt", said)
        with torch.no_grad():
            judged = t.rows(one.judge[split], False)
            judged = judged[torch.linspace(0, len(judged) - 1, min(2000, len(judged))).long()]
            error = float(node_error(judged).mean())
            zero = torch.zeros_like(field[:1]).float()
            codes = [torch.cat([net.encode(u.to(t.device).float())[0] for u in [*part.split(128), zero]])
                     for part in (field, mirrored)]  # fmt: skip
    with replacing(t.folder / f"code-{split}.pt") as temporary:
        torch.save({"code": torch.stack(codes)}, temporary)
    return found | {"test_mm": error}


def _of_row(splits, name):
    """The splits of a row of the mesh VAE's code: unseen trajectories, or unseen objects, in a row of
    their own so that neither waits for the other's mesh VAEs."""
    return tuple(s for s in splits if (s != "trajectory") == name.endswith("objects"))


def jobs(splits, curve, vae_seconds):
    """{name: function (Table) -> rows of the JSON}, those that matter first."""

    def row(work, splits=splits, labelled=LABELLED, **kind):
        def run(t):
            parts = members(t.objects, t.sensor, splits, labelled, t.measured)
            if not parts:
                return {}
            got = work(t, parts, **kind)
            return {
                k: errors(t, parts, f) for k, f in (got.items() if isinstance(got, dict) else [("", got)])
            }

        return run

    out = {}
    for split in splits:
        out[f"mesh_vae {split}"] = lambda t, split=split: {"": mesh_vae(t, split, vae_seconds)}
    for kind in ("tare", "physics", "physics_gain", "linear"):
        out[kind] = row(plain, kind=kind)
    for d in DROPOUT:
        for kind in ("pointnet", "local", "pod"):
            out[f"{kind} dropout {d:g}"] = row(head, kind=kind, dropout=d)
        out[f"latent_pod dropout {d:g}"] = row(latent, code="pod", dropout=d)
    for word in "", " objects":
        part = _of_row(splits, word)
        if not part:
            continue
        for d in DROPOUT:
            out[f"latent_vae dropout {d:g}{word}"] = row(latent, part, code="vae", dropout=d)
        kind = dict(code="vae", dropout=0.3, unpaired=False, log=False)
        out[f"latent_vae as the paper{word}"] = row(latent, part, **kind)
        out[f"latent_vae film{word}"] = row(latent, part, code="vae", dropout=0.1, film=True)
        kind = dict(code="vae", dropout=0.1)
        out[f"latent_vae labelled electrodes{word}"] = row(latent, part, unpaired=False, **kind)
        out[f"latent_vae decoded{word}"] = row(latent, part, decoded=True, **kind)
    out["pointnet as the paper"] = row(head, kind="pointnet", dropout=0.3, log=False)
    for d in (0.1, 0.0, 0.3):
        out[f"pointnet_film dropout {d:g}"] = row(head, kind="pointnet_film", dropout=d)
    for kind in ("local", "pod", "pointnet"):
        out[f"{kind} mirrored"] = row(head, kind=kind, dropout=0.1, mirror=True)
    for kind in ("local", "pod", "pointnet"):
        out[f"{kind} taught"] = row(head, kind=kind, dropout=0.1, teach=True)
    kind = dict(code="pod", dropout=0.1)
    out["latent_pod labelled electrodes"] = row(latent, unpaired=False, **kind)
    out["latent_pod mirrored"] = row(latent, mirror=True, **kind)
    out["latent_pod film"] = row(latent, film=True, **kind)
    out["latent_pod decoded"] = row(latent, decoded=True, **kind)
    for n in curve if "trajectory" in splits else ():
        if n != LABELLED:
            only = dict(splits=("trajectory",), labelled=n, dropout=0.1)
            out[f"local labels {n}"] = row(head, kind="local", **only)
            out[f"pointnet labels {n}"] = row(head, kind="pointnet", **only)
            out[f"pod labels {n}"] = row(head, kind="pod", **only)
            out[f"latent_pod labels {n}"] = row(latent, code="pod", **only)
            out[f"latent_vae labels {n}"] = row(latent, code="vae", **only)
    return out


def work(folder, device, steps, until, splits, curve, vae_seconds, kinds):
    """A process that does one job after another until none is left or the time is up. kinds: whether mesh
    VAEs too, which come first."""
    torch.set_num_threads(1)
    t = Table(folder, device, steps, until)
    todo = {
        k: v for k, v in jobs(splits, curve, vae_seconds).items() if kinds or not k.startswith("mesh_vae")
    }
    while time.time() < until:
        waiting = False
        for name, job in todo.items():
            mark = t.folder / f"{name}.begun"
            if mark.exists():
                continue
            if name.startswith("latent_vae"):
                if not all((t.folder / f"code-{s}.pt").is_file() for s in _of_row(splits, name)):
                    waiting = True
                    continue
            try:
                mark.touch(exist_ok=False)
            except FileExistsError:
                continue
            begun = time.time()
            try:
                found = job(t)
            except TimeoutError:
                return
            except (ValueError, RuntimeError) as error:  # one row less, not all
                print(f"{name}: {type(error).__name__}: {error}", flush=True)
                continue
            text = json.dumps({"seconds": round(time.time() - begun, 1), "steps": steps, "found": found})
            with replacing(t.folder / f"{name}.row") as temporary:
                pathlib.Path(temporary).write_text(text)
            print(f"{time.time() - begun:6.1f} s  {name}", flush=True)
        if not waiting:
            return
        time.sleep(1)


def run(
    arrays,
    sensor,
    out,
    device,
    seconds,
    steps,
    splits,
    curve,
    workers,
    vae_seconds,
    config=None,
    about=None,
    vae_workers=1,
    keep=None,
    devices=None,
    only=None,
):
    """Does all rows that `out` (JSON) lacks, as far as the time goes.

    Args:
      keep: folder where what was prepared, states of the mesh VAEs and their codes stay, so that they go on;
        None: they are made anew. devices: of the workers, in turn; None: `device` for all.
      only: function (name) -> whether that row is wanted; None: all."""
    until, config = time.time() + seconds, config or LearningConfig()
    result = json.loads(out.read_text()) if out.is_file() else {"rows": {}}
    result |= {"about": about or {}, "objects": list(map(str, arrays.objects)), "sensor": sensor.tolist()}
    with contextlib.ExitStack() as stack:
        folder = pathlib.Path(keep or stack.enter_context(tempfile.TemporaryDirectory()))
        folder.mkdir(parents=True, exist_ok=True)
        for path in folder.glob("*.begun"):  # of a run that was stopped
            path.unlink()
        if not (folder / "field.pt").is_file():
            prepare(arrays, sensor, splits, config, folder / "prepared.pt")
            mirror = Features(arrays, LearningConfig(window=())).mirror
            mirrored = torch.cat([mirror(u).half().cpu() for u in arrays.field.split(512)])
            kept = dataclasses.replace(arrays, field=arrays.field.cpu())
            with replacing(folder / "field.pt") as temporary:
                torch.save({"arrays": kept, "mirrored": mirrored}, temporary)
            del kept, mirrored, mirror
        for name in result["rows"]:
            code = folder / f"code-{name.removeprefix('mesh_vae ')}.pt"
            if "_vae" not in name or keep and (not name.startswith("mesh_vae") or code.is_file()):
                (folder / f"{name}.begun").touch()
        if only:
            for name in jobs(splits, curve, vae_seconds):
                if not only(name):
                    (folder / f"{name}.begun").touch()
        again = multiprocessing.get_context("spawn")
        where = [(devices or [device])[k % len(devices or [device])] for k in range(workers)]
        given = (steps, until, splits, curve, vae_seconds)
        mine = [
            again.Process(target=work, args=(str(folder), where[k], *given, k < vae_workers))
            for k in range(workers)
        ]
        for one in mine:
            one.start()
        last = False
        while not last:
            last = not any(one.is_alive() for one in mine) or time.time() > until + 2
            for path in folder.glob("*.row"):
                result["rows"][path.stem] = json.loads(path.read_text())
            for path in folder.glob("*.part"):
                result.setdefault("on_the_way", {})[path.stem] = json.loads(path.read_text())
            with replacing(out) as temporary:
                pathlib.Path(temporary).write_text(json.dumps(result))
            if not last:
                time.sleep(min(3, seconds / 20))
        for one in mine:
            one.terminate() if one.is_alive() else None
            one.join()
    return result


def together(sets):
    """Arrays of several sets on one mesh as one; sensor (k,): the number of the set."""
    shift, parts = 0, []
    for a in sets:
        begin = sum(len(p.owner) for p in parts)
        parts.append(dataclasses.replace(a, owner=a.owner + shift, first=a.first + begin))
        shift += len(a.objects)
    tensors = ("field", "owner", "first", "time", "counts", "tare", "simulated", "force")
    whole = {k: torch.cat([getattr(p, k) for p in parts]) for k in tensors}
    whole |= {k: np.concatenate([getattr(p, k) for p in parts]) for k in ("objects", "labelled")}
    sensor = np.concatenate([np.full(len(p.objects), k) for k, p in enumerate(parts)])
    return dataclasses.replace(parts[0], **whole), sensor


def vaes(result):
    """{split: what is known of its mesh VAE}."""
    rows = {k: row["found"][""] for k, row in result["rows"].items() if k.startswith("mesh_vae")}
    return {k.removeprefix("mesh_vae "): v for k, v in (result.get("on_the_way", {}) | rows).items()}


def draw(result, path):
    """Validation errors of the mesh VAEs over their epochs, and where the rate fell."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7, 4), layout="constrained")
    axes = figure.subplots()
    for k, (split, found) in enumerate(vaes(result).items()):
        step, rate, error = np.array(found["curve"]).T
        epoch = step * found["batch"] / found["rows"]
        axes.semilogy(epoch, 1e3 * error, color=f"C{k}", label=split)
        for i in np.flatnonzero(np.diff(rate)):
            axes.axvline(epoch[i], color=f"C{k}", lw=0.7, ls=":")
    axes.set(xlabel="epochs", ylabel="mean error on validation [um]")
    axes.legend()
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=120)


def table(result):
    """The tables as text: medians over interactions, each averaged over the seeds."""
    lines = [
        f"mesh VAE, {split}: {v['steps']} steps of {v['batch']}, {v['epochs']} epochs, {v['seconds']:.0f} s, "
        f"validation {1e3 * v['validation_mm']:.1f} um, rates ended {', '.join(v['ended'])}"
        + (f", test {1e3 * v['test_mm']:.1f} um" if "test_mm" in v else "")
        for split, v in vaes(result).items()
        if "epochs" in v
    ]
    names = dict.fromkeys(
        s for row in result["rows"].values() for found in row["found"].values() for s in found
    )  # fmt: skip
    for split in (s for s in names if s in (*OBJECTS, "trajectory", "sensor")):
        per = {}
        for name, row in result["rows"].items():
            for what, found in row["found"].items():
                if isinstance(found.get(split), dict):
                    seeds = list(found[split].values())
                    keys = seeds[0].keys()
                    per[name.removesuffix(" objects") + what] = (
                        {k: np.mean([s[k] for s in seeds]) for k in keys},
                        [np.median(list(s.values())) for s in seeds],
                    )
        if not per:
            continue
        size = len(next(iter(per.values()))[0])
        lines.append(f"unseen {split}: {size} interactions; RMS per interaction, counts (synthetic sensor)")
        for name, (mean, seeds) in sorted(per.items(), key=lambda item: np.median(list(item[1][0].values()))):
            middle, low, high = quartiles(list(mean.values()))
            spread = f"{min(seeds):.2f} .. {max(seeds):.2f}"
            lines.append(f"  {name:<44}{middle:>8.2f}  {low:6.2f} .. {high:6.2f}  {spread:>16}")
        best = {}
        for kind in ("latent_vae", "latent_pod", "pointnet", "local", "pod"):
            mine = {n: v for n, v in per.items() if n.startswith(f"{kind} dropout") and "bound" not in n}
            if mine:
                best[kind] = min(mine, key=lambda n: np.median(list(mine[n][0].values())))
        pairs = [(a, b) for a in ("latent_vae", "latent_pod", "local", "pod") for b in ("pointnet",)]
        for a, b in [*pairs, ("local", "pod"), ("latent_vae", "latent_pod")]:
            if a in best and b in best and size >= 5:
                keys = per[best[a]][0].keys()
                x, y = ([per[best[k]][0][i] for i in keys] for k in (a, b))
                test = paired_test(x, y)
                share, more = 100 * test["better"], test["median_difference"]
                lines.append(
                    f"  {best[a]} against {best[b]}: better on {share:.0f} % of {size}, median of "
                    f"differences {more:+.2f}, p = {test['p']:.2g}"
                )
    return "\n".join(lines)


def main(argv=None):
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("sets", nargs="*", help="the labelled set; then those of other sensors")
    parser.add_argument("--table", type=pathlib.Path, help="print what a JSON says, and do nothing")
    parser.add_argument("--json", type=pathlib.Path, default=pathlib.Path("out/claim.json"))
    parser.add_argument("--device", default="cpu", help="of torch")
    parser.add_argument("--seconds", type=float, default=36000.0, help="after which nothing new begins")
    parser.add_argument("--vae-seconds", type=float, default=1200.0, help="of each mesh VAE")
    parser.add_argument("--steps", type=int, default=2500, help="of every other network")
    parser.add_argument("--splits", nargs="+", default=["trajectory", *OBJECTS])
    parser.add_argument("--workers", type=int, default=2, help="processes")
    parser.add_argument("--vae-workers", type=int, default=1, help="of these, that train mesh VAEs")
    parser.add_argument("--devices", nargs="+", help="of the processes, in turn (default: --device)")
    parser.add_argument("--keep", type=pathlib.Path, help="folder of states, from which a run goes on")
    parser.add_argument("--only", help="regular expression of the rows that are wanted")
    parser.add_argument("--figure", type=pathlib.Path, help="PNG of the mesh VAEs' validation errors")
    given = parser.parse_args(argv)
    if given.table:
        result = json.loads(given.table.read_text())
        if given.figure:
            draw(result, given.figure)
        return print(table(result))
    given.json.parent.mkdir(parents=True, exist_ok=True)
    arrays, sensor = together([load_arrays(path, given.device) for path in given.sets])
    result = run(arrays, sensor, given.json, given.device, given.seconds, given.steps, given.splits, CURVE,
                 given.workers, given.vae_seconds, vae_workers=given.vae_workers, keep=given.keep,
                 devices=given.devices, only=given.only and re.compile(given.only).search)  # fmt: skip
    if given.figure:
        draw(result, given.figure)
    print(table(result))


if __name__ == "__main__":
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    main()
