"""BioTacs as the fingertips of robot hands: the Shadow Hand in two variants, Allegro, LEAP, Aero, the gripper
2F-85, any other by body name."""

import functools
import itertools
import operator
import pathlib
import typing
from collections.abc import Iterable

import mujoco
import numpy as np

from ..coupling.config import OWN, SOLID, TO_COME, collides
from ..coupling.settings import SettingKeywords, Settings
from ..fields import check_choice
from ..geometry.assets import asset_path
from ..short_repr import short_repr
from .mounts import Mount, read_mounts

if typing.TYPE_CHECKING:
    from ..coupling.handle import Handle

_MASKS = "contype", "conaffinity"
_CORE_MASS = 4e-3  # of the BioTac [kg], subtracted from the link that carries it

_KNOWN = "shadow_hand", "shadow_hand_authentic", "allegro_hand", "leap_hand", "aero_hand", "robotiq_2f85"
# each with its source in the file, which is like one of `biotac hand mount`
HANDS = {hand: read_mounts(asset_path(f"hands/{hand}.yaml")) for hand in _KNOWN}


@typing.overload
def attach_to_hand(
    spec: mujoco.MjSpec,
    hand: str | dict[str, Mount] = ...,
    *,
    mount: pathlib.Path | str | None = ...,
    link_prefix: str = ...,
    fingers: Iterable[str] | None = ...,
    variant: str = ...,
    self_touch: bool = ...,
    batch: typing.Literal[False] = ...,
    prefix: str = ...,
    slots: int | None = ...,
    settings: Settings | dict | str | pathlib.Path | None = ...,
    **keywords: typing.Unpack[SettingKeywords],
) -> dict[str, "Handle"]: ...


@typing.overload
def attach_to_hand(
    spec: mujoco.MjSpec,
    hand: str | dict[str, Mount] = ...,
    *,
    batch: typing.Literal[True],
    **settings: object,
) -> dict[str, str]: ...


def attach_to_hand(
    spec: mujoco.MjSpec,
    hand: str | dict[str, Mount] = "shadow_hand",
    *,
    mount: pathlib.Path | str | None = None,
    link_prefix: str = "",
    fingers: Iterable[str] | None = None,
    variant: str = "replace",
    self_touch: bool = False,
    batch: bool = False,
    prefix: str = "biotac_",
    slots: int | None = None,
    settings: Settings | dict | str | pathlib.Path | None = None,
    **keywords: typing.Unpack[SettingKeywords],
) -> dict[str, "Handle"] | dict[str, str]:
    """Attaches BioTacs to the fingertips of a hand.

    Replaced geoms stay in the model, for tendons, sensors and other references, but have no contacts, no mass
    and are not drawn. Contact pairs with them are removed: the skin touches their other geom instead.

    Args:
      spec: the MjSpec that holds the hand. With batch=True add the objects first.
      hand: a name of HANDS (shadow_hand, allegro_hand, leap_hand, aero_hand, robotiq_2f85: Menagerie's
        models, left or right), or {finger: Mount} for any other. "shadow_hand_authentic" is shadow_hand with
        that variant.
      mount: a file from `biotac hand mount`, instead of `hand`.
      link_prefix: common prefix of names of the hand's links, if a scene has several hands: the prefix given
        to `MjSpec.attach`.
      fingers: subset, e.g. ("ff", "th"); None: all.
      variant: of the Shadow Hand: "replace" puts the BioTac in place of the last link; "authentic" has
        Shadow's BioTac fingers, whose last joint is fixed: the joint, its own actuators and sensors, and the
        keyframes are removed.
      self_touch: whether the skins touch the hand's own links too; False excludes them, which is much faster.
      batch: True makes the model for mujoco_warp instead (`biotac_mj.batch.add`); of the settings only
        design, skin, coupling and geoms are then used.
      prefix: each finger's names begin with link_prefix + prefix + finger + "_".
      slots: number of bodies that may touch each BioTac with two-way coupling; None: number of those outside
        the hand, and 64 more.
      settings, keywords: as for `biotac_mj.attach`, for every finger.

    Returns:
      {finger: Handle}, in the order of `fingers`; of a batch {finger: prefix}, for `biotac_mj.batch.attach`.

    Raises:
      ValueError: unknown hand, variant or finger; a link, or a geom of it to replace, that is not in the
        model.
    """
    from ..coupling import attach

    if not isinstance(spec, mujoco.MjSpec):
        raise TypeError(f"spec is {type(spec).__name__}: pass a mujoco.MjSpec, before it is compiled")
    for name, value in (("self_touch", self_touch), ("batch", batch)):
        if not isinstance(value, (bool, np.bool_)):
            raise ValueError(f"{name} is {short_repr(value)}: give True or False")
    for name, value, whose in (("prefix", prefix, "BioTacs'"), ("link_prefix", link_prefix, "links'")):
        if not isinstance(value, str):
            raise ValueError(
                f"{name} is {short_repr(value)}: pass the text that the {whose} names begin with"
            )
    if isinstance(hand, str) and hand == "shadow_hand_authentic":
        hand, variant = "shadow_hand", "authentic"
    for name in ("site", "body", "pos", "quat"):
        if name in keywords:
            raise ValueError(f"{name}={short_repr(keywords[name])} is given: a finger's place is its Mount's")
    own = ("hand", "mount", "link_prefix", "fingers", "variant", "self_touch", "batch", "prefix", "slots")
    chosen = Settings.of(settings, keywords, "attach_to_hand", also=own)
    if batch:  # other settings are arguments of `batch.attach`
        used = ("design", "skin", "coupling", "geoms")
        others = [one for one in SettingKeywords.__annotations__ if one not in used]
        Settings.of(None, keywords, "attach_to_hand with batch=True", others)
    if mount is not None:
        hand = read_mounts(mount)
    mounts = _mounts(hand, variant)
    fingers = _listed(fingers, mounts)
    if not fingers:
        raise ValueError(f"no finger is named: choose from {', '.join(mounts)}, or None for all")
    for finger in fingers:
        if not isinstance(finger, str) or finger not in mounts:
            raise ValueError(f"the hand has no finger {short_repr(finger)}: choose from {', '.join(mounts)}")
    try:
        links = {finger: find_link(spec, mounts[finger].body, link_prefix) for finger in fingers}
    except ValueError as error:
        raise ValueError(f"{error}{_remedy(spec, [m.body for m in mounts.values()], link_prefix)}") from None
    prefix = link_prefix + prefix
    own = _subtree(_root(next(iter(links.values()))))
    taken = {body.name for body in spec.bodies}
    free = (name for i in itertools.count() if (name := f"{prefix}link{i}") not in taken)
    for body in own:  # exclusions need names
        body.name = body.name or next(free)
    names = {body.name for body in own}
    masks = {}  # contype and conaffinity of the geoms that each BioTac replaces
    for finger, link in links.items():
        if variant == "authentic":
            _freeze(spec, link)
        masks[finger] = _replace(spec, link, mounts[finger], set() if self_touch else names)
        if link.explicitinertial and link.mass > 2 * _CORE_MASS:
            link.mass -= _CORE_MASS
    every = functools.reduce(operator.or_, itertools.chain(*masks.values()), SOLID)
    if batch:
        prefixes = _add(spec, links, mounts, prefix, None if self_touch else own, chosen, every)
        _give_masks(spec, {f"{p}core": masks[finger] for finger, p in prefixes.items()})
        if not self_touch:
            _exclude(spec, [f"{p}core" for p in prefixes.values()], own)
        return prefixes
    if slots is None:
        outside = {
            g.parent.name or id(g.parent)
            for g in spec.geoms
            if collides(g, every) and g.parent.name not in names
        }
        slots = len(outside) + (len(names) if self_touch else 0) + TO_COME
    handles = {}
    for finger, link in links.items():
        handles[finger] = attach(
            spec,
            body=link.name,
            pos=mounts[finger].pos,
            quat=mounts[finger].quat,
            prefix=f"{prefix}{finger}_",
            slots=slots,
            settings=chosen,
        )
    _give_masks(spec, {handle.body: masks[finger] for finger, handle in handles.items()})
    if not self_touch:
        _exclude(spec, [handle.body for handle in handles.values()], own)
    return handles


def _give_masks(spec, masks):
    """Gives BioTacs the collision masks of the replaced geoms; masks: {core: (contype, conaffinity)}."""
    for core, given in masks.items():
        for geom in spec.body(core).geoms:
            for name, mask in zip(_MASKS, given):
                if getattr(geom, name):  # not if only contact pairs define its contacts
                    setattr(geom, name, getattr(geom, name) | mask)


def _add(spec, links, mounts, prefix, own, chosen, mask):
    """`batch.add` at each link; rows are made for bodies outside `own`."""
    from ..batch import add

    touching = chosen.contact.geoms
    if touching is None and own is not None:
        taken, inside = {g.name for g in spec.geoms}, {body.name for body in own}
        free = (name for i in itertools.count() if (name := f"{prefix}geom{i}") not in taken)
        outside = [g for g in spec.geoms if collides(g, mask) and g.parent.name not in inside]
        for geom in outside:
            geom.name = geom.name or next(free)
        touching = [geom.name for geom in outside]
    return {
        finger: add(
            spec,
            body=link.name,
            pos=mounts[finger].pos,
            quat=mounts[finger].quat,
            prefix=f"{prefix}{finger}_",
            design=chosen.skin.design,
            skin=chosen.skin.mesh,
            coupling=chosen.contact.coupling,
            geoms=touching,
        )
        for finger, link in links.items()
    }


def _listed(fingers, mounts):
    """Names of the selected fingers."""
    if fingers is None or isinstance(fingers, str):
        return tuple(mounts) if fingers is None else (fingers,)
    try:
        return tuple(fingers)
    except Exception:  # array types raise various errors
        raise ValueError(f"fingers is {short_repr(fingers)}: give a list of {', '.join(mounts)}") from None


def _mounts(hand, variant):
    check_choice("unknown variant", variant, ("replace", "authentic"))
    if not isinstance(hand, str):
        named = isinstance(hand, dict) and hand and all(isinstance(finger, str) for finger in hand)
        if not named or not all(isinstance(mount, Mount) for mount in hand.values()):
            raise ValueError(
                f"hand is {short_repr(hand)}: choose one of {', '.join(HANDS)}, or give {{finger: Mount}}"
            )
        return dict(hand)
    if hand not in HANDS:
        raise ValueError(
            f"unknown hand {short_repr(hand)}: choose one of {', '.join(HANDS)}, or give "
            f"{{finger: Mount(body, pos, tip, pad)}}"
        )
    if variant == "authentic":
        if hand != "shadow_hand":
            raise ValueError(
                f"only the shadow_hand comes with authentic BioTac fingers, not {short_repr(hand)}: "
                "leave the variant out"
            )
        return HANDS["shadow_hand_authentic"]
    return HANDS[hand]


def find_link(spec: mujoco.MjSpec, name: str, prefix: str = "") -> "mujoco._specs.MjsBody":
    """The body with that name, or the only one whose name begins with `prefix` and ends with it.

    Raises:
      ValueError: none, or several; the text lists them.
    """
    found = [b for b in spec.bodies if b.name in (name, prefix + name) and b.name.startswith(prefix)]
    found = found or _links(spec, name, prefix)
    if len(found) != 1:
        there = ", ".join(b.name for b in (found or spec.bodies) if b.name) or "no named bodies"
        which = f" and begin{'' if found else 's'} with {prefix!r}" if prefix else ""
        what = "several links end" if found else "no link ends"
        one = ": name one of them" if found else ""
        raise ValueError(f"{what} with {name!r}{which}: the model has {there}{one}")
    return found[0]


def _links(spec, name, prefix):
    return [b for b in spec.bodies if b.name.startswith(prefix) and b.name.endswith(name)]


def _remedy(spec, names, prefix):
    """Remedy if the links are missing or not unique: for several hands their prefixes, for another known hand
    its name."""
    before = [{b.name.removesuffix(name) for b in _links(spec, name, prefix)} for name in names]
    hands = sorted(set.intersection(*before) - {prefix})
    if len(hands) > 1:
        shown = " or ".join(map(repr, hands))
        return f"; of several hands say which one takes the BioTacs, with link_prefix={shown}"
    known = known_hand(spec)
    if known:
        return f"; it looks like a {known}: name that"
    return "; for any other hand make mount=FILE with `biotac hand mount`"


def known_hand(spec: mujoco.MjSpec) -> str | None:
    """The name in HANDS of a hand whose fingers' links are all in the model, or None."""
    fits = (hand for hand, mounts in HANDS.items() if all(_links(spec, m.body, "") for m in mounts.values()))
    return next(fits, None)


def _root(body):
    """The hand's first body: the child of the world, or the first below a joint of a robot or a carriage."""
    while body.parent.name != "world":
        body = body.parent
    return body


def _subtree(body):
    return [body, *(b for child in body.bodies for b in _subtree(child))]


def _replace(spec, link, mount, own):
    """Disables the geoms that the BioTac replaces; the skin touches nothing of the bodies `own`. Returns
    their contype and conaffinity."""
    shown, replaced = fixed_geoms(link, mount.shown), fixed_geoms(link, mount.replaces)
    masks = [functools.reduce(operator.or_, (getattr(g, mask) for g in replaced), 0) for mask in _MASKS]
    for geom in replaced:
        geom.contype = geom.conaffinity = 0
        geom.mass, geom.material, geom.rgba[3] = 0.0, "", 0.0
        for pair in [p for p in spec.pairs if geom.name and geom.name in (p.geomname1, p.geomname2)]:
            _enable_contact(spec, pair.geomname2 if pair.geomname1 == geom.name else pair.geomname1, own)
            spec.delete(pair)
    for geom in shown:
        geom.group = 0
    return masks


def fixed_geoms(
    link: "mujoco._specs.MjsBody", names: Iterable[str] | None = None
) -> list["mujoco._specs.MjsGeom"]:
    """Geoms of a link and of the bodies fixed to it.

    Args:
      names: of the wanted geoms, or the ends of their names; None: all.

    Raises:
      ValueError: no geom has one of the names; the text lists the existing ones.
    """
    fixed = (body for body in link.bodies if not body.joints and not body.mocap)
    geoms = [*link.geoms, *(g for body in fixed for g in fixed_geoms(body))]
    if names is None:
        return geoms
    out = []
    for name in names:
        found = [g for g in geoms if g.name and g.name.endswith(name)]
        if not found:
            there = ", ".join(g.name for g in geoms if g.name) or "no named geom"
            raise ValueError(
                f"link {link.name!r} has no geom {name!r}: its geoms are {there}; give Mount(replaces=...) "
                "those that the BioTac stands for, () for none"
            )
        out += found
    return out


def _enable_contact(spec, name, own):
    """Lets skins touch a geom that collided only in pairs, through the collision bit of BioTacs."""
    geom = spec.geom(name)
    if geom is None or geom.contype or geom.conaffinity or geom.parent.name in own:
        return
    geom.conaffinity = OWN


def _freeze(spec, link):
    """Removes a link's joint: tendons on it are moved to the joint before it, other references are
    deleted."""
    before = link.parent.joints[-1].name
    for joint in list(link.joints):
        for tendon in list(spec.tendons):
            if joint.name not in [
                w.target.name for w in tendon.path if w.type == mujoco.mjtWrap.mjWRAP_JOINT
            ]:
                continue
            for actuator in spec.actuators:
                if actuator.trntype == mujoco.mjtTrn.mjTRN_TENDON and actuator.target == tendon.name:
                    actuator.trntype, actuator.target = mujoco.mjtTrn.mjTRN_JOINT, before
                    actuator.ctrlrange = spec.joint(before).range
            for sensor in spec.sensors:
                of_joint = getattr(mujoco.mjtSensor, sensor.type.name.replace("TENDON", "JOINT"), None)
                if (
                    sensor.objtype == mujoco.mjtObj.mjOBJ_TENDON
                    and sensor.objname == tendon.name
                    and of_joint
                ):
                    sensor.type, sensor.objtype, sensor.objname = of_joint, mujoco.mjtObj.mjOBJ_JOINT, before
            _take_out(spec, tendon, "TENDON")
        _take_out(spec, joint, "JOINT")
    link.pos = [0.0, 0.0, 0.0]
    for key in list(spec.keys):  # their lengths are invalid
        spec.delete(key)


def _take_out(spec, element, kind):
    """Deletes a joint, tendon or actuator (`kind`, as in mjtObj) and its references."""
    name, of_kind = element.name, getattr(mujoco.mjtObj, f"mjOBJ_{kind}")
    transmission = {"JOINT": ("mjTRN_JOINT", "mjTRN_JOINTINPARENT"), "TENDON": ("mjTRN_TENDON",)}.get(
        kind, ()
    )
    for sensor in list(spec.sensors):
        if (of_kind, name) in ((sensor.objtype, sensor.objname), (sensor.reftype, sensor.refname)):
            spec.delete(sensor)
    for equality in list(spec.equalities):
        if equality.type.name == f"mjEQ_{kind}" and name in (equality.name1, equality.name2):
            spec.delete(equality)
    for actuator in list(spec.actuators):
        if actuator.trntype.name in transmission and actuator.target == name:
            _take_out(spec, actuator, "ACTUATOR")
    spec.delete(element)


def _exclude(spec, cores, own):
    colliding = [b for b in own if any(g.contype or g.conaffinity for g in b.geoms)]
    for core in cores:
        for body in colliding:
            spec.add_exclude(bodyname1=core, bodyname2=body.name)
