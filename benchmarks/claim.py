"""Is the paper's latent projection better than PointNet++, when all rivals get what one of them has?

Rows of a table, all with five seeds: PointNet++, a head on the film of each electrode, latent projection from
principal components and from the mesh VAE, at three rates of dropout, with the logarithm and the tare for
everybody; the projections trained through the decoder; both rivals in the paper's own setting; the simulated
film with gains, and no change. Judged on unseen trajectories, objects and sensors.

    O="--measured-skin default --device cuda"
    biotac data generate --count 2600 --labelled 1400 $O --out out/set
    biotac data generate --count 24 --labelled 24 --seed 1 --measured-seed 1 $O --out out/other
    python benchmarks/claim.py out/set out/other --device cuda --json out/claim.json
    python benchmarks/claim.py --table out/claim.json

The labels of most interactions are hidden, as in the paper: 323 train and choose, a tenth judges; of the
others meshes and readings, where there are any, may be used, but not their pairing. Mesh VAEs train first.
Rows that are in the JSON are kept: a run that was stopped goes on.
"""

import argparse
import contextlib
import copy
import dataclasses
import functools
import json
import os
import pathlib
import re
import tempfile
import time

import numpy as np
import torch
from records import read_json, write_json
from torch import nn

from biotac_mj.files import replacing
from biotac_mj.geometry.solid import farthest_points
from biotac_mj.learning.networks.electrode_vae import ElectrodeVAE, mlp
from biotac_mj.learning.networks.heads import FromRest, LocalHead
from biotac_mj.learning.networks.hierarchy import build_hierarchy
from biotac_mj.learning.networks.mesh_vae import MeshVAE
from biotac_mj.learning.networks.pointnet import PointNet
from biotac_mj.learning.protocol import paired_test, quartiles
from biotac_mj.learning.training.arrays import join, load_arrays
from biotac_mj.learning.training.config import LearningConfig
from biotac_mj.learning.training.features import Pod
from biotac_mj.learning.training.fitting import TrainingOptions, fast_products, root_mean_square, train
from biotac_mj.learning.training.local import Features, counts_change
from biotac_mj.sensor.channels import log_impedance
from biotac_mj.shards import Task, one_per_gpu, run_tasks

SEEDS = (0, 1, 2, 3, 4)
OBJECTS = ("ring_7mm", "cube_14mm", "sphere_3-5mm")
DROPOUT = (0.0, 0.1, 0.3)
LABELLED, CHOOSING = 258, 65  # of the paper's 359: 72 and 18 %
SCALE = 2048.0  # counts
_CHECKED = 600  # rows at most, spread evenly, that choose


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


def members(objects, sensor, splits, measured=None):
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
            out.append(Member(split, seed, train, np.setdiff1d(pool, table), choose, judge))
    return out


def prepare(arrays, sensor, splits, config, folder):
    """Writes all that networks read; arrays: of all sets in one; sensor: (k,) numbers of theirs."""
    features = Features(arrays, config)
    geometry = arrays.geometry
    free = np.setdiff1d(np.arange(geometry.nvert), geometry.fixed)
    sample = free[farthest_points(geometry.vert[free], 128)]
    logs = lambda x: torch.as_tensor(log_impedance(x.double().cpu().numpy()), dtype=torch.float32)  # noqa: E731
    film = logs(arrays.simulated).to(arrays.device)
    pods = {}
    for split in splits:
        one = members(arrays.objects, sensor, [split], arrays.labelled)[0]
        basis = Pod.fit(arrays.field, arrays.rows(np.r_[one.train, one.unpaired]), config.pod)
        code = features.components(basis) * (basis.scale / basis.scale[0]).sqrt()
        pods[split] = nn.functional.pad(code, (0, 0, 0, 1))  # the last row is rest
    prepared = {
        "local": features.local,
        "points": torch.cat([u.float()[:, sample] for u in arrays.field.split(512)]),
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
    }
    mesh = {"field": arrays.field.cpu(), "vert": geometry.vert, "tets": geometry.tets}
    for name, content in (("prepared.pt", prepared), ("mesh.pt", mesh)):
        with replacing(folder / name) as temporary:
            torch.save(content, temporary)


class Table:
    """The prepared tensors, and where the codes of the mesh VAE come to lie.

    Args:
      steps: of every network but the mesh VAE.
    """

    def __init__(self, folder, device, steps):
        self.folder, self.device, self.steps = pathlib.Path(folder), device, steps
        d = torch.load(self.folder / "prepared.pt", map_location=device, weights_only=True)
        self.__dict__.update(d)
        self.objects, self.sensor = np.array(self.objects), self.sensor.cpu().numpy()
        self.measured = self.measured.cpu().numpy()
        self.config = LearningConfig(**self.settings)
        self.place = self.place.cpu().numpy()

    def rows(self, interactions, labelled=True):
        """(k,) numbers of rows; labelled: that have readings, without the tare's."""
        wanted = torch.zeros(len(self.objects), dtype=torch.bool, device=self.device)
        wanted[torch.as_tensor(np.asarray(interactions), device=self.device)] = True
        mask = wanted[self.owner]
        if labelled:
            mask = mask & torch.isfinite(self.counts).all(1)
            mask &= torch.arange(len(mask), device=self.device) != self.first
        return mask.nonzero()[:, 0]

    def spread(self, rows, count):
        """That many of them at most, evenly."""
        return rows[torch.linspace(0, len(rows) - 1, min(count, len(rows)), device=self.device).long()]

    def train(self, module, loss, rows, check, seed):
        """Trains a module by a loss (rows) -> scalar; the state that is best on rows `check` is kept."""
        options = TrainingOptions(128, self.steps, 1e-3, weight_decay=0.01, seed=seed)
        train(module, loss, rows, options, lambda: loss(check))

    def wrong(self, counts, rows):
        """Loss of a change of counts (k, 19)."""
        return root_mean_square(counts - (self.counts - self.tare)[rows]) / SCALE

    def code(self, name, split):
        """(n, k) codes of the mesh of all rows, the last row that of rest; name: "pod" or "vae"."""
        if name == "pod":
            return self.pod[split]
        return torch.load(self.folder / f"code-{split}.pt", map_location=self.device, weights_only=True)


def network(make, seed, device, dropout=None):
    """A module made with the seed, with this rate of dropout."""
    torch.manual_seed(seed)
    net = make().to(device)
    for layer in net.modules():
        if isinstance(layer, nn.Dropout) and dropout is not None:
            layer.p = dropout
    return net


@fast_products()
def head(t, one, kind, dropout, log=True):
    """Networks trained in one piece; function (rows) -> (k, 19) change of counts, by name."""
    pods = t.code("pod", one.split)
    if kind == "local":
        modes = min(32, pods.shape[1])
        net = network(
            lambda: LocalHead(t.local.shape[-1], modes, t.counts.shape[1]), one.seed, t.device, dropout
        )
        everything = t.rows(np.r_[one.train, one.unpaired], False)
        net.scale.copy_(t.local[everything].square().mean((0, 1)).sqrt() + 1e-6)
        output = lambda rows: net(t.local[rows], pods[rows][:, :modes])  # noqa: E731
    else:
        make = lambda: PointNet(t.place, np.arange(len(t.place)), t.counts.shape[1])  # noqa: E731
        net = network((lambda: FromRest(make())) if log else make, one.seed, t.device, dropout)
        output = lambda rows: net(t.points[rows])  # noqa: E731

    def counts(rows):
        y = output(rows)
        return counts_change(y, t.tare[rows]) if log else SCALE * y

    check = t.spread(t.rows(one.choose), _CHECKED)
    t.train(net, lambda rows: t.wrong(counts(rows), rows), t.rows(one.train), check, one.seed)
    return {"": counts}


@fast_products()
def latent(t, one, code, dropout, unpaired=True, log=True, decoded=False):
    """Latent projection: electrode VAE, then a projection from the mesh's code to its code, frozen.

    Args:
      unpaired: whether the electrode VAE sees readings without a mesh, too. log: d ln Z; else tared counts.
      decoded: whether the projection is trained through the decoder, else on the code.
    """
    y = t.change if log else (t.counts - t.tare) / SCALE
    tare_row = (torch.arange(len(y), device=t.device) == t.first)[:, None]
    y = torch.where(tare_row, 0.0, y)
    labelled, check = t.rows(one.train), t.spread(t.rows(one.choose), _CHECKED)
    vae = network(lambda: ElectrodeVAE(t.counts.shape[1]), one.seed, t.device)

    def vae_loss(rows):
        got, mean, log_variance = vae(y[rows])
        divergence = 0.5 * (mean.square() + log_variance.exp() - 1 - log_variance).sum(-1)
        return ((got - y[rows]).square().sum(-1) + t.config.electrode_kl * divergence).mean()

    t.train(vae, vae_loss, t.rows(np.r_[one.train, one.unpaired]) if unpaired else labelled, check, one.seed)
    vae.requires_grad_(False)
    codes = t.code(code, one.split)
    layers = [codes.shape[1], *t.config.forward_hidden, vae.latent]
    net = network(lambda: mlp(layers, dropout or 1e-9), one.seed, t.device, dropout)

    def readings(rows):
        got = vae.decode(net(codes[rows]))
        return counts_change(got - vae.decode(net(codes[-1:])), t.tare[rows]) if log else SCALE * got

    def in_code(rows):
        return root_mean_square(net(codes[rows]) - vae.encode(y[rows])[0])

    loss = (lambda rows: t.wrong(readings(rows), rows)) if decoded else in_code
    t.train(net, loss, labelled, check, one.seed)

    def bound(rows):  # the readings themselves through the code of 8
        got = vae(y[rows])[0]
        return counts_change(got, t.tare[rows]) if log else SCALE * got

    return {"": readings, " bound": bound}


def plain(t, one, kind):
    """Rows without a network: no change, or the simulated film with gains."""
    if kind == "tare":
        return {"": lambda rows: torch.zeros(len(rows), 19, device=t.device)}
    r = t.rows(one.train)
    gain = (t.film[r] * t.change[r]).sum(0) / t.film[r].square().sum(0).clamp(min=1e-9)
    return {"": lambda rows: counts_change(gain * t.film[rows], t.tare[rows])}


@torch.no_grad()
def errors(t, one, predict):
    """{table: {interaction: RMS over electrodes, averaged over its steps [counts]}}."""
    out = {}
    for name, judge in one.judge.items():
        rows = t.rows(judge)
        got = torch.cat([predict(r) for r in rows.split(4096)])
        got = torch.minimum(torch.maximum(got, -t.tare[rows]), 4095 - t.tare[rows])
        rms = (got - (t.counts - t.tare)[rows]).square().mean(-1).sqrt().cpu().numpy()
        owner = t.owner[rows].cpu().numpy()
        out[name] = {str(k): round(float(rms[owner == k].mean()), 3) for k in np.unique(owner)}
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


def mesh_vae(t, split, seconds, report):
    """Trains the mesh VAE of a split until it is flat, or the time is up; keeps the codes of all rows, gives
    what it came to."""
    begun = time.time()
    mesh = torch.load(t.folder / "mesh.pt", map_location="cpu", weights_only=False)
    field, c = mesh["field"].to(t.device), t.config
    torch.manual_seed(0)
    levels = build_hierarchy(mesh["vert"], mesh["tets"], c.mesh_factors)
    net = MeshVAE(
        levels, c.mesh_first, c.mesh_channels, c.mesh_last, c.mesh_hidden, c.mesh_latent, c.mesh_order
    ).to(t.device)
    one = members(t.objects, t.sensor, [split], t.measured)[0]
    # of seed 0: other seeds' interactions that choose are among them
    unseen = np.random.default_rng(9).permutation(np.r_[one.train, one.unpaired])
    unseen, check = unseen[: int(0.95 * len(unseen))], unseen[int(0.95 * len(unseen)) :]
    rows, check = t.rows(unseen, False), t.spread(t.rows(check, False), 512)

    def loss(r):
        u = field[r].float()
        got, mean, log_variance = net(u)
        divergence = 0.5 * (mean.square() + log_variance.exp() - 1 - log_variance).sum(1)
        return (got - u).square().flatten(1).sum(1).mean() + c.mesh_kl * divergence.mean()

    def node_error(r):
        return torch.cat(
            [(net(field[k].float())[0] - field[k].float()).norm(dim=2).mean(1) for k in r.split(64)]
        ).mean()

    def said(found):
        step, rate, now = found["curve"][-1]
        report(
            f"{found['seconds']:6.0f} s  mesh_vae {split}: step {step}, {found['epochs']} epochs, "
            f"rate {rate:g}, {1e3 * now:.1f} um"
        )

    with fast_products():
        left = seconds - (time.time() - begun) - 10
        keep = t.folder / f"vae-{split}.pt"
        found = converge(net, loss, rows, lambda: node_error(check), c.mesh_batch, left, keep, said)
        with torch.no_grad():
            error = float(node_error(t.spread(t.rows(one.judge[split], False), 2000)))
            zero = torch.zeros_like(field[:1]).float()
            code = torch.cat([net.encode(u.float())[0] for u in [*field.split(128), zero]])
    with replacing(t.folder / f"code-{split}.pt") as temporary:
        torch.save(code, temporary)
    return found | {"test_mm": error}


def of_row(splits, name):
    """The splits of a row of the mesh VAE's code: unseen trajectories, or unseen objects, in a row of
    their own."""
    return tuple(s for s in splits if (s != "trajectory") == name.endswith("objects"))


def jobs(splits):
    """{name of a row: (function (Table, Member) -> predictions by name, splits)}, those that matter first."""
    out = {kind: (functools.partial(plain, kind=kind), splits) for kind in ("tare", "physics_gain")}
    paper = dict(dropout=0.3, log=False)
    for d in DROPOUT:
        for kind in ("pointnet", "local"):
            out[f"{kind} dropout {d:g}"] = functools.partial(head, kind=kind, dropout=d), splits
        out[f"latent_pod dropout {d:g}"] = functools.partial(latent, code="pod", dropout=d), splits
    out["pointnet as the paper"] = functools.partial(head, kind="pointnet", **paper), splits
    out["latent_pod decoded"] = functools.partial(latent, code="pod", dropout=0.1, decoded=True), splits
    for word in "", " objects":
        part, vae = of_row(splits, word), functools.partial(latent, code="vae")
        if not part:
            continue
        for d in DROPOUT:
            out[f"latent_vae dropout {d:g}{word}"] = functools.partial(vae, dropout=d), part
        out[f"latent_vae as the paper{word}"] = functools.partial(vae, unpaired=False, **paper), part
        out[f"latent_vae decoded{word}"] = functools.partial(vae, dropout=0.1, decoded=True), part
    return out


class Work:
    """Work of `shards.run_tasks`: of the name of a row, or of a mesh VAE, that row."""

    def __init__(self, folder, device, steps, until, splits, vae_seconds):
        self.table, self.until = (str(folder), device, steps), until
        self.splits, self.vae_seconds = tuple(splits), vae_seconds

    def __call__(self, names, folder, report):
        torch.set_num_threads(1)
        t, rows = Table(*self.table), jobs(self.splits)
        for name in names:
            begun = time.time()
            if begun > self.until:
                continue
            try:
                if name in rows:
                    found = self._row(t, *rows[name])
                else:
                    seconds = min(self.vae_seconds, self.until - begun)
                    found = {"": mesh_vae(t, name.removeprefix("mesh_vae "), seconds, report)}
                yield name, {"seconds": round(time.time() - begun, 1), "steps": t.steps, "found": found}
            except (ValueError, RuntimeError) as error:  # one row less, not all
                report(f"{name}: {type(error).__name__}: {error}")
            report(1)

    def _row(self, t, work, splits):
        found = {}
        for one in members(t.objects, t.sensor, splits, t.measured):
            for what, predict in work(t, one).items():
                for judged, value in errors(t, one, predict).items():
                    found.setdefault(what, {}).setdefault(judged, {})[str(one.seed)] = value
        return found


def places(devices, workers):
    """The device of torch in each process, and {process: what is added to its environment}."""
    if devices[0] == "cpu":
        return "cpu", {f"process {k}": {"OMP_NUM_THREADS": "1"} for k in range(workers)}
    visible = list(one_per_gpu("cuda:0" if d == "cuda" else d for d in devices).values())
    return "cuda:0", {f"process {k}": visible[k % len(visible)] for k in range(workers)}


def run(arrays, sensor, options, config=None):
    """Does all rows that `options.json` lacks, as far as the time goes. options: see `main`."""
    until, splits = time.time() + options.seconds, tuple(options.splits)
    result = read_json(options.json, {"rows": {}})
    result |= {"objects": list(map(str, arrays.objects)), "sensor": sensor.tolist()}
    device, processes = places(options.devices or [options.device], options.workers)
    with contextlib.ExitStack() as stack:
        folder = pathlib.Path(options.keep or stack.enter_context(tempfile.TemporaryDirectory()))
        folder.mkdir(parents=True, exist_ok=True)
        if not (folder / "mesh.pt").is_file():
            prepare(arrays, sensor, splits, config or LearningConfig(), folder)
        work = Work(folder, device, options.steps, until, splits, options.vae_seconds)
        coded = {f"mesh_vae {s}" for s in splits if (folder / f"code-{s}.pt").is_file()}
        for names in wanted(splits, options.only, set(result["rows"]), coded):
            tasks = map(Task, names)
            for name, row in run_tasks(work, tasks, folder, "claim", "row", processes=processes):
                result["rows"][name] = row
                write_json(options.json, result)
    return result


def wanted(splits, only, done, coded):
    """Names of the mesh VAEs that must be trained, then of the rows that are missing.

    Args:
      only: regular expression of the rows that are asked for, or None. done: names of the rows that are
        there. coded: names of the mesh VAEs whose codes are.
    """
    pattern = re.compile(only or "")
    rows = [name for name in jobs(splits) if name not in done and pattern.search(name)]
    needed = {s for name in rows if name.startswith("latent_vae") for s in of_row(splits, name)}
    vaes = [f"mesh_vae {s}" for s in splits]
    asked = [v for v in vaes if v.removeprefix("mesh_vae ") in needed or v not in done and pattern.search(v)]
    return [v for v in asked if v not in coded], rows


def together(sets):
    """Arrays of several sets on one mesh as one; sensor (k,): the number of the set."""
    sensor = np.concatenate([np.full(len(a.objects), k) for k, a in enumerate(sets)])
    return join(sets), sensor


def vaes(result):
    """{split: what its mesh VAE came to}."""
    rows = {k: row["found"][""] for k, row in result["rows"].items() if k.startswith("mesh_vae")}
    return {k.removeprefix("mesh_vae "): v for k, v in rows.items()}


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
        for kind in ("latent_vae", "latent_pod", "pointnet", "local"):
            mine = {n: v for n, v in per.items() if n.startswith(f"{kind} dropout") and "bound" not in n}
            if mine:
                best[kind] = min(mine, key=lambda n: np.median(list(mine[n][0].values())))
        pairs = [(a, "pointnet") for a in ("latent_vae", "latent_pod", "local")]
        for a, b in [*pairs, ("latent_vae", "latent_pod")]:
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
    parser.add_argument("--devices", nargs="+", help="of the processes, in turn (default: --device)")
    parser.add_argument("--keep", type=pathlib.Path, help="folder of states, from which a run goes on")
    parser.add_argument("--only", help="regular expression of the rows that are wanted")
    parser.add_argument("--figure", type=pathlib.Path, help="PNG of the mesh VAEs' validation errors")
    given = parser.parse_args(argv)
    if given.table:
        result = json.loads(given.table.read_text())
    elif not given.sets:
        parser.error("no set: give the folder that `biotac data generate --out` wrote, or --table JSON")
    else:
        arrays, sensor = together([load_arrays(path, given.device) for path in given.sets])
        result = run(arrays, sensor, given)
    if given.figure:
        draw(result, given.figure)
    print(table(result))


if __name__ == "__main__":
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    main()
