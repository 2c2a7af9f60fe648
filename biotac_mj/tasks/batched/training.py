"""Trains policies of a task, one for each kind of touch and each seed, in parallel in the worlds of one
batch.

    python -m biotac_mj.tasks.batched.training insert_peg --observe electrodes none --minutes 5 --out out/peg

Each policy has its own fraction of the worlds. Every half minute it is written to
`TASK-OBSERVE-SEED.safetensors` with a card (observations, scores), with a second file for `--resume`; so a
training may be stopped at any time. At the end each policy plays an episode in each of its worlds, from
unseen states, without exploration and without `BatchTask.model_error`: the success on its card. Needs the
extras `batch` and `learning`; takes minutes on a GPU, a day on a CPU."""

import argparse
import dataclasses
import functools
import pathlib
import sys
import time
from collections.abc import Sequence

import torch
import warp as wp

from ...files import replacing
from ...versions import versions
from . import OBSERVE, TASKS, make
from .playing import play, seen_by
from .policy import save_policy
from .ppo import Learner, Lessons, Numbers
from .task import BatchTask

# effects of the sensors in learning, in addition to the spread of real ones (`sensor="random"`)
RANDOMISED = ("gain", "pdc_gain", "warmup", "drift")
_MODEL_ERROR = (0.1, 0.25, 0.15)  # of electrodes, PDC and PAC (docs/lab/tasks.md)
# in lessons, beside what is measured where a task is the same in both tiers; the last of each electrode
_BESIDE_MEASURED = (0.12, 0.25, 0.15, 0.07)
_MISSING = 1  # electrode of each finger that a lesson lacks (docs/lab/tasks.md)
_KEEP = 30.0  # [s] between files
_STRAY = 0.3  # deviation of the teacher's actions, so that it also shows how to recover
_HISTORY = 12  # decisions that a policy sees: noise of the encoders is new in each


class Run:
    """One policy that learns in its fraction of the worlds.

    Args:
      env: the environment.
      worlds: the worlds in which this policy acts.
      observe: what it sees, one of OBSERVE.
      seed: for its networks' first weights.
    """

    def __init__(self, env: BatchTask, worlds: slice, observe: str, seed: int, numbers: Numbers):
        self.env, self.worlds, self.observe, self.seed = env, worlds, observe, seed
        widths = self.seen().shape[1], self.known().shape[1], env.num_actions
        self.learner = Learner(*widths, seed, env.device, numbers)
        self.decisions, self.seconds, self.rows = 0, 0.0, []
        self._ended, self.off = [0, 0], 0.0

    def seen(self) -> torch.Tensor:
        return seen_by(self.env, self.observe, self.worlds)

    def known(self, worlds: slice | None = None) -> torch.Tensor:
        """Input of the critic, the true state, in these worlds; None: its own."""
        found = self.env.observe("none")
        known = torch.cat([found["body"], found["state"]], dim=1)
        return known[self.worlds if worlds is None else worlds]

    def act(self, env: BatchTask) -> torch.Tensor:
        """Its actions without exploration."""
        return self.learner.policy(self.seen())

    @torch.no_grad()
    def compare(self, right: torch.Tensor) -> None:
        """Updates the RMS difference to the teacher's actions, averaged over some ten decisions."""
        square = (self.act(self.env).clamp(-1, 1) - right[self.worlds]).square().mean()
        self.off = float((0.9 * self.off**2 + 0.1 * square) ** 0.5)

    def record(self, reward: torch.Tensor, done: torch.Tensor, extras: dict) -> None:
        """Records the result of a decision of all worlds."""
        w = self.worlds
        self.learner.record(reward[w], done[w], extras["time_outs"][w])
        self.decisions += w.stop - w.start
        self._ended[0] += int(done[w].sum())
        self._ended[1] += int(extras["success"][w].sum())

    def learn(self, train_policy: bool) -> None:
        """Updates after `steps` decisions, see `Learner.update`."""
        self.learner.update(self.known(), train_policy)
        if self._ended[0]:
            row = dict(zip(("ended", "success"), self._ended, strict=True))
            self.rows.append(row | {"decisions": self.decisions, "seconds": self.seconds})
            self._ended = [0, 0]

    def rate(self, last: int = 8) -> float:
        """Fraction of the last episodes in learning that succeeded."""
        rows = self.rows[-last:]
        return sum(r["success"] for r in rows) / max(1, sum(r["ended"] for r in rows))

    def files(self, folder: pathlib.Path, task: str) -> tuple[pathlib.Path, pathlib.Path]:
        """Files of the policy, and of the state of its training."""
        name = f"{task}-{self.observe}-{self.seed}"
        return folder / f"{name}.safetensors", folder / f"{name}.resume"

    def keep(self, folder: pathlib.Path, task: str, about: dict) -> dict:
        """Writes both files; returns the card."""
        own = {"observe": self.observe, "seed": self.seed, "decisions": self.decisions}
        learned = {"minutes": round(self.seconds / 60, 2), "success_in_learning": round(self.rate(), 3)}
        card = {"task": task, **own, **learned, **about}
        policy, resume = self.files(folder, task)
        save_policy(policy, self.learner.policy, card)
        with replacing(resume) as temporary:
            more = {"decisions": self.decisions, "seconds": self.seconds, "rows": self.rows}
            torch.save(self.learner.state() | more, temporary)
        return card

    def resume(self, folder: pathlib.Path, task: str) -> None:
        """Continues from the files.

        Raises:
          FileNotFoundError: there is none.
        """
        path = self.files(folder, task)[1]
        if not path.is_file():
            raise FileNotFoundError(f"no {path}: leave out --resume to begin")
        state = torch.load(path, map_location=self.env.device, weights_only=True)
        self.decisions, self.seconds, self.rows = (state.pop(k) for k in ("decisions", "seconds", "rows"))
        self.learner.resume(state)


def train(
    env: BatchTask,
    task: str,
    runs: Sequence[tuple[str, int]],
    minutes: float,
    out: pathlib.Path,
    about: dict | None = None,
    resume: bool = False,
    taught: float = Numbers.taught,
) -> list[dict]:
    """Trains policies in parallel; returns their cards.

    Args:
      env: the worlds, divided evenly. task: its name. runs: [(observe, seed)].
      minutes: of learning, without the episodes at the end. out: folder of the files.
      about: further entries of the cards.
      resume: continue from files of an earlier call, without the teacher.
      taught: fraction of the minutes with imitation of the teacher.

    Raises:
      ValueError: minutes that are none, or a run that is given twice.
    """
    if not 0 <= minutes < float("inf"):
        raise ValueError(f"{minutes} minutes: give a number of 0 or more")
    if len(set(runs)) < len(runs):
        raise ValueError("a kind of touch is given twice with one seed: their files would be one")
    numbers, each = Numbers(gamma=env.gamma, taught=taught), env.num_envs // len(runs)
    learners = [
        Run(env, slice(i * each, (i + 1) * each), observe, seed, numbers)
        for i, (observe, seed) in enumerate(runs)
    ]
    if resume:
        for run in learners:
            run.resume(out, task)
    about = _about(env) | (about or {})
    lessons = Lessons(numbers.remembered, 0, env.device)
    errors = {}
    if env.same_in_tiers and not resume:
        errors = {"measured": tier_errors(env, _in_full_tier(env, task)), "model_error": _BESIDE_MEASURED}
    env.reset(seed=sum(run.decisions for run in learners))
    env.stagger()
    begin = last = kept = time.perf_counter()
    # decisions in which a teacher acts, and by which a policy scales what it sees
    first = 0 if resume else env.max_episode_length
    of_teacher = 0.0 if resume else 60 * minutes * numbers.taught  # [s]
    since = 0  # decisions since states were kept
    while last < begin + 60 * minutes:
        learns = last < begin + of_teacher
        for _ in range(numbers.steps):
            actions = torch.cat([run.learner.act(run.seen(), run.known()) for run in learners])
            if learns:
                wish = env.script()
                lessons.add(env.sensed(), wish)
                right = wish.clamp(-1, 1)
                for run in learners:
                    run.compare(right)
            if first > 0:
                first -= 1
                for run in learners:
                    alike = env.alike(run.observe)
                    run.learner.update_statistics(seen_by(env, run.observe), run.known(slice(None)), alike)
                if learns:
                    actions = right + _STRAY * torch.randn_like(right)
            _, reward, terminated, truncated, extras = env.step(actions)
            for run in learners:
                run.record(reward, terminated | truncated, extras)
        since += numbers.steps
        acted = _now(env) - last
        for run in learners:
            run.learn(not learns)
        if learns:
            _study(learners, lessons, errors, acted, (last - begin) / of_teacher)
        if env.cfg.prepare and since >= numbers.renew * env.cfg.prepare:
            env.prepare_held()
            env.stagger()
            since = 0
        now = _now(env)
        for run in learners:
            run.seconds += now - last
        last = now
        if last > kept + _KEEP:
            kept = last
            for run in learners:
                run.keep(out, task, about)
            rates = ", ".join(f"{r.observe} {r.seed}: {r.rate():.2f} ({r.off:.2f})" for r in learners)
            status = f"{last - begin:5.0f} s, {learners[0].decisions} decisions each"
            print(f"{status}{', taught' if learns else ''}, {rates}", flush=True)
    for run in learners:
        run.keep(out, task, about)
    env.model_error = (0.0, 0.0, 0.0)
    ends = play(env, [(run.worlds, run.act) for run in learners])
    return [run.keep(out, task, about | end) for run, end in zip(learners, ends, strict=True)]


def _now(env):
    """[s], after all work of the device."""
    if env.device != "cpu":
        torch.cuda.synchronize(env.device)
    return time.perf_counter()


@torch.no_grad()
def tier_errors(env: BatchTask, other: BatchTask, seed: int = 0) -> torch.Tensor:
    """Differences (decisions, num_envs, nfinger, k) of the changes of channels in another tier from those in
    env, over the latter's RMS, in the same episodes with the same actions: the script's, which strays.

    Args:
      env, other: of one task, with the same random draws. seed: of the episodes.
    """
    for one in (env, other):
        one.prepare_held(seed=seed)
    both = torch.isin(env.good, other.good)
    env.good = other.good = env.good[both]
    for one in (env, other):
        one.reset(seed=seed + 1)
    out = []
    for _ in range(env.max_episode_length):
        there, here = (one.sensed()["changes"][:, 0] for one in (other, env))
        # counts within their noise are no reading, and PAC may be late
        out.append(((there - here) / (env._touch.rms(here) + 5.0)).clamp(-1.5, 1.5))
        right = env.script().clamp(-1, 1)
        actions = right + _STRAY * torch.randn_like(right)
        for one in (env, other):
            one.step(actions)
    return torch.stack(out)


def _in_full_tier(env, task):
    own = {"hand": env._hand} if task == "roll_rod" else {}
    return make(
        task, env.num_envs, device=env.device, settings=env.cfg, **own, **env.biotac | {"tier": "full"}
    )


def _study(learners, lessons, errors, acted, progress):
    """Trains by imitation for `BatchTask.study` times `acted`, the time of acting [s]; progress: elapsed
    fraction of the phase with a teacher. Each lesson draws new errors of encoders and model, because a policy
    would recognise the few states by these errors, and leaves electrodes out, because it would rely on few of
    them, whose errors would then mislead it; and another goal, because what was done towards the goal that
    there was tells where the object was believed to be."""
    numbers, env, begin = learners[0].learner.numbers, learners[0].env, time.perf_counter()
    for _ in range(numbers.lessons):
        sensed, right = env.change_goal(*lessons.draw(numbers.several))
        draw = functools.cache(functools.partial(env.sense_anew, **sensed, **errors, missing=_MISSING))
        for run in learners:
            run.learner.imitate(draw(run.observe), right.clamp(-1, 1), progress)
        if _now(env) - begin > env.study * acted:
            break


def _about(env):
    made = {"settings": dataclasses.asdict(env.cfg), "biotac": env.biotac, "worlds": env.num_envs}
    made |= {"history": env.history, "model_error": env.model_error}
    return {"data": "synthetic", **made, "device": wp.get_device(env.device).name, "versions": versions()}


def main(arguments: Sequence[str] | None = None) -> int:
    """The command."""
    parser = argparse.ArgumentParser(
        prog="python -m biotac_mj.tasks.batched.training", description=__doc__.split("\n\n")[0]
    )
    parser.add_argument("task", choices=TASKS)
    parser.add_argument(
        "--observe", nargs="+", default=["electrodes"], choices=OBSERVE, help="kinds of touch that are read"
    )
    parser.add_argument("--seeds", nargs="+", type=int, default=[0], help="seeds, for each kind of touch")
    parser.add_argument("--worlds", type=int, default=512, help="number of worlds for each policy")
    parser.add_argument("--minutes", type=float, default=5.0, help="of learning, besides compiling, playing")
    parser.add_argument("--device", help="Warp device, cpu or cuda:0 say")
    parser.add_argument(
        "--out", type=pathlib.Path, default=pathlib.Path("out/policies"), help="folder of the policies"
    )
    parser.add_argument("--resume", action="store_true", help="continue the training in --out")
    parser.add_argument("--hand", type=pathlib.Path, help="shadow_hand/right_hand.xml of MuJoCo Menagerie")
    options = parser.parse_args(arguments)
    begin = time.perf_counter()
    runs = [(observe, seed) for observe in options.observe for seed in options.seeds]
    try:
        env = of_runs(options.task, runs, options.worlds, options.device, options.hand)
        print(f"{time.perf_counter() - begin:.0f} s of setting up", flush=True)
        cards = train(env, options.task, runs, options.minutes, options.out, resume=options.resume)
    except (ValueError, FileNotFoundError) as error:
        parser.error(str(error))
    for card in cards:
        print(
            f"{card['task']} {card['observe']} {card['seed']}: success {card['success']:.3f} "
            f"({card['low']:.3f} to {card['high']:.3f}) of {card['episodes']} episodes"
        )
    return 0


def of_runs(
    task: str,
    runs: Sequence[tuple[str, int]],
    worlds: int,
    device: str | None = None,
    hand: pathlib.Path | None = None,
) -> BatchTask:
    """An environment for runs [(observe, seed)], with so many worlds for each.

    Raises:
      ValueError: "learned" beside another choice: its sensors are others.
    """
    choices = {observe for observe, _ in runs}
    if "learned" in choices and len(choices) > 1:
        raise ValueError("the sensors of observe=learned are others: let it learn in a call of its own")
    own = {"hand": hand} if hand else {}
    return make(
        task,
        worlds * len(runs),
        device=device,
        observe=runs[0][0],
        sensor="random",
        randomise=list(RANDOMISED),
        history=_HISTORY,
        model_error=_MODEL_ERROR,
        **own,
    )


if __name__ == "__main__":
    sys.exit(main())
