"""Effects of the set-up: the tool, the sensor's pose, and its mount."""

from collections.abc import Sequence

import numpy as np

from .effect import Effect, Param, Run


class Radius(Effect):
    """One parameter for each spherical tool among the trajectories, else one for all; another sphere is off
    by their mean."""

    id, name, stage = "radius", "radius of the tool", "S"
    physics = "the sphere is larger or smaller than stated"
    confusable = {"mount": "light load", "stiffen": "another tool"}

    def __init__(self, tools: tuple = ()):
        of = Param("1", -0.4, 0.4, "+-25 %", 0.1)
        self.params = dict.fromkeys(tools if len(tools) > 1 else ("log_radius",), of)

    def among(self, trajectories: list) -> "Effect":
        return Radius(tuple(sorted({t.tool for t in trajectories if "sphere" in t.tool})))

    def given(self, names: Sequence[str]) -> "Effect":
        return Radius(tuple(name for name in names if "sphere" in name))

    def applicable(self, trajectories: list) -> str | None:
        return None if any("sphere" in t.tool for t in trajectories) else "no sphere among the tools"

    def apply(self, run: Run, theta: dict) -> None:
        if "sphere" in run.tool:
            run.log_radius = run.log_radius + theta.get(run.tool, np.mean([*theta.values()]))


class Misalignment(Effect):
    id, name, stage = "misalign", "constant misalignment of the sensor", "S"
    pose_offset = True
    physics = "all poses have the same small shift and rotation about the sensor's axes"
    params = {k: Param("m", -1e-3, 1e-3, "0-1 mm", 0.15e-3) for k in "xyz"} | {
        k: Param("rad", -0.15, 0.15, "0-5 degrees of a mount: CHOSEN", 0.02) for k in ("roll", "yaw", "pitch")
    }
    confusable = {"inhomog": "mount the sensor again", "gain": "another place"}

    def apply(self, run: Run, theta: dict) -> None:
        turn = np.array([theta["roll"], theta["yaw"], theta["pitch"]])
        run.offset = (
            run.offset
            + np.array([theta["x"], theta.get("y", 0.0), theta["z"]])
            + np.cross(turn, run.place if run.pos is None else run.pos)
        )
        run.turn = run.turn + turn


class DepthZero(Effect):
    id, name, stage = "depth0", "zero of the depth", "S"
    pose_offset = True
    physics = "the object touches earlier or later than by its pose, equally everywhere"
    params = {"dz": Param("m", -0.4e-3, 0.4e-3, "-0.15..0.15 mm", 0.06e-3)}
    confusable = {"mount": "light load: an offset remains, a compliance vanishes", "radius": "another tool"}

    def apply(self, run: Run, theta: dict) -> None:
        run.offset = run.offset + theta["dz"] * run.heading


def _until(unit: str, low: float, high: float, start: float) -> dict:
    """A rare parameter: the load at which the displacement is half the proportional one."""
    return {"until": Param(unit, low, high, "play that is used up, a stop: CHOSEN", start, start, True)}


def _compliance_fraction(load: np.ndarray, theta: dict) -> np.ndarray:
    """(n,) fraction of the proportional displacement under a load (n,), limited by the stop."""
    return 1 / (1 + load / theta["until"]) if "until" in theta else np.ones(len(load))


class Mount(Effect):
    id, name, stage = "mount", "compliance of mount or robot", "B"
    physics = "the object moves back in proportion to the force: d - F / k"
    params = {"compliance": Param("m/N", 0.0, 0.3e-3, "0-0.15 mm/N", 0.03e-3)}
    rare = _until("N", 0.3, 30.0, 2.0)
    confusable = {"depth0": "light load", "stiffen": "push on a rigid block"}

    def apply(self, run: Run, theta: dict) -> None:
        give = run.give(theta["compliance"] * _compliance_fraction(run.normal_force, theta))
        run.offset = run.offset - np.outer(give, run.heading)


class Rocking(Effect):
    id, name, stage = "rocking", "rocking of the sensor", "B"
    physics = "the sensor is shifted and tilted in proportion to the force, always in one direction"
    params = {k: Param("m/N", -0.5e-3, 0.5e-3, "0-0.5 mm/N", 0.05e-3) for k in "xyz"} | {
        k: Param("rad/N", -0.1, 0.1, "0-0.5 mm/N at a lever of 5 to 20 mm", 5e-3)
        for k in ("roll", "yaw", "pitch")
    }
    rare = _until("N", 0.3, 30.0, 2.0)
    equivalents = ("rocking_torque",)
    confusable = {
        "misalign": "light load",
        "mount": "camera on the clamp",
        "rocking_torque": "presses from two sides at one place: a tilt by torque goes both ways",
        "stiffen": "push on a rigid block",
    }

    def apply(self, run: Run, theta: dict) -> None:
        turn = np.array([theta.get(k, 0.0) for k in ("roll", "yaw", "pitch")])
        moved = np.array([theta["x"], theta.get("y", 0.0), theta["z"]]) + np.cross(
            turn, run.place if run.pos is None else run.pos
        )
        moved = np.broadcast_to(moved, run.offset.shape)
        load = (
            _load_feedback(run, moved) * run.normal_force * _compliance_fraction(run.normal_force, theta)
        )[:, None]
        run.offset = run.offset + load * moved
        run.turn = run.turn + load * turn


def _load_feedback(run, moved):
    """(n,) fraction of the load that remains if it moves the object by `moved` (n, 3) [m/N]: a motion along
    the press changes its own load."""
    stiffness = 0.0 if run.stiffness is None else run.stiffness
    return 1 / np.maximum(1 - (moved @ run.heading) * stiffness, 0.5)


class RockingTorque(Effect):
    id, name, stage = "rocking_torque", "rocking of the sensor by its torque", "B"
    physics = "a clamp behind the sensor rotates by the torque about it, with a compliance per axis"
    params = {
        k: Param("rad/(N m)", 0.0, 3.0, "0-0.5 mm/N at a lever of 20 mm", 0.15)
        for k in ("roll", "yaw", "pitch")
    }
    params |= {"behind": Param("m", 2e-3, 60e-3, "clamp behind the sensor's origin", 10e-3, 10e-3, True)}
    rare = _until("N m", 3e-3, 0.3, 20e-3)
    grid = ({"behind": 5e-3}, {"behind": 25e-3})
    equivalents = ("rocking",)
    confusable = {
        "rocking": "presses from two sides at one place: a tilt by torque goes both ways",
        "mount": "camera on the clamp",
        "misalign": "light load",
        "stiffen": "push on a rigid block",
    }

    def apply(self, run: Run, theta: dict) -> None:
        place = np.broadcast_to(run.place if run.pos is None else run.pos, run.offset.shape)
        lever = place - np.array([theta["behind"], 0.0, 0.0])
        # seen from a sensor that is tilted by its torque, the object is rotated the opposite way
        tilt = np.array([theta[k] for k in ("roll", "yaw", "pitch")])
        torque = np.cross(lever, run.force)
        turn = tilt * torque * _compliance_fraction(np.linalg.norm(torque, axis=1), theta)[:, None]
        load = run.normal_force[:, None]
        moved = np.cross(turn, lever)
        feedback = _load_feedback(run, moved / np.maximum(load, 1e-3))[:, None]
        run.offset = run.offset + feedback * moved
        run.turn = run.turn + feedback * turn
