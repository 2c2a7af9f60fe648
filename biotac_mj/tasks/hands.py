"""BioTacs as the fingertips of robot hands: the Shadow Hand in two variants, Allegro, LEAP, any other by body
name."""

import dataclasses
import typing
from collections.abc import Iterable

import mujoco
import numpy as np

from ..coupling.config import integer
from ..geometry.rigid import quaternion

if typing.TYPE_CHECKING:
    from ..coupling.attachment import Handle

__all__ = ["HANDS", "Mount", "attach_to_hand"]

_TIP = 21.3e-3  # from the BioTac's origin to its tip [m]
_CORE_MASS = 4e-3  # of the BioTac [kg], taken off the link that carries it


@dataclasses.dataclass(frozen=True)
class Mount:
    """Where a BioTac goes on a hand's link.

    Attributes:
      body: name of the link; a hand that was attached with a prefix is found by the end of the name.
      pos: of the BioTac frame's origin in the link's frame [m].
      tip, pad: directions in that frame in which the fingertip points and in which the pad looks.
      replaces: names of the geoms that the BioTac stands for; None is all of the link.
    """

    body: str
    pos: tuple
    tip: tuple = (0.0, 0.0, 1.0)
    pad: tuple = (0.0, -1.0, 0.0)
    replaces: tuple | None = None

    @property
    def quat(self) -> np.ndarray:
        """(w, x, y, z) of the BioTac frame in the link's: its tip is -x, its pad -y.

        Raises:
          ValueError: tip and pad are not at right angles.
        """
        x, y = -np.asarray(self.tip, float), -np.asarray(self.pad, float)
        if not np.isfinite([*x, *y]).all() or abs(x @ y) > 1e-6 or not x.any() or not y.any():
            raise ValueError(
                f"tip {self.tip} and pad {self.pad} of link {self.body!r} must be at right angles: "
                "a BioTac's pad looks sideways"
            )
        x, y = x / np.linalg.norm(x), y / np.linalg.norm(y)
        return quaternion(np.stack([x, y, np.cross(x, y)], axis=1))


# The tip of the replaced link: 32.0 mm (fingers) and 35.0 mm (thumb) from its joint, measured on the
# Menagerie's meshes.
_SHADOW = {
    finger: Mount(f"{finger}distal", (0, 0, (35e-3 if finger == "th" else 32e-3) - _TIP))
    for finger in ("ff", "mf", "rf", "lf", "th")
}
# Shadow's BioTac fingers (shadow-robot/sr_common, hand/xacro/finger/biotac): no moving distal joint; the
# sensor is fixed to the middle link at z = 8 mm (thumb 10 mm, turned by -90 deg about z). The sphere of the
# fingertip is (0, 4, 29) mm behind a joint fixed at 20 deg at z = 20 mm, that is at (0, -6.2, 48.6) mm; ours
# is at (-14.3, -0.8, 0) mm of the BioTac frame.
_SHADOW_AUTHENTIC = {
    f: dataclasses.replace(m, pos=(0, -5.4e-3, 36.3e-3 if f == "th" else 34.3e-3)) for f, m in _SHADOW.items()
}
# Menagerie's Allegro: capsules end 41 mm (fingers) and 55 mm (thumb) beyond the last joint; fingers bend
# towards +x.
_ALLEGRO = {
    finger: Mount(f"{finger}_tip", (0, 0, (55e-3 if finger == "th" else 41e-3) - _TIP), pad=(1.0, 0.0, 0.0))
    for finger in ("ff", "mf", "rf", "th")
}
# Menagerie's LEAP: tips end at y = -50 mm (fingers) and -62 mm (thumb), their flat pads look to -x at 11.2
# mm, z = +-14.5 mm.
_LEAP = {
    finger: Mount(
        f"{finger}_ds",
        (8.2e-3 - 11.2e-3, _TIP - length, z),
        tip=(0.0, -1.0, 0.0),
        pad=(-1.0, 0.0, 0.0),
        replaces=(f"{finger}_tip",),
    )
    for finger, length, z in (
        ("if", 50e-3, 14.5e-3),
        ("mf", 50e-3, 14.5e-3),
        ("rf", 50e-3, 14.5e-3),
        ("th", 62e-3, -14.5e-3),
    )
}
HANDS = {
    "shadow_hand": _SHADOW,
    "shadow_hand_authentic": _SHADOW_AUTHENTIC,
    "allegro_hand": _ALLEGRO,
    "leap_hand": _LEAP,
}


def attach_to_hand(
    spec: mujoco.MjSpec,
    hand: str | dict[str, Mount] = "shadow_hand",
    fingers: Iterable[str] | None = None,
    variant: str = "replace",
    prefix: str = "biotac_",
    self_touch: bool = False,
    slots: int | None = None,
    **settings: object,
) -> dict[str, "Handle"]:
    """Puts BioTacs onto the fingertips of a hand.

    Args:
      spec: the MjSpec that holds the hand. Add the objects first, as for `attach`.
      hand: a name of HANDS (shadow_hand, allegro_hand, leap_hand: Menagerie's models, left or right), or
        {finger: Mount} of any other.
      fingers: which of them, e.g. ("ff", "th"); None takes all.
      variant: of the Shadow Hand: "replace" puts the BioTac where the last link was; "authentic" has Shadow's
        BioTac fingers, whose last joint does not move: the joint, and what drove it, are taken out of the
        model.
      prefix: each finger's names begin with prefix + finger + "_".
      self_touch: whether the skins touch the hand's own links too; False excludes them, which is much faster.
      slots: how many bodies may touch each BioTac two-way; None counts those outside the hand.
      settings: further ones of `attach`, for every finger (each gets its own noise seed).

    Returns:
      {finger: Handle}, in the order of `fingers`.

    Raises:
      ValueError: unknown hand, variant or finger; a link that the model does not have.
    """
    from ..coupling import attach

    for name in ("site", "body", "pos", "quat"):
        if name in settings:
            raise ValueError(f"{name}={settings[name]!r} is given: a finger's place is its Mount's")
    mounts = _mounts(hand, variant)
    fingers = tuple(mounts) if fingers is None else (fingers,) if isinstance(fingers, str) else tuple(fingers)
    if not fingers:
        raise ValueError(f"no finger is named: choose from {', '.join(mounts)}, or None for all")
    for finger in fingers:
        if finger not in mounts:
            raise ValueError(f"the hand has no finger {finger!r}: choose from {', '.join(mounts)}")
    links = {finger: _find(spec, mounts[finger].body) for finger in fingers}
    own = _subtree(_root(next(iter(links.values()))))
    names = {body.name for body in own}
    if slots is None:
        outside = {
            g.parent.name or id(g.parent)
            for g in spec.geoms
            if (g.contype or g.conaffinity) and g.parent.name not in names
        }
        slots = max(4, len(outside) + 1, len(names) if self_touch else 0)
    handles, seed = {}, integer("seed", settings.pop("seed", 0), 0)
    for i, (finger, link) in enumerate(links.items()):
        mount = mounts[finger]
        if variant == "authentic":
            _freeze(spec, link)
        for geom in list(link.geoms):
            if mount.replaces is None or any(geom.name.endswith(name) for name in mount.replaces):
                spec.delete(geom)
        if link.explicitinertial and link.mass > 2 * _CORE_MASS:
            link.mass -= _CORE_MASS
        handles[finger] = attach(
            spec,
            body=link.name,
            pos=mount.pos,
            quat=mount.quat,
            prefix=f"{prefix}{finger}_",
            seed=seed + i,
            slots=slots,
            **settings,
        )
    if not self_touch:
        _exclude(spec, handles, own)
    return handles


def _mounts(hand, variant):
    if not isinstance(hand, str):
        if not isinstance(hand, dict) or not all(isinstance(mount, Mount) for mount in hand.values()):
            raise ValueError(f"hand is {hand!r}: choose one of {', '.join(HANDS)}, or give {{finger: Mount}}")
        return dict(hand)
    if variant not in ("replace", "authentic"):
        raise ValueError(f"unknown variant {variant!r}: choose replace or authentic")
    if hand not in HANDS:
        raise ValueError(
            f"unknown hand {hand!r}: choose one of {', '.join(HANDS)}, or give "
            f"{{finger: Mount(body, pos, tip, pad)}}"
        )
    if variant == "authentic":
        if hand != "shadow_hand":
            raise ValueError(
                f"only the shadow_hand comes with authentic BioTac fingers, not {hand!r}: "
                "leave the variant out"
            )
        return HANDS["shadow_hand_authentic"]
    return HANDS[hand]


def _find(spec, name):
    found = [b for b in spec.bodies if b.name == name] or [b for b in spec.bodies if b.name.endswith(name)]
    if len(found) != 1:
        there = ", ".join(b.name for b in (found or spec.bodies) if b.name) or "no named bodies"
        raise ValueError(
            f"{'several links end' if found else 'no link ends'} with {name!r}: the model has {there}"
        )
    return found[0]


def _root(body):
    """The hand's first body: the child of the world, or the first below a joint that a robot or a carriage
    moves it with."""
    while body.parent.name != "world":
        body = body.parent
    return body


def _subtree(body):
    return [body, *(b for child in body.bodies for b in _subtree(child))]


def _freeze(spec, link):
    """Takes out a link's joint: tendons and actuators on it act on the joint before it, or go too."""
    before = link.parent.joints[-1].name
    for joint in list(link.joints):
        for tendon in list(spec.tendons):
            over = [w.target.name for w in tendon.path]
            if joint.name not in over:
                continue
            for actuator in spec.actuators:
                if actuator.target == tendon.name:
                    actuator.trntype, actuator.target = mujoco.mjtTrn.mjTRN_JOINT, before
                    actuator.ctrlrange = spec.joint(before).range
            spec.delete(tendon)
        for actuator in list(spec.actuators):
            if actuator.target == joint.name:
                spec.delete(actuator)
        spec.delete(joint)
    link.pos = [0.0, 0.0, 0.0]
    for key in list(spec.keys):  # their lengths no longer fit
        spec.delete(key)


def _exclude(spec, handles, own):
    colliding = [b for b in own if b.name and any(g.contype or g.conaffinity for g in b.geoms)]
    for handle in handles.values():
        for body in colliding:
            spec.add_exclude(bodyname1=handle.body, bodyname2=body.name)
